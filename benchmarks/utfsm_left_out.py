"""Real sinusoid records predicted by a set that has seen no record of their motion."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.figure import Figure
from benchmarks.state_law import STATE_LAW
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.sigmoid.extension import EXTENDED_MODEL
from studies import recordings
from studies.truth.records import error_of, set_without


def left_out_nrmse(utfsm: Path, law: str) -> list[float]:
    """Median and mean over the records of RMSE/std [%].

    One amplitude and frequency is left out at a time, at all its currents, and predicted as the
    model node does: with the peak velocity held within the range of the other records.
    """
    motions = recordings.processed_motions(utfsm)
    errors = []
    for left_out, records in motions.items():
        found = set_without(motions, law, left_out)
        errors += [100.0 * error_of(found, window) for window in records]
    return [float(np.median(errors)), float(np.mean(errors))]


LAWS = {"sixteen": "sigmoid", "extended": EXTENDED_MODEL, "springs": STATE_LAW}


def figures() -> list[Figure]:
    """``utfsm_left_out_<law>_nrmse`` and ``utfsm_left_out``."""
    place = recordings.folder()
    note = recordings.NONE if place is None else ""
    errors = {
        name: None if place is None else left_out_nrmse(place, law) for name, law in LAWS.items()
    }
    medians = [found[0] for found in errors.values() if found is not None]
    return [
        *(
            Figure(
                f"utfsm_left_out_{name}_nrmse",
                errors[name],
                "Median and mean over the processed sinusoid records of RMSE/std of the force [%], "
                "each amplitude and frequency predicted by the set of the others: "
                f"{MODELS[law].title}.",
                None,
                note,
            )
            for name, law in LAWS.items()
        ),
        Figure(
            "utfsm_left_out",
            min(medians, default=None),
            "The median of the best of these laws [%].",
            (0.0, 8.0),
            note,
        ),
    ]
