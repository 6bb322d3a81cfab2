"""Comparison of our values with those of the thesis, and its table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from mr_damper_ros.report.document import Table


@dataclass(frozen=True)
class Compared:
    """Our value and that of the thesis (its wording, or None if the thesis states no value).

    ``relative`` is False if the true value is zero, where a relative difference is meaningless.
    """

    quantity: str
    unit: str
    ours: float
    thesis: float | str | None
    where: str
    relative: bool = True

    @property
    def difference(self) -> float | None:
        """(ours - thesis) / |thesis|."""
        if self.thesis is None or isinstance(self.thesis, str) or self.thesis == 0.0:
            return None
        if not self.relative or not math.isfinite(self.ours):
            return None
        return (self.ours - self.thesis) / abs(self.thesis)


def percent(difference: float) -> str:
    """A relative difference as text, in %."""
    rounded = round(100.0 * difference, 1)
    return "0.0 %" if rounded == 0.0 else f"{rounded:+.1f} %".replace("-", "−")


def comparison(name: str, caption: str, values: Sequence[Compared]) -> Table:
    """Table of our values, those of the thesis and the relative difference."""
    rows = [
        (
            v.quantity,
            v.unit,
            v.ours,
            "not stated" if v.thesis is None else v.thesis,
            "" if v.difference is None else percent(v.difference),
            v.where,
        )
        for v in values
    ]
    columns = ("Quantity", "Unit", "Ours", "Thesis", "Difference", "In the thesis")
    return Table(name, caption, columns, rows)
