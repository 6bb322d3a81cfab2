"""The same with the optional lag, stiffness and offset."""

from __future__ import annotations

from benchmarks.figure import Figure


def figures() -> list[Figure]:
    """``utfsm_extended_nrmse``."""
    return [
        Figure(
            "utfsm_extended_nrmse",
            None,
            "Median RMSE/std [%] of one set with the optional lag, stiffness and offset.",
            (0.0, 8.0),
            "Not measured yet.",
        )
    ]
