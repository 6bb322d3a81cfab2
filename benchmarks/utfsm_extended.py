"""One set of the extended law for the real sinusoid records."""

from __future__ import annotations

from benchmarks.figure import Figure
from benchmarks.utfsm_sixteen import median_nrmse_percent
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.models.sigmoid.extension import EXTENDED_MODEL
from studies import recordings


def figures() -> list[Figure]:
    """``utfsm_extended_nrmse`` and ``utfsm_one_set``."""
    place = recordings.folder()
    value = None
    if place is not None:
        windows = recordings.processed_windows(place)
        value = median_nrmse_percent(windows, EvolutionSettings(), EXTENDED_MODEL)
    return [
        Figure(
            "utfsm_extended_nrmse",
            value,
            "Median over the processed sinusoid records of RMSE/std of the force [%], one set for "
            "all with the optional lag, stiffness and offset, ramps included.",
            (0.0, 8.0),
            recordings.NONE if place is None else "",
        ),
        Figure(
            "utfsm_one_set",
            value,
            "The same figure with the bar of one set for twenty records; the other laws are among "
            "utfsm_sixteen and utfsm_models.",
            (0.0, 6.0),
            recordings.NONE if place is None else "",
        ),
    ]
