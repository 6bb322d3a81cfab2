"""Parameter sets published in the thesis: three single sets, and the sets of its 34 conditions.

Source: D. M. D. da Silva, "Comparative study of optimization algorithms for parameter
identification of the sigmoid model in MR dampers", University of Brasília, 2023. All are for a
LORD RD-8041-1. Tables 17-40 hold the conditions, each identified by two methods. Arrays are in
the order of ``PARAMETER_NAMES``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES
from mr_damper_ros.signals.arrays import Array

LITERATURE = np.array(
    [
        *(28.7, -0.199, 0.492, 22247.0, 6.02, -45.8, 1.450, 11.65),
        *(1638.0, 19.99, 37.71, 527.6, -67.9, -0.091, -0.260, 0.006),
    ]
)
"""Start of the searches in the thesis (appendix D, from Santade 2017): 2.5 mm, 1 Hz, 0 A."""

THESIS_28_CELSIUS = np.array(
    [
        *(8.38, 0.34, 0.17, 236.94, -5.59, -4.04, 0.11, -7.22),
        *(0.28, 5.09, 6.63, -334.23, -5.0, -0.30, -0.07, 0.0),
    ]
)
"""Cold damper: 5 mm, 1 Hz, 1.5 A at 28 °C (tables 8 and 9, two decimals as printed)."""

THESIS_71_CELSIUS = np.array(
    [
        *(3.35, -0.51, -1.00, -247.9, 1.39, 5.00, 0.32, -17.42),
        *(-0.77, 5.14, 6.99, -118.52, -1.13, -0.22, 0.05, 0.02),
    ]
)
"""Warm damper: 5 mm, 1 Hz, 1.5 A at 71 °C (tables 8 and 9, two decimals as printed).

It belongs to a different local minimum than the cold set, with different signs. Interpolate the
forces of the two sets, not their parameters.
"""


PUBLISHED_METHODS = ("nelder_mead", "differential_evolution")
"""The two methods in the tables; simulated runs use the first one."""


class ConditionError(ValueError):
    """An unknown condition; the message lists the conditions of the thesis."""


@dataclass(frozen=True, order=True)
class Condition:
    """One test: ``amplitude`` [m], ``frequency`` [Hz], ``current`` [A]."""

    current: float
    amplitude: float
    frequency: float

    @property
    def name(self) -> str:
        """The name, such as ``2.5mm_1Hz_0.0A``."""
        return f"{self.amplitude * 1e3:.1f}mm_{self.frequency:g}Hz_{self.current:.1f}A"


def _read_table() -> dict[tuple[Condition, str], Array]:
    text = Path(__file__).with_name("published_conditions.csv").read_text("utf-8")
    # Parsed without the module csv, which would otherwise be loaded with every law.
    names, *rows = (line.split(",") for line in text.splitlines() if not line.startswith("#"))
    table = {}
    for cells in rows:
        row = dict(zip(names, cells, strict=True))
        condition = Condition(
            amplitude=float(row["amplitude_mm"]) / 1e3,
            frequency=float(row["frequency_hz"]),
            current=float(row["current_a"]),
        )
        values = np.array([float(row[name]) for name in PARAMETER_NAMES])
        values.flags.writeable = False
        table[condition, row["method"]] = values
    return table


_TABLE = _read_table()

CONDITIONS = tuple(dict.fromkeys(condition for condition, _ in _TABLE))
"""The 34 conditions in the order of the tables."""


def find(name: str) -> Condition:
    """Condition by its name; raises ConditionError, which lists all names, for an unknown one."""
    by_name = {condition.name: condition for condition in CONDITIONS}
    if name not in by_name:
        raise ConditionError(f"the thesis has no condition '{name}'; it has {', '.join(by_name)}")
    return by_name[name]


def parameters(condition: Condition, method: str = PUBLISHED_METHODS[0]) -> Array:
    """Published parameters (16,) of a condition; read-only. Raises ConditionError."""
    if (condition, method) not in _TABLE:
        raise ConditionError(
            f"the tables have no row for {condition.name} by {method}: "
            f"the methods are {' and '.join(PUBLISHED_METHODS)}"
        )
    return _TABLE[condition, method]
