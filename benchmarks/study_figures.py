"""Figures that the studies compute, read from the documents that they write.

``make truth`` leaves build/truth/truth.json, ``make control`` build/control/control.json. A study
whose document is missing, or is of the other variant (quick or not), is run first.
"""

from __future__ import annotations

import json
import math
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figure import Figure, Pair
from mr_damper_ros.models import MODELS
from studies import recordings
from studies.__main__ import STUDIES

_ONE_SET: dict[str, tuple[str, Pair | None]] = {
    "sixteen": ("sigmoid", (0.0, 10.0)),
    "extended": ("sigmoid_lag", (0.0, 8.0)),
    "series_springs": ("series_springs", None),
    "bingham": ("bingham", None),
    "hyperbolic_tangent": ("hyperbolic_tangent", None),
    "nonlinear_biviscous": ("nonlinear_biviscous", None),
    "bouc_wen": ("bouc_wen", None),
    # The recording authors' own set of that model, for all 30 of their records, leaves 11.4 %.
    "modified_bouc_wen": ("modified_bouc_wen", (0.0, 10.5)),
}
"""Law and bar of ``utfsm_<name>_nrmse``."""

_UNSEEN = {"sixteen": "sigmoid", "extended": "sigmoid_lag", "springs": "series_springs"}
"""Law of ``utfsm_left_out_<name>_nrmse``."""

_EARTHQUAKES = {"fit": "sigmoid_lag", "springs_fit": "series_springs", "sixteen_fit": "sigmoid"}
"""Law of ``earthquake_static_<name>`` and ``earthquake_online_<name>``."""


def document(study: str, part: str, quick: bool) -> tuple[Any, str]:
    """What the study says of one of its parts, None where it is not there; and where it is from."""
    folder = Path("build", study + "-quick" * quick)
    path = folder / f"{study}.json"

    def found() -> Any:
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}

    if found().get("quick") != quick or part not in found():
        run = import_module(STUDIES[study]).main
        code = run(["--output", str(folder), *["--quick"] * quick])
        if code:
            raise RuntimeError(f"the study {study} ended with exit code {code}")
    return found().get(part), f"From {path}."


def truth_figures(quick: bool = False) -> list[Figure]:
    """``utfsm_...`` and ``earthquake_...``: what the laws make of the recordings."""
    found, note = None, recordings.NONE
    if recordings.folder() is not None:
        found, note = document("truth", "recordings", quick)
    laws = {} if found is None else found

    def value(law: str, key: str) -> Any:
        told = laws[law][key] if law in laws else None
        # The quick variant does not try everything.
        return None if isinstance(told, list) and None in told else told

    def percent(law: str, key: str) -> float | None:
        return None if law not in laws else 100.0 * laws[law][key]

    left_out = {law: value(law, "left_out_nrmse") for law in _UNSEEN.values()}
    static = {law: value(law, "earthquake_static_fit") for law in _EARTHQUAKES.values()}
    one_set = "Median over the processed sinusoid records of RMSE/std of the force [%], one set of "
    figures = [
        Figure(
            f"utfsm_{name}_nrmse",
            percent(law, "one_set_median"),
            f"{one_set}the {MODELS[law].title} model for all, ramps included.",
            bar,
            note,
        )
        for name, (law, bar) in _ONE_SET.items()
    ]
    figures.append(
        Figure(
            "utfsm_one_set",
            percent("sigmoid_lag", "one_set_median"),
            "utfsm_extended_nrmse with the bar of one set for twenty records.",
            (0.0, 6.0),
            note,
        )
    )
    for name, law in _UNSEEN.items():
        errors = [100.0 * error for error in (left_out[law] or {}).values()]
        figures.append(
            Figure(
                f"utfsm_left_out_{name}_nrmse",
                [float(np.median(errors)), float(np.mean(errors))] if errors else None,
                "Median and mean over the processed sinusoid records of RMSE/std of the force [%], "
                "each amplitude and frequency predicted by the set of the others: "
                f"{MODELS[law].title}.",
                None,
                note,
            )
        )
    medians = [100.0 * float(np.median([*each.values()])) for each in left_out.values() if each]
    figures.append(
        Figure(
            "utfsm_left_out",
            min(medians, default=None),
            "The median of the best of these laws [%].",
            (0.0, 8.0),
            note,
        )
    )
    for kind, how, bar in (
        ("static", "predicted by the set of the sinusoid records alone", 86.0),
        ("online", "with the identifier running from the sinusoid set on", 91.0),
    ):
        for name, law in _EARTHQUAKES.items():
            figures.append(
                Figure(
                    f"earthquake_{kind}_{name}",
                    value(law, f"earthquake_{kind}_fit"),
                    "Fit 1 - NRMSE [%] of the records at 0.2, 0.6 and 1.0 A, their smoothing "
                    f"undone, {how}, every block before it is used, after the first 5 s of motion: "
                    f"{MODELS[law].title}.",
                    (bar, math.inf) if (kind, name) == ("online", "fit") else None,
                    note,
                )
            )
    means = [float(np.mean(fits)) for fits in static.values() if fits]
    figures.append(
        Figure(
            "earthquake_static_mean",
            max(means, default=None),
            "Mean of the three [%], of the best of these laws.",
            (86.0, math.inf),
            note,
        )
    )
    return figures


def control_figures(quick: bool = False) -> list[Figure]:
    """``car_...`` and ``building_...``: the best controller against passive dampers."""
    buildings, note = document("control", "buildings", quick)
    roads, _ = document("control", "roads", quick)
    cases = (
        f"{buildings['cases']} cases (El Centro and two invented earthquakes in place of Kobe and "
        "Maule), coil lag 10 ms"
    )
    named = ", ".join(f"{road} {name}" for road, name in roads["best"].items())
    return [
        *(
            Figure(
                key,
                value,
                "Quarter car, invented damper, coil lag 10 ms, roads A to E: RMS acceleration of "
                "the body (comfort) or RMS load of the tyre (holding) with the best controller of "
                "each road over that with the passive damper, on the worst road.",
                None,
                f"{note} The best: {named}.",
            )
            for key, value in roads["worst"].items()
        ),
        Figure(
            "building_cases_won",
            float(buildings["won"]),
            f"{cases}: those in which the weighted inverse is better than passive-on and bang-bang "
            "clipped-optimal in RMS displacement and acceleration of the roof.",
            (float(buildings["cases"]), math.inf),
            note,
        ),
        Figure(
            "building_reversals_per_second",
            buildings["reversals_per_second"],
            f"{cases}: most reversals of its current in a second.",
            (0.0, 20.0),
            note,
        ),
    ]
