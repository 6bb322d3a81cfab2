"""Shared parts of the studies: options, progress and the final page."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.processes.files import write_text
from mr_damper_ros.processes.process_pool import ProcessPool, Tell
from mr_damper_ros.report.document import Chapter, styled, write_report
from mr_damper_ros.tools.console import run_tool

Task = TypeVar("Task")
Result = TypeVar("Result")
Say = Callable[[str], None]


@dataclass(frozen=True)
class Study:
    """A study whose ``build`` computes the selected parts and returns the page of the report.

    ``quick`` describes what the short variant leaves out. ``add_options`` declares further options.
    """

    name: str
    description: str
    parts: Sequence[str]
    quick: str
    build: Callable[[argparse.Namespace, Say], Path]
    add_options: Callable[[argparse.ArgumentParser], None] = lambda parser: None

    def main(self, arguments: Sequence[str]) -> int:
        """Run the study with these command-line arguments; returns the exit code."""
        return run_tool(self._parser(), self._run, arguments)

    def _parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser(prog=f"studies {self.name}", description=self.description)
        parser.add_argument(
            "--only",
            choices=self.parts,
            nargs="+",
            default=self.parts,
            help="only these parts of the report",
        )
        parser.add_argument("--quick", action="store_true", help=f"{self.quick}: a first look")
        parser.add_argument(
            "--workers",
            type=int,
            default=len(os.sched_getaffinity(0)),
            help="processes; the results do not depend on it (default: one per core)",
        )
        parser.add_argument(
            "--output",
            type=Path,
            default=Path("build", self.name),
            metavar="FOLDER",
            help="where report.html, figures and tables go (default %(default)s)",
        )
        self.add_options(parser)
        return parser

    @one_thread()
    def _run(self, options: argparse.Namespace) -> int:
        began = time.monotonic()
        page = self.build(options, _say)
        if sys.stderr.isatty():
            sys.stderr.write("\r\033[K")
        print(f"{page} written in {time.monotonic() - began:.0f} s")
        return 0


@dataclass(frozen=True)
class Part:
    """Results of a part of a report: chapters, a sentence for each, and figures in the document."""

    chapters: Sequence[Chapter]
    headlines: Sequence[str]
    figures: Mapping[str, object]


Make = Callable[[ProcessPool, bool, Say], Part]
"""Function that computes a part from the processes, the choice of the quick variant, and a function
that reports progress."""


def write_parts(
    options: argparse.Namespace,
    say: Say,
    name: str,
    title: str,
    notice: str,
    makes: Mapping[str, Make],
) -> Path:
    """Compute the selected parts and write ``report.html`` and ``<name>.json``.

    Returns the page.
    """
    document: dict[str, object] = {"quick": options.quick}
    parts: list[Part] = []
    with ProcessPool(options.workers) as pool, styled():
        for part, make in makes.items():
            if part in options.only:
                say(f"{part} ...")
                parts.append(make(pool, options.quick, say))
                if parts[-1].figures:
                    document[part] = parts[-1].figures
        page = write_report(
            options.output,
            title,
            notice,
            [sentence for part in parts for sentence in part.headlines],
            [chapter for part in parts for chapter in part.chapters],
        )
    text = json.dumps(document, indent=2, allow_nan=False)
    write_text(options.output / f"{name}.json", text + "\n")
    return page


def _say(text: str) -> None:
    """Progress display: a single updated line on a terminal, separate lines elsewhere."""
    sys.stderr.write(f"\r{text}\033[K" if sys.stderr.isatty() else f"{text}\n")
    sys.stderr.flush()


def each_result(
    pool: ProcessPool,
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    name: str,
    say: Say,
) -> dict[Task, Result]:
    """Results by their tasks."""
    count = 0

    def done(_: int, __: Result) -> None:
        nonlocal count
        count += 1
        say(f"{name}: {count} of {len(tasks)}")

    work = [(function, task) for task in tasks]
    results = pool.map(_call, work, done=done)
    return {task: result for task, result in zip(tasks, results, strict=True) if result is not None}


def _call(work: tuple[Callable[[Task], Result], Task], tell: Tell) -> Result:
    function, task = work
    return function(task)
