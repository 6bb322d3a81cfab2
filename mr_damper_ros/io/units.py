"""Units of recorded quantities and the columns of a record, as users write them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.signals.arrays import Array

_G = 9.80665
_INCH = 0.0254
_POUND_FORCE = 0.45359237 * _G

# Factor and offset: SI value (temperature: °C) = factor * value + offset.
UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "time": {"s": (1.0, 0.0), "ms": (1e-3, 0.0), "us": (1e-6, 0.0), "min": (60.0, 0.0)},
    "displacement": {
        "m": (1.0, 0.0),
        "cm": (1e-2, 0.0),
        "mm": (1e-3, 0.0),
        "um": (1e-6, 0.0),
        "in": (_INCH, 0.0),
    },
    "velocity": {
        "m/s": (1.0, 0.0),
        "cm/s": (1e-2, 0.0),
        "mm/s": (1e-3, 0.0),
        "in/s": (_INCH, 0.0),
    },
    "force": {
        "N": (1.0, 0.0),
        "kN": (1e3, 0.0),
        "kgf": (_G, 0.0),
        "lbf": (_POUND_FORCE, 0.0),
    },
    "current": {"A": (1.0, 0.0), "mA": (1e-3, 0.0)},
    "temperature": {
        "degC": (1.0, 0.0),
        "K": (1.0, -273.15),
        "degF": (5.0 / 9.0, -160.0 / 9.0),
    },
}
"""Quantities that a column may hold, and the units known for each."""

SKIPPED = "-"


class ColumnError(ValueError):
    """A description of columns that cannot be used; the message says what to change."""


@dataclass(frozen=True)
class Column:
    """One column of a record: its ``quantity`` and how to bring its numbers to SI units.

    ``header`` is the name at the head of the column, or empty: then ``position``, from 0, tells
    where it is.
    """

    quantity: str
    factor: float
    offset: float
    position: int
    header: str = ""

    def to_si(self, values: Array) -> Array:
        """Values in SI units (temperature in °C), shape (n,)."""
        return np.asarray(values, dtype=np.float64) * self.factor + self.offset


def parse_columns(text: str) -> tuple[Column, ...]:
    """Columns from a description such as ``time:s,displacement:mm,-,force:980.665*N``.

    Entries stand for the columns of the file from the left, ``-`` skips one, and what comes after
    the last entry is not read. Or every entry names its column by the header:
    ``displacement=Stroke:mm,force=Load cell:kN``. A factor before the unit multiplies the numbers
    (a negative one turns the sign).

    Raises ColumnError, in one sentence that says what to change.
    """
    entries = [entry.strip() for entry in text.split(",")]
    columns = tuple(
        _parse_column(entry, position) for position, entry in enumerate(entries) if entry != SKIPPED
    )
    quantities = [column.quantity for column in columns]
    for quantity in UNITS:
        if quantities.count(quantity) > 1:
            raise ColumnError(f"the columns name {quantity} twice: name it once")
    for quantity in ("displacement", "force"):
        if quantity not in quantities:
            raise ColumnError(
                f"no column holds the {quantity}: add it, such as "
                f"{quantity}:{'mm' if quantity == 'displacement' else 'N'}"
            )
    by_header = [bool(column.header) for column in columns]
    if any(by_header) and not (all(by_header) and len(columns) == len(entries)):
        raise ColumnError(
            "some columns are named by their header and some by their place: "
            "name all by header (displacement=Stroke:mm) or none"
        )
    return columns


def _parse_column(entry: str, position: int) -> Column:
    name, colon, unit_text = entry.rpartition(":")
    if not colon:
        raise ColumnError(
            f"the column '{entry}' has no unit: write it after a colon, such as force:N, "
            f"or {SKIPPED} to skip the column"
        )
    quantity, equals, header = (part.strip() for part in name.partition("="))
    if quantity not in UNITS:
        raise ColumnError(
            f"'{quantity}' is no quantity of a record: use {', '.join(UNITS)}, "
            f"or {SKIPPED} to skip the column"
        )
    if equals and not header:
        raise ColumnError(f"the column '{entry}' has no header name after '='")
    factor_text, star, unit = (part.strip() for part in unit_text.rpartition("*"))
    known = UNITS[quantity]
    if unit not in known:
        raise ColumnError(
            f"'{unit}' is no unit of {quantity} that is known: use {', '.join(known)}, "
            f"with a factor where needed (10*{next(iter(known))})"
        )
    factor = _parse_factor(factor_text, entry) if star else 1.0
    if quantity == "time" and factor < 0.0:
        raise ColumnError(f"the factor in '{entry}' is negative: time must rise")
    scale, offset = known[unit]
    return Column(quantity, factor * scale, offset, position, header)


def _parse_factor(text: str, entry: str) -> float:
    try:
        factor = float(text)
    except ValueError:
        factor = math.nan
    if not math.isfinite(factor) or factor == 0.0:
        raise ColumnError(f"the factor '{text}' in '{entry}' is not a number other than zero")
    return factor
