"""One set of each model for the real sinusoid records, side by side."""

from __future__ import annotations

from benchmarks.figure import Figure
from benchmarks.utfsm_sixteen import median_nrmse_percent
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.models import MODELS
from studies import recordings

_BOUNDS = {"modified_bouc_wen": (0.0, 10.5)}
"""The recording authors' own set of that model, for all 30 of their records, leaves 11.4 %."""

_ELSEWHERE = ("sigmoid", "sigmoid_lag")
"""They have figures of their own."""


def figures() -> list[Figure]:
    """``utfsm_<model>_nrmse`` for every model whose coefficients follow the current."""
    place = recordings.folder()
    windows = None if place is None else recordings.processed_windows(place)
    return [
        Figure(
            f"utfsm_{name}_nrmse",
            None if windows is None else median_nrmse_percent(windows, EvolutionSettings(), name),
            "Median over the processed sinusoid records of RMSE/std of the force [%], one set of "
            f"the {model.title} model for all, ramps included.",
            _BOUNDS.get(name),
            recordings.NONE if place is None else "",
        )
        for name, model in MODELS.items()
        if name not in _ELSEWHERE
    ]
