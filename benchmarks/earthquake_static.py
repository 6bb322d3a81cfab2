"""Earthquake records predicted by the sinusoid set alone."""

from __future__ import annotations

import math

import numpy as np

from benchmarks.figure import Figure
from benchmarks.state_law import STATE_LAW
from mr_damper_ros.models import MODELS
from studies import earthquake, recordings

LAWS = {"fit": "sigmoid_lag", "springs_fit": STATE_LAW, "sixteen_fit": "sigmoid"}
"""The laws by the end of their keys."""


def figures() -> list[Figure]:
    """``earthquake_static_fit``, ``..._springs_fit``, ``..._sixteen_fit`` and ``..._mean``."""
    place = recordings.folder()
    note = recordings.NONE if place is None else ""
    fits = {
        law: None if place is None else earthquake.fits(place, law, identify=False)
        for law in LAWS.values()
    }
    means = [float(np.mean(found)) for found in fits.values() if found is not None]
    return [
        *(
            Figure(
                f"earthquake_static_{end}",
                fits[law],
                "Fit 1 - NRMSE [%] of the records at 0.2, 0.6 and 1.0 A, their smoothing undone, "
                "predicted block by block by the set of the sinusoid records alone, after the "
                f"first 5 s of motion: {MODELS[law].title}.",
                None,
                note,
            )
            for end, law in LAWS.items()
        ),
        Figure(
            "earthquake_static_mean",
            max(means, default=None),
            "Mean of the three [%], of the best of these laws.",
            (86.0, math.inf),
            note,
        ),
    ]
