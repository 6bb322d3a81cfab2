"""Figures of the studies, read from the documents that the studies write.

``make truth`` writes build/truth/truth.json, and ``make control`` build/control/control.json. If a
document is missing, or belongs to the other variant (quick or full), the study is run first.
"""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figure import Measured
from studies import recordings
from studies.__main__ import STUDIES

_ONE_SET = {
    "sixteen": "sigmoid",
    "extended": "sigmoid_lag",
    "series_springs": "series_springs",
    "bingham": "bingham",
    "hyperbolic_tangent": "hyperbolic_tangent",
    "nonlinear_biviscous": "nonlinear_biviscous",
    "bouc_wen": "bouc_wen",
    "modified_bouc_wen": "modified_bouc_wen",
}
"""Law of ``utfsm_<name>_nrmse``."""

_UNSEEN = {"sixteen": "sigmoid", "extended": "sigmoid_lag", "springs": "series_springs"}
"""Law of ``utfsm_left_out_<name>_nrmse``."""

_EARTHQUAKES = {"fit": "sigmoid_lag", "springs_fit": "series_springs", "sixteen_fit": "sigmoid"}
"""Law of ``earthquake_static_<name>`` and ``earthquake_online_<name>``."""


def document(study: str, part: str, quick: bool) -> tuple[Any, str]:
    """One part of the results of a study (None if it is missing), and its origin."""
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


def truth_figures(quick: bool = False) -> Measured:
    """Results of the laws on the recordings; None for results that a quick study leaves out."""
    laws: dict[str, Any] = {}
    note = recordings.NONE
    if recordings.folder() is not None:
        laws, note = document("truth", "recordings", quick)

    def told(law: str, key: str) -> Any:
        value = laws[law][key] if law in laws else None
        return None if isinstance(value, list) and None in value else value

    def percent(law: str) -> float | None:
        return 100.0 * laws[law]["one_set_median"] if law in laws else None

    figures: Measured = {
        f"utfsm_{name}_nrmse": (percent(law), note) for name, law in _ONE_SET.items()
    }
    figures["utfsm_one_set"] = (percent("sigmoid_lag"), note)
    medians = []
    for name, law in _UNSEEN.items():
        errors = [100.0 * error for error in (told(law, "left_out_nrmse") or {}).values()]
        both = [float(np.median(errors)), float(np.mean(errors))] if errors else None
        figures[f"utfsm_left_out_{name}_nrmse"] = (both, note)
        medians += both[:1] if both else []
    figures["utfsm_left_out"] = (min(medians, default=None), note)
    for kind in ("static", "online"):
        for name, law in _EARTHQUAKES.items():
            figures[f"earthquake_{kind}_{name}"] = (told(law, f"earthquake_{kind}_fit"), note)
    static = [told(law, "earthquake_static_fit") for law in _EARTHQUAKES.values()]
    means = [float(np.mean(fits)) for fits in static if fits]
    figures["earthquake_static_mean"] = (max(means, default=None), note)
    return figures


def control_figures(quick: bool = False) -> Measured:
    """Figures of the best controller on each road, and of the weighted inverse in buildings."""
    buildings, note = document("control", "buildings", quick)
    roads, _ = document("control", "roads", quick)
    named = ", ".join(f"{road} {name}" for road, name in roads["best"].items())
    return {
        **{key: (value, f"{note} The best: {named}.") for key, value in roads["worst"].items()},
        "building_cases_won": (float(buildings["won"]), f"Of {buildings['cases']}. {note}"),
        "building_reversals_per_second": (buildings["reversals_per_second"], note),
    }
