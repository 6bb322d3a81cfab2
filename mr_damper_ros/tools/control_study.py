"""``control_study``: controllers of the damper side by side on emulated plants, in one report."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from mr_damper_ros.study.control_report import FULL, PARTS, QUICK, build_report
from mr_damper_ros.tools.console import run_tool


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    return run_tool(_parser(), _study, arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="control_study",
        description="Simulate a quarter car on roads of ISO 8608 and buildings in earthquakes, "
        "with an emulated MR damper under several controllers, and write one report.",
    )
    parser.add_argument(
        "--only", choices=PARTS, nargs="+", default=PARTS, help="only these parts of the report"
    )
    parser.add_argument(
        "--quick", action="store_true", help="drives and earthquakes cut short: a first look"
    )
    parser.add_argument(
        "--workers",
        type=int,
        default=len(os.sched_getaffinity(0)),
        help="processes; the results do not depend on it (default: one per core)",
    )
    parser.add_argument(
        "--output",
        type=Path,
        default=Path("build/control"),
        metavar="FOLDER",
        help="where report.html, figures and tables go (default %(default)s)",
    )
    return parser


def _study(options: argparse.Namespace) -> int:
    began = time.monotonic()
    extent = QUICK if options.quick else FULL
    page = build_report(options.output, options.only, options.workers, extent, _say)
    print(f"{page} written in {time.monotonic() - began:.0f} s")
    return 0


def _say(text: str) -> None:
    sys.stderr.write(f"{text}\n")
