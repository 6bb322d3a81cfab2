"""Measure all figures, write ``build/bench.json`` and print a table: ``make bench``.

With ``--soak`` (``make soak``), run the long trials instead: kills, Ctrl-C, hours of data and
hostile input. Their figures go to ``build/soak.json``.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from benchmarks.figure import Measured, Value
from mr_damper_ros.processes.blas_threads import keep_one_thread
from mr_damper_ros.processes.programs import signal_at_death_of

_SOAK_OPTIONS: dict[str, tuple[float | int, str]] = {
    "hours": (8.0, "of data at 20 x"),
    "kills": (100, "of nodes, and as many of the worker"),
    "interrupts": (200, "of each node"),
    "cases": (100_000, "of hostile input"),
    "recordings": (100, "that say little or are spoilt, to identify from"),
    "starts": (10_000, "from mutated state and parameter files"),
    "seed": (0, "of what is random"),
}


class Figure(NamedTuple):
    """One figure: its key in the JSON file, its value, its bars, its definition and a note.

    A bar is a pair (low, high). One limits the value, or every value of a list; several limit one
    value each. ``value`` is None if it was not measured; ``note`` then gives the reason.
    """

    key: str
    value: Value
    bars: list[tuple[float, float]]
    definition: str
    note: str

    @property
    def values(self) -> list[float]:
        """The value as a list, empty if it was not measured."""
        if self.value is None:
            return []
        return self.value if isinstance(self.value, list) else [self.value]

    def row(self) -> list[str]:
        """Cells of the table: key, figure, bar, reached and definition."""
        shown = ", ".join(f"{each:.4g}" for each in self.values) or "not measured"
        reached = "-"
        if self.values and self.bars:
            bars = self.bars * (len(self.values) if len(self.bars) == 1 else 1)
            pairs = zip(self.values, bars, strict=True)
            reached = "yes" if all(low <= each <= high for each, (low, high) in pairs) else "no"
        limits = ", ".join(_range(*each) for each in self.bars) or "reported"
        return [self.key, shown, limits, reached, f"{self.definition} {self.note}".strip()]


def _range(low: float, high: float) -> str:
    if math.isinf(high):
        return f">= {low:g}"
    return f"<= {high:g}" if low in (0.0, -math.inf) else f"{low:g} to {high:g}"


def parts(program: str) -> dict[str, dict[str, Any]]:
    """Parts of ``bench`` or ``soak`` by name, as figures.yaml has them."""
    path = Path(__file__).with_name("figures.yaml")
    table: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    return table[program]


def measure(part: dict[str, Any], arguments: Sequence[Any], seed: int = 0) -> list[Figure]:
    """Figures of one part, measured in a separate process; raises ValueError for wrong keys.

    Only a part that is ``seeded`` receives the seed.

    Fast DDS reads the network interfaces once per process. A process that already had a participant
    would not see the lossy link.
    """
    named = {"seed": seed} if part.get("seeded") else {}
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        measured = process.submit(_measured, part["by"], tuple(arguments), named).result()
    if wrong := measured.keys() ^ part["figures"].keys():
        raise ValueError(f"{part['by']} or figures.yaml lacks {', '.join(sorted(wrong))}")
    figures = []
    for key, told in measured.items():
        value, note = told if isinstance(told, tuple) else (told, "")
        known = part["figures"][key]
        bar = known.get("bar", [])
        bars = bar if not bar or isinstance(bar[0], list) else [bar]
        figures.append(Figure(key, value, bars, known["is"], note))
    return figures


def _measured(by: str, arguments: tuple[Any, ...], named: dict[str, int]) -> Measured:
    # Leave in order when stopped or when the parent ends, or the programs of the part, in sessions
    # of their own, would go on.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    signal_at_death_of(os.getppid(), signal.SIGTERM)
    keep_one_thread()
    module, _, name = by.partition(".")
    try:
        return getattr(import_module(f"benchmarks.{module}"), name)(*arguments, **named)
    except SystemExit:
        os._exit(1)  # the pool would wait for the next call


def write(figures: Sequence[Figure], place: Path) -> None:
    """Write the figures measured so far as one JSON object, without values that are infinite."""
    place.parent.mkdir(parents=True, exist_ok=True)
    document = {
        each.key: each.value if all(map(math.isfinite, each.values)) else None for each in figures
    }
    place.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")


def table(figures: Sequence[Figure]) -> str:
    """Table as text with the columns key, figure, bar, reached and definition."""
    rows = [["key", "figure", "bar", "reached", "definition"], *(each.row() for each in figures)]
    widths = [max(map(len, column)) for column in list(zip(*rows, strict=True))[:4]] + [0]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        for row in rows
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    soak = "--soak" in (sys.argv if arguments is None else arguments)
    known = parts("soak" if soak else "bench")
    options = _parser(soak, list(known)).parse_args(arguments)
    keep_one_thread()
    figures: list[Figure] = []
    failed = []
    for name in options.only or known:
        part = known[name]
        began = time.monotonic()
        print(f"{name} ...", end=" ", file=sys.stderr, flush=True)
        given = [getattr(options, option) for option in part.get("options", ())]
        shorter = next((kind for kind in ("quick", "third") if getattr(options, kind)), "")
        try:
            measured = measure(part, part.get(shorter, given), options.seed)
        except Exception as error:  # the other parts are still measured
            failed.append(f"{name} failed: {type(error).__name__}: {error}")
        else:
            is_third = shorter == "third" and shorter in part
            told = "A THIRD OF THE CASES. " * is_third
            figures += [each._replace(note=told + each.note) for each in measured]
        print(f"{time.monotonic() - began:.1f} s", file=sys.stderr, flush=True)
        write(figures, options.output)
    if options.quick:
        print("QUICK RUN: fewer repetitions and shorter recordings; these are not the figures.")
    print(f"{table(figures)}\n\nwritten to {options.output}", *failed, sep="\n")
    return int(bool(failed))


def _parser(soak: bool, names: Sequence[str]) -> argparse.ArgumentParser:
    output = Path("build", "soak.json" if soak else "bench.json")
    parser = argparse.ArgumentParser(prog="bench", description=__doc__)
    add = parser.add_argument
    add("--soak", action="store_true", help="soak instead of measuring")
    add("--only", nargs="+", choices=names, metavar="NAME", help=f"of {', '.join(names)}")
    add("--output", type=Path, default=output, help="file (default %(default)s)")
    if not soak:
        shorter = parser.add_mutually_exclusive_group()
        quick = "shorter, for development: not the real figures"
        shorter.add_argument("--quick", action="store_true", help=quick)
        third = "of parts over ten minutes, every third case, the first by the seed"
        shorter.add_argument("--third", action="store_true", help=third)
        add("--seed", type=int, default=0, help="of what is random in data that are not timed")
        return parser
    parser.set_defaults(quick=False, third=False)
    for name, (default, text) in _SOAK_OPTIONS.items():
        add(f"--{name}", type=type(default), default=default, help=f"{text} (default %(default)s)")
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
