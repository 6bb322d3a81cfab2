"""Measured figures; ``figures.yaml`` lists all of them with their bars and definitions.

Each part of ``make bench`` or ``make soak`` is a function that returns the values of its figures by
key, with or without a note.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import yaml

Value = float | list[float] | None
Pair = tuple[float, float]
Measured = dict[str, Value | tuple[Value, str]]

Job = TypeVar("Job")
Result = TypeVar("Result")

PROCESSES = 2
"""Number of cores on which the figures are measured."""


@dataclass(frozen=True)
class Figure:
    """One figure with its ``key`` in the JSON file, its ``value`` and its ``bar``.

    ``bar`` is a pair (low, high) that limits the value, or every value of a list, or it is a list
    of pairs, one for each value. It is None if the figure is only reported. ``value`` is None if it
    was not measured; ``note`` then gives the reason.
    """

    key: str
    value: Value
    definition: str
    bar: Pair | list[Pair] | None = None
    note: str = ""

    @property
    def reached(self) -> str:
        """``yes`` or ``no``; ``-`` without a value or a bar."""
        if self.value is None or self.bar is None:
            return "-"
        values = self.value if isinstance(self.value, list) else [self.value]
        bars = self.bar if isinstance(self.bar, list) else [self.bar] * len(values)
        within = [low <= each <= high for each, (low, high) in zip(values, bars, strict=True)]
        return "yes" if all(within) else "no"


@dataclass(frozen=True)
class Part:
    """Figures that one function measures.

    ``by`` is ``module.function``. ``quick`` are its arguments for a short run, whose figures are
    not representative. ``options`` names the arguments that the command line sets. ``figures`` has
    the bar and the definition of each key.
    """

    by: str
    figures: Mapping[str, tuple[Any, str]]
    quick: Sequence[Any] = ()
    options: Sequence[str] = ()

    def figures_of(self, measured: Measured) -> list[Figure]:
        """Measured figures with bars and definitions; raises ValueError for unknown keys."""
        if measured.keys() - self.figures.keys():
            raise ValueError(f"{self.by} has measured {sorted(measured)}: not in figures.yaml")
        found = []
        for key, told in measured.items():
            value, note = told if isinstance(told, tuple) else (told, "")
            bar, definition = self.figures[key]
            found.append(Figure(key, value, definition, bar, note))
        return found


@cache
def parts(program: str) -> dict[str, Part]:
    """Parts of ``bench`` or ``soak`` by name, in the order of the table."""
    table = yaml.safe_load(Path(__file__).with_name("figures.yaml").read_text(encoding="utf-8"))
    return {
        name: Part(
            part["by"],
            {key: (_bar(each.get("bar")), each["is"]) for key, each in part["figures"].items()},
            part.get("quick", ()),
            part.get("options", ()),
        )
        for name, part in table[program].items()
    }


def _bar(given: Any) -> Pair | list[Pair] | None:
    if given is None:
        return None
    if isinstance(given[0], list):
        return [(float(low), float(high)) for low, high in given]
    return float(given[0]), float(given[1])


def in_processes(
    work: Callable[[Job], Result], jobs: Sequence[Job], processes: int = PROCESSES
) -> list[Result]:
    """Results of the jobs in order, from fresh processes; with one process, from this process."""
    if processes == 1:
        return [work(job) for job in jobs]
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        return list(pool.map(work, jobs))


def write(figures: Sequence[Figure], place: Path) -> None:
    """Write the figures measured so far as one JSON object, in case a later part fails."""
    place.parent.mkdir(parents=True, exist_ok=True)
    document = {figure.key: _number(figure.value) for figure in figures}
    place.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _number(value: Value) -> Value:
    """The value in a form that JSON supports; an infinite value was never reached."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def table(figures: Sequence[Figure]) -> str:
    """Table as text with the columns key, figure, bar, reached and definition."""
    rows = [("key", "figure", "bar", "reached", "definition")]
    for figure in figures:
        definition = f"{figure.definition} {figure.note}".strip()
        rows.append((figure.key, _shown(figure.value), _bars(figure), figure.reached, definition))
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    return "\n".join(
        "  ".join(
            [*(cell.ljust(width) for cell, width in zip(row[:4], widths, strict=True)), row[4]]
        )
        for row in rows
    )


def _shown(value: Value) -> str:
    if value is None:
        return "not measured"
    return ", ".join(f"{each:.4g}" for each in (value if isinstance(value, list) else [value]))


def _bars(figure: Figure) -> str:
    if figure.bar is None:
        return "reported"
    bars = figure.bar if isinstance(figure.bar, list) else [figure.bar]
    return ", ".join(_range(*each) for each in bars)


def _range(low: float, high: float) -> str:
    if math.isinf(high):
        return f">= {low:g}"
    return f"<= {high:g}" if low in (0.0, -math.inf) else f"{low:g} to {high:g}"
