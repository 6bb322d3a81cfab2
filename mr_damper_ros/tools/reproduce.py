"""``reproduce``: the thesis' results made again, in one report next to the published ones."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.thesis.campaign import Campaign, Settings
from mr_damper_ros.thesis.sections import SECTIONS, build
from mr_damper_ros.tools.console import run_tool
from mr_damper_ros.tools.study_program import add_workers

_RUNS, _QUICK_RUNS = 100, 10


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    return run_tool(_parser(), _reproduce, arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="reproduce",
        description="Make the results of the thesis again, on runs re-synthesised from its "
        "published parameter sets, and write one report. What was computed earlier is not "
        "computed again, so a stopped campaign goes on where it was.",
        epilog="With the variable MR_DAMPER_DATA set to a folder that holds utfsm/processed, the "
        "models are compared on those recordings too.",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help=f"{_QUICK_RUNS} runs instead of {_RUNS}, fewer evaluations and cases",
    )
    parser.add_argument(
        "--runs",
        type=int,
        help=f"repetitions of random searches (default {_RUNS}, quick {_QUICK_RUNS})",
    )
    add_workers(parser)
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers (default 0)")
    parser.add_argument(
        "--output",
        type=Path,
        default=Path("build/thesis"),
        metavar="FOLDER",
        help="where report.html, figures, tables and kept results go (default %(default)s)",
    )
    parser.add_argument(
        "--only",
        choices=[section.name for section in SECTIONS],
        nargs="+",
        help="only these parts of the report",
    )
    return parser


@one_thread()
def _reproduce(options: argparse.Namespace) -> int:
    place = os.environ.get("MR_DAMPER_DATA")
    recordings = Path(place) / "utfsm" / "processed" if place else None
    if recordings is not None and not recordings.is_dir():
        raise ValueError(
            f"MR_DAMPER_DATA is {place}, which holds no utfsm/processed: mend or unset it"
        )
    default = _QUICK_RUNS if options.quick else _RUNS
    settings = Settings(
        folder=options.output,
        runs=default if options.runs is None else options.runs,
        workers=options.workers,
        seed=options.seed,
        quick=options.quick,
        recordings=recordings,
    )
    began = time.monotonic()
    try:
        page = build(Campaign(settings, _say), options.only)
    except KeyboardInterrupt:
        sys.stderr.write("\nwhat is done is kept: call again to go on")
        raise
    if sys.stderr.isatty():
        sys.stderr.write("\r\033[K")
    print(f"{page} written in {time.monotonic() - began:.0f} s")
    return 0


def _say(text: str) -> None:
    """One line on a terminal, lines elsewhere."""
    if sys.stderr.isatty():
        sys.stderr.write(f"\r{text}\033[K")
    else:
        sys.stderr.write(f"{text}\n")
    sys.stderr.flush()
