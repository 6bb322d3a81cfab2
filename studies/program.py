"""The frame of every study: options, tasks in processes, stored results, and the final page."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import pickle
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import scipy

import mr_damper_ros
from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.processes.files import write_bytes, write_text
from mr_damper_ros.processes.process_pool import Notify, ProcessPool
from mr_damper_ros.report.document import Chapter, styled, write_report
from mr_damper_ros.tools.console import run_tool

Task = dict[str, Any]

_FOLDERS = (Path(mr_damper_ros.__file__).parent, Path(__file__).parent)
"""Code on which the results depend."""

_ABOVE = ("nodes", "tools")
"""Subpackages on which no result depends."""

RUNS, QUICK_RUNS = 100, 10
"""Repetitions of random searches."""


@dataclass
class Campaign:
    """One call of a study: its options, and the processes for its tasks.

    ``folder`` receives all output. ``quick`` asks for fewer evaluations and cases. ``runs`` is the
    number of repetitions of random methods (0: the default). ``figures`` receives numbers for the
    document beside the report. Raises ValueError for values out of range.
    """

    folder: Path
    workers: int = 1
    quick: bool = False
    seed: int = 0
    runs: int = 0
    say: Callable[[str], None] = lambda text: None
    figures: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.runs = self.runs or (QUICK_RUNS if self.quick else RUNS)
        for name, least in (("runs", 2), ("workers", 1), ("seed", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} is {getattr(self, name)}: at least {least} is needed")

    def seeds(self, purpose: int, count: int = 0) -> list[list[int]]:
        """Independent seeds (as entropy lists) for ``count`` runs of one purpose."""
        root = np.random.SeedSequence([self.seed, purpose])
        children = root.spawn(count or self.runs)
        return [[int(x) for x in child.generate_state(4)] for child in children]

    def each(self, name: str, function: Callable[..., Any], tasks: Sequence[Task]) -> list[Any]:
        """``function(**task)`` for every task, in order, whatever the number of processes.

        Results are stored, and reused until the tasks or the code change.
        """
        folder = self.folder / "data" / f"{name}-{_code_digest()}"
        with np.printoptions(precision=17, threshold=sys.maxsize):
            keys = [hashlib.sha256(repr(task).encode()).hexdigest()[:16] for task in tasks]
        paths = [folder / f"{key}.pickle" for key in keys]
        missing = [place for place, path in enumerate(paths) if not path.exists()]
        count = len(tasks) - len(missing)

        def keep(place: int, result: Any) -> None:
            nonlocal count
            write_bytes(paths[missing[place]], pickle.dumps(result))
            count += 1
            # About ten lines for a log.
            if count == len(tasks) or count % max(len(missing) // 10, 1) == 0:
                self.say(f"{name}: {count} of {len(tasks)}")

        try:
            with ProcessPool(self.workers) as processes:
                given = [tasks[place] for place in missing]
                processes.map(partial(_call, function), given, done=keep)
        except KeyboardInterrupt:
            self.say("finished tasks are stored: call again to continue")
            raise
        return [pickle.loads(path.read_bytes()) for path in paths]


def _call(function: Callable[..., Any], task: Task, notify: Notify) -> Any:
    return function(**task)


def code_files() -> list[Path]:
    """The files of code and tables on which the results depend."""
    return [
        path
        for folder in _FOLDERS
        for path in sorted(folder.rglob("*"))
        if path.suffix in (".py", ".csv") and path.relative_to(folder).parts[0] not in _ABOVE
    ]


@lru_cache(maxsize=1)
def _code_digest() -> str:
    """Digest of the code on which the results depend, taken when the program starts."""
    digest = hashlib.sha256(f"{sys.version} {np.__version__} {scipy.__version__}".encode())
    for path in code_files():
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()[:12]


@dataclass(frozen=True)
class Study:
    """A study whose ``parts`` name functions that return the chapters of a part of its report.

    The modules of these functions are loaded when the part is made. ``notice`` returns the
    paragraph above the report. ``quick`` describes what the short variant leaves out; ``random``
    adds the options of random searches.
    """

    name: str
    description: str
    title: str
    notice: Callable[[Campaign], str]
    parts: Mapping[str, str]
    quick: str
    random: bool = False

    def main(self, arguments: Sequence[str]) -> int:
        """Run the study with these command-line arguments; returns the exit code."""
        return run_tool(self._parser(), self._run, arguments)

    def _parser(self) -> argparse.ArgumentParser:
        told = f"{self.description} Results are stored, so a stopped study continues from them."
        parser = argparse.ArgumentParser(prog=f"studies {self.name}", description=told)
        add = parser.add_argument
        names = tuple(self.parts)
        add("--only", choices=names, nargs="+", default=names, help="only these parts")
        add("--quick", action="store_true", help=f"quick variant: {self.quick}")
        workers = "processes; the results do not depend on it (default: one per core)"
        add("--workers", type=int, default=len(os.sched_getaffinity(0)), help=workers)
        output = "folder for report.html, figures and tables (default %(default)s)"
        place = Path("build", self.name)
        add("--output", type=Path, default=place, metavar="FOLDER", help=output)
        if self.random:
            runs = f"repetitions of random searches (default {RUNS}, quick {QUICK_RUNS})"
            add("--runs", type=int, default=0, help=runs)
            add("--seed", type=int, default=0, help="seed of the random numbers (default 0)")
        return parser

    @one_thread()
    def _run(self, options: argparse.Namespace) -> int:
        """Write ``report.html`` and, if parts have figures, ``<name>.json``."""
        began = time.monotonic()
        seed, runs = getattr(options, "seed", 0), getattr(options, "runs", 0)
        campaign = Campaign(options.output, options.workers, options.quick, seed, runs, say)
        notice = self.notice(campaign)
        chapters: list[Chapter] = []
        with styled():
            for name, part in self.parts.items():
                if name in options.only:
                    say(f"{name} ...")
                    module, _, function = part.rpartition(".")
                    chapters += getattr(import_module(f"studies.{module}"), function)(campaign)
            page = write_report(campaign.folder, self.title, notice, chapters)
        if campaign.figures:
            document = {"quick": campaign.quick, **campaign.figures}
            text = json.dumps(document, indent=2, allow_nan=False)
            write_text(campaign.folder / f"{self.name}.json", text + "\n")
        say("")
        print(f"{page} written in {time.monotonic() - began:.0f} s")
        return 0


def say(text: str) -> None:
    """Progress display: a single updated line on a terminal, separate lines elsewhere.

    An empty text clears the line.
    """
    if sys.stderr.isatty():
        sys.stderr.write(f"\r{text}\033[K")
    elif text:
        sys.stderr.write(f"{text}\n")
    sys.stderr.flush()
