"""Earthquake records predicted by the sinusoid set alone."""

from __future__ import annotations

from benchmarks.figure import Figure


def figures() -> list[Figure]:
    """``earthquake_static_fit``."""
    return [
        Figure(
            "earthquake_static_fit",
            None,
            "Fit 1 - NRMSE [%] of each record by the set of the sinusoid records alone.",
            None,
            "Not measured yet.",
        )
    ]
