"""One sixteen-parameter set for the real sinusoid records."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.figure import Figure
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL
from studies import recordings


def median_nrmse_percent(
    windows: Sequence[Window], settings: EvolutionSettings, law: str = DEFAULT_MODEL
) -> float:
    """Median over the windows of RMSE/std [%] of one set identified from all of them.

    ``law``: name of the model.
    """
    model = MODELS[law]
    start = model.initial_values()[0]
    return 100.0 * identify_global(model, windows, start, settings).median_nrmse


def figures() -> list[Figure]:
    """``utfsm_sixteen_nrmse``."""
    place = recordings.folder()
    value = (
        None
        if place is None
        else median_nrmse_percent(recordings.processed_windows(place), EvolutionSettings())
    )
    return [
        Figure(
            "utfsm_sixteen_nrmse",
            value,
            "Median over the processed sinusoid records of RMSE/std of the force [%], one set of "
            "16 parameters for all, ramps included.",
            (0.0, 10.0),
            recordings.NONE if place is None else "",
        )
    ]
