"""Text layouts of test machines and loggers: one row for each maker's program.

A layout only says where its files differ from a plain table. A new layout is a new row.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Layout:
    """How the exports of a program look.

    ``mark`` is a regular expression that the lines above the samples contain. ``preferred`` are
    regular expressions of headings by quantity, best first, for files with several columns of a
    quantity. ``units`` are the units of columns by heading, where the program never writes them.
    ``unit_row`` and ``period_row`` are the first cells of the rows that hold the units and the
    sample periods [s] of the columns.
    """

    name: str
    mark: str
    preferred: dict[str, tuple[str, ...]] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    unit_row: str | None = None
    period_row: str | None = None


LAYOUTS = (
    Layout("LabVIEW", r"^LabVIEW Measurement", {}, {"X_Value": "s"}, "Y_Unit_Label", "Delta_X"),
    Layout(
        "Instron WaveMatrix",
        r"Total Time \(s\)|Elapsed Cycles|\(Linear:|\(\d+ \(\d,\d\):",
        {
            "time": (r"total time", r"elapsed time", r"time"),
            "displacement": (r"position\(.*position\)", r"displacement\(.*position\)"),
            "force": (r"load\(.*:load\)",),
        },
    ),
    Layout(
        "Instron Bluehill",
        r"Specimen label|Time,Extension,Load|Text Inputs|Results Table",
        {"displacement": (r"extension", r"flexure extension", r"compressive extension")},
    ),
    Layout(
        "Zwick testXpert",
        r"Pr(ü|ue)fzeit|Standard(kraft|weg)|Standard (force|travel)|(Force|Course) standard",
        {"displacement": (r"standardweg|standard travel|course standard", r"traverse|crosshead")},
    ),
    Layout(
        "MTS 793",
        r"^MTS.*\|MPT\||^MTS793|Data Acquisition: |Station Name|Axial (Displacement|Force)",
        {
            "time": (r"time", r"running time"),
            "displacement": (r"axial (disp|desp)\w*",),
            "force": (r"axial (force|fuerza|load)",),
        },
    ),
    Layout(
        "MTS TestSuite",
        r"Running Time|Test Run Name|_Crosshead|TestSuite",
        {
            "time": (r"_?time", r"running time"),
            "displacement": (r"_?crosshead", r"axial displacement", r"_?displacement"),
            "force": (r"_?load", r"axial force", r"_?force"),
        },
    ),
    Layout(
        "Shimadzu TRAPEZIUM",
        r"(Time|Temps)\W{1,3}(Force|Load)\W{1,3}(Stroke|Course)",
        {"displacement": (r"stroke", r"course\w*")},
    ),
    Layout("walter+bai", r"S/No;C_1_", {"displacement": (r"c_1_d.placement", r"c_1_displacement")}),
)
"""The known layouts; the first one with a mark in the file applies."""

PLAIN = Layout("a table", "")
"""A file of no known maker."""


def layout_of(lines: Iterable[str]) -> Layout:
    """The layout whose mark stands in one of the lines above the samples."""
    text = "\n".join(lines)
    for layout in LAYOUTS:
        if re.search(layout.mark, text, re.MULTILINE):
            return layout
    return PLAIN
