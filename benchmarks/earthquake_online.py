"""Earthquake records with the identifier running."""

from __future__ import annotations

from benchmarks.figure import Figure


def figures() -> list[Figure]:
    """``earthquake_online_fit``."""
    return [
        Figure(
            "earthquake_online_fit",
            None,
            "Fit 1 - NRMSE [%] of each record, every block predicted before it is used, after the "
            "first 5 s of motion.",
            (80.0, 100.0),
            "Not measured yet.",
        )
    ]
