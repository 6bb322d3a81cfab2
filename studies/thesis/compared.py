"""Comparison of our values with those of the thesis, and its table."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mr_damper_ros.report.document import Table
from studies.drawing import table

Compared = tuple[str, str, float, float | str | None, str]
"""Quantity, unit, our value, value or words of the thesis (None if not stated), and its place."""


def percent(difference: float) -> str:
    """A relative difference as text, in %."""
    rounded = round(100.0 * difference, 1)
    return "0.0 %" if rounded == 0.0 else f"{rounded:+.1f} %".replace("-", "−")


def comparison(
    name: str, caption: str, values: Sequence[Compared], zeros: Sequence[str] = ()
) -> Table:
    """Table of our values, those of the thesis and the relative difference.

    ``zeros`` are quantities whose true value is zero, so that a relative difference is meaningless.
    """
    rows = []
    for quantity, unit, ours, thesis, where in values:
        difference = ""
        if isinstance(thesis, float) and thesis and quantity not in zeros and math.isfinite(ours):
            difference = percent((ours - thesis) / abs(thesis))
        stated = "not stated" if thesis is None else thesis
        rows.append((quantity, unit, ours, stated, difference, where))
    heads = "Quantity | Unit | Ours | Thesis | Difference | In the thesis"
    return table(name, caption, heads, rows)
