"""Measure all figures, write ``build/bench.json`` and print a table: ``make bench``.

With ``--soak`` (``make soak``), run the long trials instead: kills, Ctrl-C, hours of data and
hostile input. Their figures go to ``build/soak.json``.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benchmarks.figure import Figure, Measured, Part, parts, table, write
from mr_damper_ros.processes.blas_threads import keep_one_thread

_SOAK_OPTIONS: dict[str, tuple[float | int, str]] = {
    "hours": (8.0, "of data at 20 x"),
    "kills": (100, "of nodes, and as many of the worker"),
    "program_kills": (50, "of identify_many, and as many of a campaign"),
    "interrupts": (200, "of each node"),
    "cases": (100_000, "of hostile input"),
    "recordings": (100, "that say little or are spoilt, to identify from"),
    "starts": (10_000, "from mutated state and parameter files"),
    "seed": (0, "of what is random"),
}


def measure(part: Part, arguments: Sequence[Any]) -> list[Figure]:
    """Figures of one part, measured in a separate process.

    Fast DDS reads the network interfaces once per process. A process that already had a participant
    would not see the lossy link.
    """
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        measured = process.submit(_measured, part.by, tuple(arguments)).result()
    return part.figures_of(measured)


def _measured(by: str, arguments: tuple[Any, ...]) -> Measured:
    # Leave in order, or the programs of the part, in sessions of their own, would go on.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    keep_one_thread()
    module, _, name = by.partition(".")
    found: Measured = getattr(import_module(f"benchmarks.{module}"), name)(*arguments)
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    soak = "--soak" in (sys.argv if arguments is None else arguments)
    known = parts("soak" if soak else "bench")
    options = _parser(soak, list(known)).parse_args(arguments)
    keep_one_thread()
    figures: list[Figure] = []
    for name in options.only or known:
        part = known[name]
        began = time.monotonic()
        print(f"{name} ...", end=" ", file=sys.stderr, flush=True)
        given = [getattr(options, option) for option in part.options]
        figures += measure(part, part.quick if not soak and options.quick else given)
        print(f"{time.monotonic() - began:.1f} s", file=sys.stderr, flush=True)
        write(figures, options.output)
    if not soak and options.quick:
        print("QUICK RUN: fewer repetitions and shorter recordings; these are not the figures.")
    print(table(figures))
    print(f"\nwritten to {options.output}")
    return 0


def _parser(soak: bool, names: Sequence[str]) -> argparse.ArgumentParser:
    output = Path("build", "soak.json" if soak else "bench.json")
    parser = argparse.ArgumentParser(prog="bench", description=__doc__)
    parser.add_argument("--soak", action="store_true", help="soak instead of measuring")
    parser.add_argument(
        "--only", nargs="+", choices=names, metavar="NAME", help=f"of {', '.join(names)}"
    )
    parser.add_argument("--output", type=Path, default=output, help="file (default %(default)s)")
    if not soak:
        parser.add_argument(
            "--quick", action="store_true", help="shorter, for development: not the real figures"
        )
        return parser
    for name, (default, text) in _SOAK_OPTIONS.items():
        parser.add_argument(
            f"--{name}", type=type(default), default=default, help=f"{text} (default %(default)s)"
        )
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
