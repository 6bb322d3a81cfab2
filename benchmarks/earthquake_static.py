"""Earthquake records predicted by the sinusoid set alone."""

from __future__ import annotations

import math

import numpy as np

from benchmarks import earthquake, recordings
from benchmarks.figure import Figure


def figures() -> list[Figure]:
    """``earthquake_static_fit``, ``..._mean``, and those of the sixteen parameters alone."""
    place = recordings.folder()
    note = recordings.NONE if place is None else ""
    fits = {
        model: None if place is None else earthquake.fits(place, model, None)
        for model in ("sigmoid_lag", "sigmoid")
    }
    mean = {
        model: None if found is None else float(np.mean(found)) for model, found in fits.items()
    }
    return [
        Figure(
            "earthquake_static_fit",
            fits["sigmoid_lag"],
            "Fit 1 - NRMSE [%] of the records at 0.2, 0.6 and 1.0 A, predicted block by block by "
            "the set of the sinusoid records alone (extended law), after the first 5 s of motion.",
            None,
            note,
        ),
        Figure(
            "earthquake_static_mean",
            mean["sigmoid_lag"],
            "Mean of the three [%].",
            (68.0, math.inf),
            note,
        ),
        Figure(
            "earthquake_static_sixteen_fit",
            fits["sigmoid"],
            "The same by a set of the sixteen parameters alone.",
            None,
            note,
        ),
    ]
