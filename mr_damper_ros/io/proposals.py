"""What a file holds, and the description of its columns that its headings support.

Nothing is guessed: a quantity that no heading names, or that has no unit, is named as missing.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from mr_damper_ros.io.binary_tables import FORMATS, text_of_sheet
from mr_damper_ros.io.columns import DATE_AND_TIME, MAXIMUM_SAMPLES, REST, SKIPPED
from mr_damper_ros.io.headings import Unit, is_signal
from mr_damper_ros.io.text_tables import Outline, of_text_file

_NEEDED = ("time", "displacement", "force")
_USED = ("time", "displacement", "velocity", "force", "current", "temperature")


@dataclass(frozen=True)
class Proposal:
    """The columns of a file, as its headings describe them.

    ``outline`` is the form of the table. ``columns`` describes the columns; missing units are
    ``UNIT``. ``missing`` are sentences on what the file does not say, ``remarks`` on what was
    chosen. ``quantities`` are the described ones.
    """

    outline: Outline
    columns: str
    quantities: frozenset[str]
    missing: tuple[str, ...]
    remarks: tuple[str, ...]

    @property
    def usable(self) -> bool:
        """Whether the headings name the displacement, or the velocity, and the force."""
        return "force" in self.quantities and bool({"displacement", "velocity"} & self.quantities)


def propose_columns(path: Path, variable: str | None = None, timed: bool = False) -> Proposal:
    """Describe the columns of a text file, or of a sheet, which ``variable`` selects.

    ``timed``: whether the sample period is known. Raises RecordError if there is no table.
    """
    if path.suffix.lower() in FORMATS:
        outline = text_of_sheet(path, variable, MAXIMUM_SAMPLES).outline()
    else:
        outline = of_text_file(path, lambda text: text.outline())
    return _proposal(outline, timed)


def reversed_force(columns: str) -> str:
    """A description of columns with the other sign of the force."""
    return _FORCE.sub(
        lambda found: f"{found[1]}-{found[2] if '*' in found[2] else f'1*{found[2]}'}", columns
    )


_FORCE = re.compile(r'((?:^|,)force(?:=(?:"[^"]*"|[^,]*))?:)([^,:]*)(?=,|$)')
"""The entry of the force in a description, up to its unit, and the unit."""


def _proposal(outline: Outline, timed: bool) -> Proposal:
    chosen: dict[str, int] = {}
    remarks, missing = [], []
    for quantity in _USED:
        places = _candidates(outline, quantity)
        if not places:
            continue
        chosen[quantity] = places[0]
        if len(places) > 1:
            others = ", ".join(f"{p + 1} '{outline.heading(p)}'" for p in places[1:])
            remarks.append(
                f"column {places[0] + 1} '{outline.heading(places[0])}' is taken as the "
                f"{quantity}; columns that could be it too: {others}"
            )
    if "displacement" in chosen:
        chosen.pop("velocity", None)
    if timed:
        chosen.pop("time", None)
    wanted = chosen
    for quantity in _NEEDED:
        if quantity in wanted or (quantity == "displacement" and "velocity" in wanted):
            continue
        if quantity == "time" and (timed or outline.period is not None):
            continue
        missing.append(
            "the file does not state the time between samples: give it (--period)"
            if quantity == "time"
            else f"no heading names the {quantity}: say which column holds it"
        )
    sets = _repeated(outline, wanted)
    if sets > 1:
        missing.append(
            f"the file holds {sets} sets of columns with the same headings side by side, of "
            "several specimens or runs: save one set in each file, or describe one set by "
            "position, with ... for the others"
        )
    units: dict[str, str] = {}
    for quantity, place in wanted.items():
        unit = outline.unit(place)
        if place in outline.dates:
            units[quantity] = DATE_AND_TIME
        elif unit is not None and unit.quantity == quantity:
            units[quantity] = unit.text
        else:
            units[quantity] = "UNIT"
            missing.append(
                f"the file states no known unit of the {quantity} (column {place + 1} "
                f"'{outline.heading(place)}'): write it instead of UNIT"
            )
    columns = _described(outline, wanted, units)
    return Proposal(outline, columns, frozenset(wanted), tuple(missing), tuple(remarks))


def _candidates(outline: Outline, quantity: str) -> list[int]:
    """The columns that may hold a quantity, best first.

    Headings name them; without such a heading, the only column with a unit of the quantity counts.
    """
    places = sorted({*outline.numeric, *outline.dates})
    units = {place: outline.unit(place) for place in places}
    fitting = [p for p in places if (unit := units[p]) and unit.quantity == quantity]
    if quantity == "time":
        fitting += outline.dates
    named = [p for p in places if outline.quantity(p) == quantity and units[p] is None]
    named = [p for p in fitting if outline.quantity(p) == quantity] or named
    if not named:
        alone = len(fitting) == 1 and outline.quantity(fitting[0]) is None
        return fitting if alone and is_signal(outline.heading(fitting[0])) else []
    preferred = outline.layout.preferred.get(quantity, ())

    def rank(place: int) -> tuple[int, int]:
        heading = outline.heading(place).lower()
        ranks = [k for k, form in enumerate(preferred) if re.match(form, heading)]
        return (ranks[0] if ranks else len(preferred), place)

    return sorted(named, key=rank)


def _repeated(outline: Outline, wanted: dict[str, int]) -> int:
    """How often the headings of the chosen columns other than the time stand in the file."""
    headings = [outline.heading(place) for place in outline.numeric]
    return max(
        (
            headings.count(outline.heading(place))
            for quantity, place in wanted.items()
            if quantity != "time" and outline.heading(place)
        ),
        default=1,
    )


def _described(outline: Outline, wanted: dict[str, int], units: dict[str, str]) -> str:
    """The description: by heading, or by position where headings cannot select."""
    headings = [outline.heading(place) for place in range(len(outline.headings))]
    by_heading = bool(outline.separator) and all(
        headings.count(outline.heading(place)) == 1 and '"' not in outline.heading(place)
        for place in wanted.values()
    )
    if by_heading and wanted:
        return ",".join(
            f"{quantity}={_quoted(outline.heading(place))}:{units[quantity]}"
            for quantity, place in sorted(wanted.items(), key=lambda item: item[1])
        )
    last = max(wanted.values(), default=-1)
    names = {place: f"{quantity}:{units[quantity]}" for quantity, place in wanted.items()}
    entries = [names.get(place, SKIPPED) for place in range(last + 1)]
    more = max(outline.numeric, default=-1) > last
    return ",".join([*entries, REST] if more else entries)


def _quoted(heading: str) -> str:
    return f'"{heading}"' if "," in heading else heading


def unit_text(unit: Unit | None) -> str:
    """The word of a unit for display; empty for none."""
    return "" if unit is None else unit.word
