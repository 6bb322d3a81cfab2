"""The installed nodes as processes of a benchmark, in a domain of their own."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from ament_index_python.packages import get_package_prefix
from mr_damper_msgs.msg import DamperParameters, FitReport

from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.observer import Observer
from mr_damper_ros.processes.programs import Program, RosDomain, node_arguments
from mr_damper_ros.tracking.state_directory import StateDirectory

_BAD_WORDS = ("[ERROR]", "[FATAL]", "Traceback")


Self = TypeVar("Self", bound="Nodes")


class Nodes:
    """Programs in a separate domain, and an ``observer`` in this process.

    ``programs`` holds the newest program of each name. The logs of ended programs are kept.
    """

    def __init__(self, domain: RosDomain | None = None) -> None:
        self.domain = domain or RosDomain()
        self.observer = Observer(domain=self.domain)
        self.programs: dict[str, Program] = {}
        self._ended: list[str] = []

    def __enter__(self: Self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def start(self, program: str, *arguments: str, **parameters: object) -> Program:
        """Start an installed program, such as "bridge"; it replaces the one before."""
        return self.start_as(program, program, *arguments, **parameters)

    def start_as(self, name: str, program: str, *arguments: str, **parameters: object) -> Program:
        """Start an installed program that replaces the one of this name; see ``node_arguments``."""
        path = Path(get_package_prefix("mr_damper_ros")) / "lib" / "mr_damper_ros" / program
        return self._started(name, [str(path), *arguments, *node_arguments(parameters)])

    def start_helper(self, program: str, *arguments: str) -> Program:
        """Start a program of :mod:`benchmarks.helper_programs`."""
        command = [sys.executable, "-m", "benchmarks.helper_programs", program, *arguments]
        return self._started(program, command)

    def _started(self, name: str, command: Sequence[str]) -> Program:
        self.end(name)
        self.programs[name] = Program(command, self.domain.environment)
        return self.programs[name]

    def end(self, name: str) -> None:
        """End the program of this name, if there is one, and keep its log."""
        if name in self.programs:
            program = self.programs.pop(name)
            program.stop()
            self._ended.append(program.log)
            program.close()

    def close(self) -> None:
        """End all programs."""
        for name in list(self.programs):
            self.end(name)
        self.observer.close()
        self.domain.close()

    @property
    def errors(self) -> list[str]:
        """Error lines in the logs of all programs, including ended ones."""
        logs = [*self._ended, *(program.log for program in self.programs.values())]
        lines = [line for log in logs for line in log.splitlines()]
        return [line for line in lines if any(word in line for word in _BAD_WORDS)]


NODES = ("bridge", "identifier", "model")


class ThreeNodes(Nodes):
    """Bridge, identifier and model with these parameters; the identifier keeps its state."""

    def __init__(self, options: Mapping[str, Mapping[str, object]]) -> None:
        super().__init__()
        # In build/, since a temporary folder may be in memory.
        Path("build").mkdir(exist_ok=True)
        self._folder = tempfile.TemporaryDirectory(dir="build")
        folder = Path(self._folder.name).absolute()
        self.state = StateDirectory(folder)
        self._options = {**options, "identifier": {**options["identifier"], "state_dir": folder}}
        # Deeper than the queue of the publisher, so that no message replaces an earlier one.
        latched = quality.latched()
        latched.depth = 100
        listen = self.observer.listen
        self.sets: list[DamperParameters] = listen(DamperParameters, "damper/parameters", latched)
        self.reports: list[FitReport] = listen(FitReport, "damper/fit_report", quality.stream())
        for name in NODES:
            self.restart(name)
        for topic in ("mts/samples", "damper/predicted_force"):
            self.observer.wait_for_publishers(topic)
        self.observer.until(lambda: self.reports, "the first report")

    def restart(self, name: str) -> Program:
        """Start a node that replaces the ended node of this name."""
        return self.start(name, **self._options.get(name, {}))

    @property
    def worker(self) -> int | None:
        """Id of the identifier's worker process; None while there is none."""
        children = self.programs["identifier"].children
        return children[0] if children else None

    def close(self) -> None:
        """End all programs and remove the state."""
        super().close()
        self._folder.cleanup()


@contextmanager
def on_cores(cores: Sequence[int] | None) -> Iterator[None]:
    """Context in which started programs run on these cores only; None means any core."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, before if cores is None else cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def resident_bytes(pid: int) -> int:
    """Memory in use [B] of a process (resident set), shared libraries included."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def cpu_seconds(pid: int) -> float:
    """Processor time used so far [s] by a process, without child processes."""
    # The name of the program, in parentheses, may contain blanks.
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
