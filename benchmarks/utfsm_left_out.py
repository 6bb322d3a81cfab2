"""Real sinusoid records predicted by a set that has seen no record of their motion."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks import recordings
from benchmarks.figure import Figure
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.sigmoid.extension import EXTENDED_MODEL


def left_out_nrmse(utfsm: Path, law: str) -> list[float]:
    """Median and mean over the records of RMSE/std [%].

    One amplitude and frequency is left out at a time, at all its currents, and predicted as the
    model node does: with the peak velocity held within the range of the other records.
    """
    model = MODELS[law]
    start = model.initial_values()[0]
    motions = recordings.processed_motions(utfsm)
    errors = []
    for left_out, records in motions.items():
        others = [w for name, windows in motions.items() if name != left_out for w in windows]
        found = identify_global(model, others, start, EvolutionSettings()).parameter_set
        for window in records:
            held = window.held_within(*found.peak_velocity_range)
            residual = model.window_force(held, found.values) - window.force
            errors.append(100.0 * float(np.sqrt(np.mean(residual**2)) / np.std(window.force)))
    return [float(np.median(errors)), float(np.mean(errors))]


def figures() -> list[Figure]:
    """``utfsm_left_out_sixteen_nrmse`` and ``utfsm_left_out_extended_nrmse``."""
    place = recordings.folder()
    shared = (
        "Median and mean over the processed sinusoid records of RMSE/std of the force [%], each "
        "amplitude and frequency predicted by the set of the others; "
    )
    return [
        Figure(
            f"utfsm_left_out_{name}_nrmse",
            None if place is None else left_out_nrmse(place, model),
            shared + words,
            None,
            recordings.NONE if place is None else "",
        )
        for name, model, words in (
            ("sixteen", "sigmoid", "the sixteen parameters alone."),
            ("extended", EXTENDED_MODEL, "the extended law."),
        )
    ]
