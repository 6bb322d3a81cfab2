"""What the headings of a table say: quantities and units, in the words of several languages.

A heading is compared with the description by the user, and it supplies the proposal of a
description. An unknown word is ignored; it never becomes a guess.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from mr_damper_ros.io.columns import Column, RecordError, parse_unit

_UNIT_WORDS = {
    "time": {
        "s": "s sec secs second seconds sek sekunde sekunden seconde secondes segundo segundos "
        "secondi",
        "ms": "ms msec millisecond milliseconds",
        "us": "us µs μs usec",
        "min": "min minute minutes",
    },
    "displacement": {
        "m": "m meter metre meters metres",
        "cm": "cm",
        "mm": "mm millimeter millimetre millimeters millimetres",
        "um": "um µm μm micron microns",
        "in": 'in inch inches "',
    },
    "velocity": {
        "m/s": "m/s m/sec",
        "cm/s": "cm/s cm/sec",
        "mm/s": "mm/s mm/sec",
        "in/s": "in/s in/sec ips",
        "0.016666666666666666*mm/s": "mm/min",
    },
    "force": {
        "N": "n newton newtons",
        "kN": "kn kilonewton kilonewtons",
        "10*N": "dan",
        "kgf": "kgf kg kp",
        "lbf": "lbf lb lbs",
        "1000*lbf": "kip kips klbf",
    },
    "current": {"A": "a amp amps ampere amperes", "mA": "ma milliampere milliamperes"},
    "temperature": {
        "degC": "°c ºc degc celsius c",
        "K": "k kelvin",
        "degF": "°f ºf degf fahrenheit f",
    },
}
"""Words of units in headings, by the unit in a description of columns."""

_EXACT = {"mN": ("force", "0.001*N"), "MN": ("force", "1000000*N")}
"""Units whose prefix depends on the case of the letter."""

_KNOWN = {
    word: (quantity, unit)
    for quantity, units in _UNIT_WORDS.items()
    for unit, words in units.items()
    for word in words.split()
}

_LABELS = {"a", "c", "f", "k", "m", "n", "s", "in", "min", "ma", "um"}
"""Words that may also be a label, such as the letter of a channel, or "minimum"."""

_QUANTITY_WORDS = {
    "time": r"time|timestamp|zeit|prüfzeit|pruefzeit|temps|tempo|tiempo|t|x value",
    "displacement": r"disp\w*|stroke|position|pos|extension|ext|crosshead|traverse\w*|weg|\w+weg"
    r"|course|dépl\w*|depl\w*|deslocamento|desplazamiento|spostamento|corsa|carrera|hub"
    r"|kolbenweg|travel|lvdt|elongation",
    "velocity": r"velocity|vel|speed|geschwindigkeit|vitesse|velocidade|velocidad|velocità",
    "force": r"force|load|load cell|kraft|\w+kraft|last|carga|força|forca|fuerza|forza|charge",
    "current": r"current|coil current|strom|courant|corrente|corriente",
    "temperature": r"temp|temperature|temperatur|température|temperatura",
}
_NOT_A_SIGNAL = re.compile(
    r"(?<![^\W_])(command|cmd|set ?point|sollwert|consigne|commande|strain|stress|dehnung|spannung"
    r"|count|segments?|cycles?|error|peak|valley|max\w*|min\w*|mean|energy|torque|rotation|angle"
    r"|index|deformation|rate)(?![^\W_])"
)
"""Words in headings of columns that hold no measured sample of a quantity."""

_QUANTITIES = {
    quantity: re.compile(rf"(?<![^\W_])({words})(?![^\W_])")
    for quantity, words in _QUANTITY_WORDS.items()
}

_IN_BRACKETS = re.compile(r"[(\[{]\s*([^()\[\]{}]*?)\s*[)\]}]\s*$")
_LAST_WORD = re.compile(r"(.*[^\s_,])(?:\s+in\s+|[\s_,]+)(\S+?)\s*$")
_AFTER_SLASH = re.compile(r"([^/]+)/\s*([^\s/]+(?:/\w+)?)\s*$")


@dataclass(frozen=True)
class Unit:
    """A unit that a file states: its word, its quantity, and its form in a description.

    ``sure``: whether it stands in a row of units, so that a single letter is no label.
    """

    word: str
    quantity: str
    text: str
    sure: bool = False


def unit_of_word(word: str) -> Unit | None:
    """The unit that a word such as ``kN``, ``[kN]`` or ``Sec`` names; None for other words."""
    word = word.strip().strip("()[]{}").strip().rstrip(".")
    known = _EXACT.get(word) or _KNOWN.get(word.lower())
    if known is None or (word.lower() == "mn" and word not in _EXACT):
        return None
    return Unit(word, *known)


def unit_of_heading(heading: str) -> Unit | None:
    """The unit in a heading such as ``Load (kN)``, ``Force [ kN ]``, ``time/s`` or ``Force_N``.

    Without brackets, the last word is a unit only if the other words name its quantity.
    """
    if found := _IN_BRACKETS.search(heading):
        return unit_of_word(found[1])
    for form in (_LAST_WORD, _AFTER_SLASH):
        found = form.match(heading)
        unit = unit_of_word(found[2]) if found else None
        if found and unit and quantity_of(found[1]) == unit.quantity:
            return unit
    return None


def quantity_of(heading: str) -> str | None:
    """The quantity that the words of a heading name; None if they name none or several."""
    if not is_signal(heading):
        return None
    words = _words(heading)
    found = [quantity for quantity, form in _QUANTITIES.items() if form.search(words)]
    return found[0] if len(found) == 1 else None


def is_signal(heading: str) -> bool:
    """Whether a heading lacks the words of peaks, counts, commands and computed quantities."""
    return not _NOT_A_SIGNAL.search(_words(heading))


def _words(heading: str) -> str:
    return _IN_BRACKETS.sub("", heading).lower().replace("_", " ")


def is_row_of_units(fields: Sequence[str]) -> bool:
    """Whether a row holds units: at least half of its texts are known units, and none a number."""
    texts = [text for text in fields if text.strip("()[] -")]
    known = sum(unit_of_word(text) is not None for text in texts)
    return known > 0 and 2 * known >= len(texts)


def check_unit(name: str, column: Column, position: int, heading: str, unit: Unit | None) -> None:
    """Raise RecordError if a file states another unit than the description of a column.

    A factor in the description is the user's own conversion, which is not compared.
    """
    if unit is None or column.deliberate or column.holds_dates:
        return
    said = f"{column.quantity}:{column.unit}"
    where = f"column {position + 1} of {name}" + (f" is headed '{heading}'" if heading else "")
    states = f"{where} and has the unit {unit.word}, but the columns say {said}"
    if unit.quantity != column.quantity:
        if unit.word.lower() in _LABELS and not unit.sure:
            return
        raise RecordError(
            f"{states}: describe another column, or, if the heading is wrong, write "
            f"{column.quantity}:1*{column.unit}"
        )
    factor, offset = parse_unit(column.quantity, unit.text)
    size = abs(column.factor)
    if abs(size - factor) > 1e-6 * factor or (
        column.quantity == "temperature" and abs(column.zero - offset) > 1e-6
    ):
        raise RecordError(
            f"{states}: write {column.quantity}:{unit.text}, or, if the heading is wrong, "
            f"{column.quantity}:1*{column.unit}"
        )
