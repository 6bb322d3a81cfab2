"""A measured figure with its bar and its definition."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

Value = float | list[float] | None
Pair = tuple[float, float]


@dataclass(frozen=True)
class Figure:
    """One figure: ``key`` in the JSON file, ``value``, and what it must reach.

    ``bar`` is a pair (low, high) that the value, or every value of a list, must lie within, or a
    list of pairs, one for each value; None where the figure is only reported. ``definition`` says
    in one or two sentences what was measured; ``value`` is None where it was not, and ``note`` then
    says why.
    """

    key: str
    value: Value
    definition: str
    bar: Pair | list[Pair] | None = None
    note: str = ""

    @property
    def reached(self) -> str:
        """``yes``, ``no``, or ``-`` where there is nothing to compare."""
        if self.value is None or self.bar is None:
            return "-"
        values = self.value if isinstance(self.value, list) else [self.value]
        bars = self.bar if isinstance(self.bar, list) else [self.bar] * len(values)
        within = [low <= each <= high for each, (low, high) in zip(values, bars, strict=True)]
        return "yes" if all(within) else "no"


def write(figures: Sequence[Figure], place: Path) -> None:
    """Write what has been measured so far as one JSON object: what comes next may fail."""
    place.parent.mkdir(parents=True, exist_ok=True)
    document = {figure.key: _number(figure.value) for figure in figures}
    place.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _number(value: Value) -> Value:
    """The value as JSON can hold it: what is infinite was not reached at all."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def table(figures: Sequence[Figure]) -> str:
    """Lines of text: key, figure, bar, reached, definition."""
    rows = [("key", "figure", "bar", "reached", "definition")]
    for figure in figures:
        definition = f"{figure.definition} {figure.note}".strip()
        rows.append((figure.key, _shown(figure.value), _bar(figure), figure.reached, definition))
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
    if isinstance(value, list):
        return ", ".join(f"{entry:.4g}" for entry in value)
    return f"{value:.4g}"


def _bar(figure: Figure) -> str:
    if figure.bar is None:
        return "reported"
    bars = figure.bar if isinstance(figure.bar, list) else [figure.bar]
    return ", ".join(_range(*each) for each in bars)


def _range(low: float, high: float) -> str:
    if high == float("inf"):
        return f">= {low:g}"
    if low in (0.0, float("-inf")):
        return f"<= {high:g}"
    return f"{low:g} to {high:g}"
