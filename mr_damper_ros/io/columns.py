"""Columns of a record: descriptions by the user, units and raw values."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mr_damper_ros.signals.arrays import Array

SKIPPED = "-"
REST = "..."

_ENTRY = re.compile(r',([^=,]*=\s*"[^"]*"[^,]*|[^,]*)')
"""An entry of a description; commas within double quotes do not end it."""

_FORM = re.compile(
    r"(?:(?P<factor>.*)\*)?\s*(?P<unit>[A-Za-z/]+)"
    r"(?:\s*(?P<offset>[+-][^A-Za-z/]*(?:[eE][+-]?\d+)?)\s*(?P<offset_unit>[A-Za-z/]+))?$"
)
"""Factor, unit, offset with its unit: ``980.665*N-12N``."""


class ColumnError(ValueError):
    """An invalid description of columns; the message says what to change."""


@dataclass(frozen=True)
class Column:
    """One column of a record: its ``quantity`` and the conversion to SI units.

    The SI value is ``factor`` * number + ``offset``. ``header`` is the name of the column; if it is
    empty, ``position`` (from 0) selects the column. ``holds_dates``: whether the cells hold date
    and time of day. ``unit`` is the unit of the description, and ``zero`` its zero in the SI unit.
    ``deliberate``: whether a factor other than -1 converts the numbers, whatever unit the file
    states.
    """

    quantity: str
    factor: float
    offset: float
    position: int
    header: str = ""
    holds_dates: bool = False
    unit: str = ""
    zero: float = 0.0
    deliberate: bool = False

    def to_si(self, values: Array) -> Array:
        """Values in SI units (temperature in °C), shape (n,)."""
        return np.asarray(values, dtype=np.float64) * self.factor + self.offset


@dataclass(frozen=True)
class Columns:
    """The selected columns of a record.

    ``width`` is the number of described columns, including skipped ones; None if more columns may
    follow. ``text`` is the description.
    """

    wanted: tuple[Column, ...]
    width: int | None
    text: str

    @property
    def quantities(self) -> frozenset[str]:
        """The quantities of the columns."""
        return frozenset(column.quantity for column in self.wanted)

    @property
    def by_header(self) -> bool:
        """Whether headers select the columns."""
        return bool(self.wanted[0].header)

    def check_width(self, name: str, count: int, listed: str = "") -> None:
        """Raise RecordError if a table has undescribed columns of numbers.

        ``name`` is the name of the file, ``count`` its number of columns of numbers, and ``listed``
        names them.
        """
        if self.width is None or count <= self.width:
            return
        surplus = [str(place + 1) for place in range(self.width, count)]
        column = "columns" if len(surplus) > 1 else "column"
        raise RecordError(
            f"{name} holds {count} columns of numbers, but {self.width} are described: say what "
            f"{column} {', '.join(surplus)} {'hold' if len(surplus) > 1 else 'holds'}, or write "
            f"{SKIPPED} to skip a column, {REST} to skip all further columns{listed}"
        )


def parse_columns(text: str) -> Columns:
    """Columns from a description such as ``time:s,displacement:mm,-,force:980.665*N-12N``.

    The entries describe the columns of the file from left to right: ``-`` skips a column, and
    ``...`` at the end skips all further columns. Alternatively, every entry selects its column by
    the header: ``displacement=Stroke:mm,force=Load cell:kN``. A factor before the unit multiplies
    the numbers; a negative factor reverses the sign. An offset after the unit is then added.
    ``time:datetime`` is a column of dates with the time of day. A velocity column can replace a
    missing displacement column. A header with a comma is written in double quotes:
    ``force="Load (0,1)":kN``.

    Raises ColumnError if the description is invalid; the message says what to change.
    """
    entries = [entry.strip() for entry in _ENTRY.findall(f",{text}")]
    open_ended = entries[-1] == REST
    if open_ended:
        entries.pop()
    columns = tuple(
        _parse_column(entry, position) for position, entry in enumerate(entries) if entry != SKIPPED
    )
    quantities = [column.quantity for column in columns]
    for quantity in UNITS:
        if quantities.count(quantity) > 1:
            raise ColumnError(f"the columns name {quantity} twice: name it once")
    if "displacement" not in quantities and "velocity" not in quantities:
        raise ColumnError("no column holds the displacement: add it, such as displacement:mm")
    if "force" not in quantities:
        raise ColumnError("no column holds the force: add it, such as force:N")
    by_header = [bool(column.header) for column in columns]
    if any(by_header) and not (all(by_header) and len(columns) == len(entries)):
        raise ColumnError(
            "some columns are selected by their header and some by their position: "
            "select all by header (displacement=Stroke:mm) or none"
        )
    return Columns(columns, None if open_ended or any(by_header) else len(entries), text)


def _parse_column(entry: str, position: int) -> Column:
    name, colon, unit_text = entry.rpartition(":")
    if not colon:
        raise ColumnError(
            f"the column '{entry}' has no unit: write it after a colon, such as force:N, "
            f"or {SKIPPED} to skip the column; a comma ends an entry, unless it stands in double "
            'quotes, such as force="Load (0,1)":kN'
        )
    quantity, equals, header = (part.strip() for part in name.partition("="))
    if len(header) > 1 and header[0] == header[-1] == '"':
        header = header[1:-1].strip()
    if quantity not in UNITS:
        raise ColumnError(
            f"'{quantity}' is not a quantity of a record: use {', '.join(UNITS)}, "
            f"or {SKIPPED} to skip the column"
        )
    if equals and not header:
        raise ColumnError(f"the column '{entry}' has no header name after '='")
    form = _FORM.match(unit_text.strip())
    unit = form["unit"] if form else unit_text.strip()
    if form is None or unit not in UNITS[quantity]:
        raise _unknown_unit(unit, quantity)
    factor = 1.0 if form["factor"] is None else _number(form["factor"], "factor", entry)
    if factor == 0.0:
        raise ColumnError(f"the factor in '{entry}' is zero: give another number")
    if quantity == "time" and factor < 0.0:
        raise ColumnError(f"the factor in '{entry}' is negative: time must increase")
    if unit == DATE_AND_TIME and form["factor"] is not None:
        raise ColumnError(f"'{entry}': a date and time has no factor")
    scale, offset = UNITS[quantity][unit], _ZEROS.get(unit, 0.0)
    if form["offset"] is not None:
        if form["offset_unit"] not in UNITS[quantity]:
            raise _unknown_unit(form["offset_unit"], quantity)
        number = _number(form["offset"].replace(" ", ""), "offset", entry)
        offset += number * UNITS[quantity][form["offset_unit"]]
    return Column(
        quantity,
        factor * scale,
        offset,
        position,
        header,
        unit == DATE_AND_TIME,
        unit,
        _ZEROS.get(unit, 0.0),
        form["factor"] is not None and factor != -1.0,
    )


def parse_unit(quantity: str, text: str) -> tuple[float, float]:
    """SI value of a unit such as ``kN`` or ``10*N``, and its zero in the SI unit."""
    column = _parse_column(f"{quantity}:{text}", 0)
    return column.factor, column.zero


def _unknown_unit(unit: str, quantity: str) -> ColumnError:
    known = UNITS[quantity]
    return ColumnError(
        f"'{unit}' is not a known unit of {quantity}: use {', '.join(known)}, "
        f"with a factor if needed (10*{next(iter(known))})"
    )


def _number(text: str, name: str, entry: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ColumnError(f"the {name} '{text}' in '{entry}' is not a number")
    return number


DATE_AND_TIME = "datetime"
"""Unit of a time column with date and time of day; read as seconds since 1970."""

_G = 9.80665
_INCH = 0.0254
_POUND_FORCE = 0.45359237 * _G

UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, DATE_AND_TIME: 1.0},
    "displacement": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": _INCH},
    "velocity": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "in/s": _INCH},
    "force": {"N": 1.0, "kN": 1e3, "kgf": _G, "lbf": _POUND_FORCE},
    "current": {"A": 1.0, "mA": 1e-3},
    "temperature": {"degC": 1.0, "K": 1.0, "degF": 5.0 / 9.0},
}
"""SI value of each unit, by quantity."""

_ZEROS = {"K": -273.15, "degF": -160.0 / 9.0}
"""Temperature [°C] at zero of each unit other than °C."""


MAXIMUM_SAMPLES = 10_000_000
"""Default limit of the number of samples: 2.8 h at 1 kHz, about 1.5 GB of memory."""


class RecordError(ValueError):
    """An error in reading a record; the message says what to change."""


class RawTable(NamedTuple):
    """Raw values (n,) by quantity.

    ``place`` describes the location of a row in words, for messages. ``period`` is the sample
    period [s] according to the file, None if it is unknown. ``notes`` are sentences on what was
    left out or changed. ``breaks`` are the rows at which the file begins a new block of samples.
    ``shown`` is the period [s] of a column of times that is not read, with the name of the column.
    """

    values: dict[str, Array]
    place: Callable[[int], str]
    period: float | None = None
    notes: tuple[str, ...] = ()
    breaks: tuple[int, ...] = ()
    shown: tuple[float, str] | None = None


def too_long(name: str, maximum_samples: int) -> RecordError:
    """The error for a file with too many samples."""
    return RecordError(
        f"{name} holds more than {maximum_samples} samples: split it, or allow more "
        "(mr-damper import --maximum-samples)"
    )
