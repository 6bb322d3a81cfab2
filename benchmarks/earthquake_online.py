"""Earthquake records with the identifier running."""

from __future__ import annotations

import math

from benchmarks.figure import Figure
from benchmarks.state_law import STATE_LAW
from mr_damper_ros.models import MODELS
from studies import earthquake, recordings

LAWS = {"fit": "sigmoid_lag", "springs_fit": STATE_LAW, "sixteen_fit": "sigmoid"}
"""The laws by the end of their keys."""


def figures() -> list[Figure]:
    """``earthquake_online_fit``, ``..._springs_fit`` and ``..._sixteen_fit``."""
    place = recordings.folder()
    return [
        Figure(
            f"earthquake_online_{end}",
            None if place is None else earthquake.fits(place, law, identify=True),
            "Fit 1 - NRMSE [%] of the records at 0.2, 0.6 and 1.0 A, their smoothing undone, with "
            "the identifier running from the sinusoid set on, every block predicted before it is "
            f"used, after the first 5 s of motion: {MODELS[law].title}.",
            (91.0, math.inf) if end == "fit" else None,
            recordings.NONE if place is None else "",
        )
        for end, law in LAWS.items()
    ]
