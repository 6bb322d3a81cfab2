"""Identified numbers with their errors, and tables of them for a terminal and for a notebook."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from mr_damper_ros.models.parameter_set import ParameterSet


@dataclass(frozen=True)
class Estimate:
    """A number with its standard error, both in ``unit``; NaN where the error is unknown.

    ``observable``: whether the data determined it; else it kept the value of the start.
    ``discrepancy``: the part of the standard error that comes from what the law cannot follow, and
    that only another motion shows; NaN where it is unknown.
    """

    value: float
    standard_error: float
    unit: str
    observable: bool = True
    meaning: str = ""
    discrepancy: float = math.nan

    def __str__(self) -> str:
        if not self.observable:
            return f"{self.value:.6g} {self.unit}, not observable"
        return f"{self.value:.6g} ± {self.standard_error:.2g} {self.unit}"


Estimates = Mapping[str, Estimate]


def parameter_estimates(found: ParameterSet) -> dict[str, Estimate]:
    """The parameters of a set by name."""
    return {
        parameter.name: Estimate(
            value, error, parameter.unit, bool(observable), discrepancy=discrepancy
        )
        for parameter, value, error, observable, discrepancy in zip(
            found.law.parameters,
            found.values.tolist(),
            found.standard_errors.tolist(),
            found.observable,
            found.discrepancies.tolist(),
            strict=True,
        )
    }


def text_table(heading: str, estimates: Estimates) -> str:
    """A table for a terminal: name, value, standard error, discrepancy in it, unit, meaning."""
    width = max(map(len, (heading, *estimates)))
    lines = [f"{heading:>{width}} {'value':>12}  standard error  discrepancy  unit"]
    lines += [
        f"{name:>{width}} {entry.value:12.6g}  {_error(entry):>14}  {_discrepancy(entry):>11}  "
        f"{entry.unit:<4}  "
        f"{entry.meaning}".rstrip()
        for name, entry in estimates.items()
    ]
    return "\n".join(lines)


def html_table(heading: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table for a notebook; all cells are text."""
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in heading)
    body = "".join(
        "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def html_estimates(heading: str, estimates: Estimates) -> str:
    """The table of :func:`text_table` for a notebook."""
    rows = [
        (name, f"{entry.value:.6g}", _error(entry), _discrepancy(entry), entry.unit, entry.meaning)
        for name, entry in estimates.items()
    ]
    return html_table((heading, "value", "standard error", "discrepancy", "unit", ""), rows)


def _error(entry: Estimate) -> str:
    if not entry.observable:
        return "not observable"
    return f"{entry.standard_error:.3g}" if math.isfinite(entry.standard_error) else "unknown"


def _discrepancy(entry: Estimate) -> str:
    if not entry.observable:
        return ""
    return f"{entry.discrepancy:.3g}" if math.isfinite(entry.discrepancy) else "unknown"


def as_json(value: float) -> float | None:
    """The value as JSON can hold it: null where it is infinite or unknown."""
    return value if math.isfinite(value) else None
