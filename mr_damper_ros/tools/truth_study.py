"""``truth_study``: every force law judged on recordings and a benchmark, in one report."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from mr_damper_ros.study.truth_report import ALL, PARTS, SHORT, build_truth
from mr_damper_ros.tools.console import run_tool


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    return run_tool(_parser(), _judge, arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="truth_study",
        description="Judge every force law on the recordings in the folder that the variable "
        "MR_DAMPER_DATA names, where it is set, and on the re-created hysteretic benchmark of Noël "
        "and Schoukens; write one report, report.html, and its figures, truth.json.",
    )
    parser.add_argument(
        "--only", choices=PARTS, nargs="+", default=PARTS, help="only these parts of the report"
    )
    parser.add_argument(
        "--quick", action="store_true", help="few laws, few and short records: a first look"
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
        default=Path("build/truth"),
        metavar="FOLDER",
        help="where report.html, figures and tables go (default %(default)s)",
    )
    return parser


def _judge(options: argparse.Namespace) -> int:
    began = time.monotonic()
    extent = SHORT if options.quick else ALL
    page = build_truth(options.output, options.only, options.workers, extent, _say)
    print(f"{page} written in {time.monotonic() - began:.0f} s")
    return 0


def _say(text: str) -> None:
    sys.stderr.write(f"{text}\n")
