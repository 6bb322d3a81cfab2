"""Decimal marks and thousands separators, recognised from all numbers of a file together.

A file uses one decimal mark. ``1,019`` alone may be 1.019 or 1019: the other numbers of the file
decide, and without such evidence the number is refused.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

_SPACES = " \u00a0\u2009\u202f'\u2019"
"""Spaces and apostrophes that separate thousands."""

_NUMBER = re.compile(rf"([+-]?)((?:[\d.,]|(?<=\d)[{_SPACES}](?=\d))*\d[.,]?)([eE][+-]?\d+)?")
_GROUPED = re.compile(r"[1-9]\d{0,2}(?:(?P<mark>[.,])\d{3})(?:(?P=mark)\d{3})*")
_SPACED = re.compile(r"[1-9]\d{0,2}(?:(?P<mark>[" + _SPACES + r"])\d{3})(?:(?P=mark)\d{3})*")
_WORDS = re.compile(r"[+-]?(?:nan|inf|infinity)", re.IGNORECASE)
_NAMES = {".": "point", ",": "comma"}

REMEDY = (
    "write the numbers without thousands separators, or state the decimal mark (--decimal-mark)"
)


class MarksError(ValueError):
    """The marks of the numbers are ambiguous or contradict each other."""


class Marks(NamedTuple):
    """The decimal mark of a file, and its thousands separators, if any."""

    decimal: str = "."
    thousands: str = ""


def looks_numeric(text: str) -> bool:
    """Whether a text is a number under some marks."""
    return bool(_NUMBER.fullmatch(text) or _WORDS.fullmatch(text))


def number_of(text: str, marks: Marks) -> float | None:
    """The number that a text is under the marks of its file; None for any other text."""
    plain = text.strip()
    if marks.thousands:
        match = _NUMBER.fullmatch(plain)
        if match is None:
            return float(plain) if _WORDS.fullmatch(plain) else None
        whole, mark, fraction = match[2].partition(marks.decimal)
        grouped = _GROUPED.fullmatch(whole) or _SPACED.fullmatch(whole)
        if grouped and grouped["mark"] in marks.thousands:
            whole = whole.replace(grouped["mark"], "")
        plain = f"{match[1]}{whole}{'.' if mark else ''}{fraction}{match[3] or ''}"
    elif marks.decimal != ".":
        if "." in plain:
            return None
        plain = plain.replace(marks.decimal, ".")
    if "_" in plain:
        return None
    try:
        return float(plain)
    except ValueError:
        return None


class Evidence:
    """What the numbers of a file say about its marks; ``add`` receives them row by row."""

    def __init__(self) -> None:
        self._decimals: dict[str, str] = {}
        self._thousands: dict[str, str] = {}
        # By column: the first ambiguous text of each mark, whether a number has no mark at all,
        # and whether a number of more than three digits has none.
        self._unclear: dict[int, dict[str, str]] = {}
        self._bare: set[int] = set()
        self._long: set[int] = set()

    def add(self, fields: Sequence[str], columns: Iterable[int]) -> None:
        """Take the numbers in some columns of a row into account."""
        for column in columns:
            if column < len(fields):
                self._add(column, fields[column].strip())

    def _add(self, column: int, text: str) -> None:
        match = _NUMBER.fullmatch(text)
        if match is None:
            return
        body = match[2]
        marks = [mark for mark in body if mark in ".,"]
        spaced = any(mark in _SPACES for mark in body)
        whole = body.rpartition(marks[-1])[0] if marks else body
        if spaced:
            grouped = _SPACED.fullmatch(whole)
        elif len(set(marks)) == 1:
            grouped = _GROUPED.fullmatch(body)
        else:
            grouped = _GROUPED.fullmatch(whole)
        if len(marks) > 1 or spaced:
            if grouped:
                self._thousands.setdefault(grouped["mark"], text)
                if (spaced and marks) or len(set(marks)) == 2:
                    self._decimals.setdefault(marks[-1], text)
        elif not marks:
            if body.strip("0"):
                self._bare.add(column)
            if len(body) > 3 and body[0] != "0":
                self._long.add(column)
        elif grouped and not match[3]:
            self._unclear.setdefault(column, {}).setdefault(marks[0], text)
        else:
            self._decimals.setdefault(marks[0], text)

    @property
    def decided(self) -> bool:
        """Whether a number shows the decimal mark without doubt."""
        return bool(self._decimals)

    def marks(self, decimal: str | None = None) -> Marks:
        """The marks of the file; ``decimal`` is the mark that the user states.

        Raises MarksError if the numbers contradict each other, or do not determine the marks.
        """
        decimals = dict(self._decimals)
        if decimal is not None:
            decimals = {decimal: f"0{decimal}5", **decimals}
        unclear = {mark: text for texts in self._unclear.values() for mark, text in texts.items()}
        if not decimals and len(self._thousands) == 1:
            (mark,) = self._thousands
            decimals = {"." if mark != "." else ",": ""}
        if not decimals:
            for column in self._long:
                decimals.update(self._unclear.get(column, {}))
        if not decimals:
            mixed = {
                mark: text
                for column, texts in self._unclear.items()
                for mark, text in texts.items()
                if mark == "," or column in self._bare
            }
            if mixed or len(unclear) > 1:
                mark, text = next(iter((mixed or unclear).items()))
                raise MarksError(
                    f"'{text}' may be {text.replace(mark, '.')} or "
                    f"{text.replace(mark, '')} with a {_NAMES[mark]} as thousands separator, and "
                    f"no other number of the file decides: {REMEDY}"
                )
            decimals = {".": ""}
        if len(decimals) > 1 or set(decimals) & set(self._thousands):
            first, second = ([*decimals.values(), *self._thousands.values()])[:2]
            raise MarksError(
                f"'{first}' and '{second}' do not have the same decimal mark, or one has thousands "
                f"separators: {REMEDY}"
            )
        (chosen,) = decimals
        for column, texts in self._unclear.items():
            for mark, text in texts.items():
                if mark != chosen and column in self._long:
                    raise MarksError(
                        f"'{text}' has a thousands separator, but other numbers of column "
                        f"{column + 1} have none: {REMEDY}"
                    )
        thousands = {*self._thousands, *unclear} - {chosen}
        return Marks(chosen, "".join(sorted(thousands)))

    def example(self, mark: str) -> str:
        """A number with a thousands separator."""
        texts = [self._thousands, *self._unclear.values()]
        return next((found[mark] for found in texts if mark in found), "")
