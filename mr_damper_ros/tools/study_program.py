"""What the programs share that compute for long and write one report."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from mr_damper_ros.processes.blas_threads import one_thread


def study_parser(
    prog: str, description: str, parts: Sequence[str], quick: str, folder: str
) -> argparse.ArgumentParser:
    """Options of a program; ``quick`` says what the short study leaves out."""
    parser = argparse.ArgumentParser(prog=prog, description=description)
    parser.add_argument(
        "--only", choices=parts, nargs="+", default=parts, help="only these parts of the report"
    )
    parser.add_argument("--quick", action="store_true", help=f"{quick}: a first look")
    add_workers(parser)
    parser.add_argument(
        "--output",
        type=Path,
        default=Path(folder),
        metavar="FOLDER",
        help="where report.html, figures and tables go (default %(default)s)",
    )
    return parser


def add_workers(parser: argparse.ArgumentParser) -> None:
    """The option for the number of processes."""
    parser.add_argument(
        "--workers",
        type=int,
        default=len(os.sched_getaffinity(0)),
        help="processes; the results do not depend on it (default: one per core)",
    )


def write_page(build: Callable[[Callable[[str], None]], Path]) -> int:
    """Build a page, told line by line how far it is, and say where it is; the exit code."""
    began = time.monotonic()
    with one_thread():
        page = build(lambda text: print(text, file=sys.stderr))
    print(f"{page} written in {time.monotonic() - began:.0f} s")
    return 0
