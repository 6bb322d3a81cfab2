"""The frame of every study: options, tasks in processes, stored results, and the final page."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy

import mr_damper_ros
from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.processes.files import write_text
from mr_damper_ros.processes.process_pool import Notify, ProcessPool
from mr_damper_ros.report.document import Chapter, styled, write_report
from mr_damper_ros.tools.console import run_tool

Say = Callable[[str], None]
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
    number of repetitions of random methods (0: the default). Raises ValueError for values out of
    range.
    """

    folder: Path
    workers: int = 1
    quick: bool = False
    seed: int = 0
    runs: int = 0
    say: Say = lambda text: None

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
        """``function(**task)`` for every task, in order, whatever the number of processes."""
        return self._computed(name, function, tasks, len(tasks), lambda place, result: None)

    def each_kept(
        self, name: str, function: Callable[..., Any], tasks: Sequence[Task]
    ) -> list[Any]:
        """As :meth:`each` for JSON results, which are stored line by line.

        Stored results are reused until the tasks or the code change.
        """
        keys = [json.dumps(task, sort_keys=True) for task in tasks]
        path = self.folder / "data" / f"{name}-{_code_digest()}.jsonl"
        known = _read(path)
        missing = [place for place, key in enumerate(keys) if key not in known]
        if not missing:
            return [known[key] for key in keys]
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as file:
            file.write("\n")  # begin after the incomplete line of a killed campaign

            def keep(place: int, result: Any) -> None:
                key = keys[missing[place]]
                # A JSON round trip makes new and stored results equal.
                known[key] = json.loads(json.dumps(result))
                file.write(json.dumps([key, result]) + "\n")
                file.flush()

            chosen = [tasks[place] for place in missing]
            try:
                self._computed(name, function, chosen, len(tasks), keep)
            except KeyboardInterrupt:
                self.say("finished tasks are stored: call again to continue")
                raise
        return [known[key] for key in keys]

    def _computed(
        self,
        name: str,
        function: Callable[..., Any],
        tasks: Sequence[Task],
        total: int,
        keep: Callable[[int, Any], None],
    ) -> list[Any]:
        count = total - len(tasks)

        def done(place: int, result: Any) -> None:
            nonlocal count
            count += 1
            keep(place, result)
            # About ten lines for a log.
            if count == total or count % max(len(tasks) // 10, 1) == 0:
                self.say(f"{name}: {count} of {total}")

        with ProcessPool(self.workers) as processes:
            return processes.map(partial(_call, function), tasks, done=done)


def _call(function: Callable[..., Any], task: Task, notify: Notify) -> Any:
    return function(**task)


def _read(path: Path) -> dict[str, Any]:
    known: dict[str, Any] = {}
    for line in path.read_text("utf-8").splitlines() if path.exists() else []:
        try:
            key, result = json.loads(line)
        except ValueError:
            continue  # empty, or incomplete
        known[key] = result
    return known


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
class Part:
    """Results of a part of a report: chapters, a sentence for each, and figures in the document."""

    chapters: Sequence[Chapter]
    headlines: Sequence[str]
    figures: Mapping[str, object] | None = None


@dataclass(frozen=True)
class Study:
    """A study whose ``parts`` are functions that compute a part of its report.

    ``notice`` returns the paragraph above the report. ``quick`` describes what the short variant
    leaves out; ``random`` adds the options of random searches.
    """

    name: str
    description: str
    title: str
    notice: Callable[[Campaign], str]
    parts: Mapping[str, Callable[[Campaign], Part]]
    quick: str
    random: bool = False

    def main(self, arguments: Sequence[str]) -> int:
        """Run the study with these command-line arguments; returns the exit code."""
        return run_tool(self._parser(), self._run, arguments)

    def _parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser(prog=f"studies {self.name}", description=self.description)
        add = parser.add_argument
        names = tuple(self.parts)
        add("--only", choices=names, nargs="+", default=names, help="only these parts")
        add("--quick", action="store_true", help=f"quick variant: {self.quick}")
        workers = "processes; the results do not depend on it (default: one per core)"
        add("--workers", type=int, default=len(os.sched_getaffinity(0)), help=workers)
        add(
            "--output",
            type=Path,
            default=Path("build", self.name),
            metavar="FOLDER",
            help="folder for report.html, figures and tables (default %(default)s)",
        )
        if self.random:
            runs = f"repetitions of random searches (default {RUNS}, quick {QUICK_RUNS})"
            add("--runs", type=int, default=0, help=runs)
            add("--seed", type=int, default=0, help="seed of the random numbers (default 0)")
        return parser

    @one_thread()
    def _run(self, options: argparse.Namespace) -> int:
        began = time.monotonic()
        given = vars(options)
        chances = {name: given[name] for name in ("runs", "seed") if name in given}
        campaign = Campaign(options.output, options.workers, options.quick, say=say, **chances)
        page = self._write(campaign, options.only)
        say("")
        print(f"{page} written in {time.monotonic() - began:.0f} s")
        return 0

    def _write(self, campaign: Campaign, only: Sequence[str]) -> Path:
        """Write ``report.html`` and, if parts have figures, ``<name>.json``; returns the page."""
        document: dict[str, object] = {}
        notice = self.notice(campaign)
        parts: list[Part] = []
        with styled():
            for name, make in self.parts.items():
                if name in only:
                    campaign.say(f"{name} ...")
                    parts.append(make(campaign))
                    if parts[-1].figures:
                        document[name] = parts[-1].figures
            page = write_report(
                campaign.folder,
                self.title,
                notice,
                [sentence for part in parts for sentence in part.headlines],
                [chapter for part in parts for chapter in part.chapters],
            )
        if document:
            text = json.dumps({"quick": campaign.quick, **document}, indent=2, allow_nan=False)
            write_text(campaign.folder / f"{self.name}.json", text + "\n")
        return page


def say(text: str) -> None:
    """Progress display: a single updated line on a terminal, separate lines elsewhere.

    An empty text clears the line.
    """
    if sys.stderr.isatty():
        sys.stderr.write(f"\r{text}\033[K")
    elif text:
        sys.stderr.write(f"{text}\n")
    sys.stderr.flush()
