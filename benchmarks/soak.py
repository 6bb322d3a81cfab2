"""What takes longer than a test may: kills, Ctrl-C, hours of data, hostile input. ``make soak``.

Writes ``build/soak.json`` and prints a table.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks import (
    fuzz,
    hostile_recordings,
    node_soak,
    poisoned_starts,
    program_kills,
)
from benchmarks.figure import Figure, table, write
from mr_damper_ros.processes.blas_threads import keep_one_thread

OUTPUT = Path("build/soak.json")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    keep_one_thread()
    options = _parser().parse_args(arguments)
    parts: dict[str, Callable[[], list[Figure]]] = {
        "fuzz": lambda: fuzz.figures(options.cases, options.seed),
        "recordings": lambda: hostile_recordings.figures(options.recordings, options.seed),
        "kills": lambda: node_soak.kill_figures(options.kills, options.kills, options.seed),
        "many_kills": lambda: program_kills.many_kills(seed=options.seed),
        "campaign_kills": lambda: program_kills.campaign_kills(seed=options.seed),
        "starts": lambda: poisoned_starts.figures(options.starts, seed=options.seed),
        "interrupts": lambda: node_soak.interrupt_figures(options.interrupts, options.seed),
        "soak": lambda: node_soak.stream_figures(options.hours, min(1.0, 0.25 * options.hours)),
    }
    figures: list[Figure] = []
    for name in options.only or parts:
        began = time.monotonic()
        print(f"{name} ...", end=" ", file=sys.stderr, flush=True)
        figures += parts[name]()
        print(f"{time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
        write(figures, options.output)
    print(table(figures))
    print(f"\nwritten to {options.output}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="soak", description="Kill, stream for hours, and feed what is hostile."
    )
    parser.add_argument(
        "--only",
        nargs="+",
        choices=(
            *("fuzz", "recordings", "kills", "many_kills"),
            *("campaign_kills", "starts", "interrupts", "soak"),
        ),
        help="these parts alone",
    )
    parser.add_argument(
        "--hours", type=float, default=8.0, help="of data at 20 x (default %(default)s)"
    )
    parser.add_argument(
        "--kills",
        type=int,
        default=100,
        help="of nodes, and as many of the worker (default %(default)s)",
    )
    parser.add_argument(
        "--interrupts", type=int, default=200, help="of each node (default %(default)s)"
    )
    parser.add_argument(
        "--cases", type=int, default=100_000, help="of hostile input (default %(default)s)"
    )
    parser.add_argument(
        "--recordings",
        type=int,
        default=100,
        help="that say little or are spoilt, to identify from (default %(default)s)",
    )
    parser.add_argument(
        "--starts",
        type=int,
        default=10_000,
        help="from mutated state and parameter files (default %(default)s)",
    )
    parser.add_argument("--seed", type=int, default=0, help="of what is random (default 0)")
    parser.add_argument("--output", type=Path, default=OUTPUT, help="file (default %(default)s)")
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
