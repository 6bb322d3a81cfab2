"""Earthquake records with the identifier running."""

from __future__ import annotations

import math

from benchmarks import earthquake, recordings
from benchmarks.earthquake import Following
from benchmarks.figure import Figure


def figures() -> list[Figure]:
    """``earthquake_online_fit``, and that of the sixteen parameters alone."""
    place = recordings.folder()
    note = recordings.NONE if place is None else ""
    extended, sixteen = (
        None if place is None else earthquake.fits(place, model, Following())
        for model in ("sigmoid_lag", "sigmoid")
    )
    return [
        Figure(
            "earthquake_online_fit",
            extended,
            "Fit 1 - NRMSE [%] of the records at 0.2, 0.6 and 1.0 A with the identifier running "
            "from the sinusoid set on (extended law), every block predicted before it is used, "
            "after the first 5 s of motion.",
            (80.0, math.inf),
            note,
        ),
        Figure(
            "earthquake_online_sixteen_fit",
            sixteen,
            "The same with the sixteen parameters alone.",
            None,
            note,
        ),
    ]
