"""Programs started as processes of their own: watched, measured, and ended by their id.

Only what is started here is ever ended.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

PATIENCE = 60.0
"""Deadline [s] of what is waited for; generous, for a loaded machine."""

_TICKS = os.sysconf("SC_CLK_TCK")


class ProgramError(RuntimeError):
    """A program did not do what was waited for; the message has the end of what it said."""


class Program:
    """A running program; its output is kept in memory, so that it never blocks.

    ``environment`` is added to that of this process. Raises OSError where there is no such program.
    """

    def __init__(
        self, command: Sequence[str], environment: Mapping[str, str] | None = None
    ) -> None:
        self.name = Path(command[0]).name
        self._stdout = os.memfd_create("stdout")
        self._stderr = os.memfd_create("stderr")
        try:
            # A group of its own, so that a Ctrl-C in the terminal ends this process, which ends it.
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=self._stdout,
                stderr=self._stderr,
                env={**os.environ, **(environment or {})},
                start_new_session=True,
            )
        except BaseException:
            self._forget_output()
            raise
        # Where this process fails, nothing of it goes on.
        atexit.register(self._process.kill)

    @property
    def pid(self) -> int:
        """Id of the process, and of the group of all that it starts."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self._process.poll() is None

    @property
    def exit_code(self) -> int | None:
        """Its exit code, negative the signal that ended it; None while it runs."""
        return self._process.poll()

    @property
    def output(self) -> str:
        """What it has written to its standard output so far."""
        return _content(self._stdout)

    @property
    def errors(self) -> str:
        """What it has written to its standard error so far, where a node's log goes."""
        return _content(self._stderr)

    @property
    def log(self) -> str:
        """Both of them."""
        return self.output + self.errors

    @property
    def last_words(self) -> str:
        """The last lines of what it has written, in one line."""
        return " / ".join(self.log.strip().splitlines()[-3:])

    @property
    def resident_bytes(self) -> int:
        """Memory [B] that it has in use (resident set), without its children's."""
        return resident_bytes(self.pid)

    @property
    def cpu_seconds(self) -> float:
        """Processor time [s] that it has used so far, without its children's."""
        return cpu_seconds(self.pid)

    @property
    def children(self) -> list[int]:
        """Ids of the processes that it has started and that still run."""
        found = []
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                with contextlib.suppress(OSError):  # it has just ended
                    if int(_fields(int(entry.name))[1]) == self.pid:
                        found.append(int(entry.name))
        return found

    def wait_for_log(self, part: str, patience: float = PATIENCE) -> None:
        """Wait until its standard error has this text.

        Raises ProgramError where it has ended before, or after ``patience`` [s].
        """
        deadline = time.monotonic() + patience
        while part not in self.errors:
            if not self.running and part not in self.errors:
                raise ProgramError(f"{self.name} ended before it logged {part!r}: {self.errors}")
            if time.monotonic() > deadline:
                raise ProgramError(f"{self.name} never logged {part!r}: {self.errors}")
            time.sleep(0.02)

    def wait(self, patience: float = PATIENCE) -> int:
        """Wait for its end; returns the exit code. Raises ProgramError after ``patience`` [s]."""
        try:
            return self._process.wait(patience)
        except subprocess.TimeoutExpired:
            raise ProgramError(f"{self.name} did not end within {patience:g} s") from None

    def send_signal(self, number: signal.Signals) -> None:
        """Send it a signal; nothing happens where it has ended."""
        self._process.send_signal(number)

    def kill(self) -> None:
        """End it at once, without a chance to tidy up, and wait until it is gone."""
        self._process.kill()
        self._process.wait(PATIENCE)

    def stop(self, number: signal.Signals = signal.SIGINT, patience: float = PATIENCE) -> int:
        """Ask it to end as Ctrl-C does and return its exit code; killed where it does not end."""
        self.send_signal(number)
        try:
            return self.wait(patience)
        except ProgramError:
            self.kill()
            return self._process.returncode

    def close(self) -> None:
        """End it and forget its output."""
        self.stop()
        self.forget()

    def forget(self) -> None:
        """Forget the output of a program that has ended."""
        self._process.wait(PATIENCE)
        self._forget_output()
        atexit.unregister(self._process.kill)

    def _forget_output(self) -> None:
        os.close(self._stdout)
        os.close(self._stderr)


def node_arguments(
    parameters: Mapping[str, object], remappings: Mapping[str, str] | None = None
) -> list[str]:
    """Arguments of a node; two underscores in the name of a parameter stand for a dot."""
    arguments = ["--ros-args"]
    for name, other in (remappings or {}).items():
        arguments += ["-r", f"{name}:={other}"]
    for name, value in parameters.items():
        written = str(value).lower() if isinstance(value, bool) else value
        arguments += ["-p", f"{name.replace('__', '.')}:={written}"]
    return arguments


def resident_bytes(pid: int) -> int:
    """Memory [B] that a process has in use (resident set), shared libraries included."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def cpu_seconds(pid: int) -> float:
    """Processor time [s] that a process has used so far, without its children's."""
    fields = _fields(pid)
    return (int(fields[11]) + int(fields[12])) / _TICKS


def _content(file: int) -> str:
    return os.pread(file, os.fstat(file).st_size, 0).decode(errors="replace")


def _fields(pid: int) -> list[str]:
    """State, parent's id and the following fields that Linux has of a process."""
    # The name, in parentheses, may hold blanks: the fields are counted from its end.
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
