"""Figures of real records: what the studies write of them, and cold starts.

``make truth`` writes build/truth/truth.json, and ``make control`` build/control/control.json. Both
studies are run first, and take up what they have stored for the same code.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figure import Measured, Value
from mr_damper_ros.api.replay import replay
from mr_damper_ros.io.records import read_runs
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.sigmoid.following import EXTENDED_MODEL
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.engine import EngineSettings
from studies import recordings
from studies.__main__ import STUDIES
from studies.truth.records import judge_records

# -- what the studies write ------------------------------------------------------------------------

_LAWS = {"sixteen": "sigmoid", "extended": EXTENDED_MODEL, "springs": "series_springs"}
"""Laws by their names in the figures."""

_ONE_SET = (
    *("series_springs", "bingham", "hyperbolic_tangent", "nonlinear_biviscous"),
    *("bouc_wen", "modified_bouc_wen"),
)
"""Laws of ``utfsm_<name>_nrmse``, besides "sixteen" and "extended"."""

_ONLINE = {"fit": EXTENDED_MODEL, "springs_fit": "series_springs"}
_STATIC = {**_ONLINE, "sixteen_fit": "sigmoid"}
"""Laws of ``earthquake_online_<name>`` and ``earthquake_static_<name>``."""


def document(study: str, quick: bool) -> tuple[dict[str, Any], str]:
    """The results of a study, part by part, and their origin.

    The study is run, but computes only what it has not yet stored for this code.
    """
    folder = Path("build", study + "-quick" * quick)
    code = STUDIES[study](["--output", str(folder), *["--quick"] * quick])
    if code:
        raise RuntimeError(f"the study {study} ended with exit code {code}")
    path = folder / f"{study}.json"
    return json.loads(path.read_text(encoding="utf-8")), f"From {path}."


def truth_figures(quick: bool = False) -> Measured:
    """Results of the laws on the recordings; None for results that a quick study leaves out."""
    laws: dict[str, Any] = {}
    note = recordings.NONE
    if recordings.folder() is not None:
        parts, note = document("truth", quick)
        laws = parts["recordings"]

    def told(law: str, key: str) -> Any:
        value = laws.get(law, {}).get(key)
        return None if isinstance(value, list) and None in value else value

    found: dict[str, Value] = {}
    names = {"sixteen": "sigmoid", "extended": EXTENDED_MODEL} | {law: law for law in _ONE_SET}
    for name, law in names.items():
        median = told(law, "one_set_median")
        found[f"utfsm_{name}_nrmse"] = None if median is None else 100.0 * median
    found["utfsm_one_set"] = found["utfsm_extended_nrmse"]
    medians = []
    for name, law in _LAWS.items():
        errors = [100.0 * error for error in (told(law, "left_out_nrmse") or {}).values()]
        both = [float(np.median(errors)), float(np.mean(errors))] if errors else None
        found[f"utfsm_left_out_{name}_nrmse"] = both
        medians += both[:1] if both else []
    found["utfsm_left_out"] = min(medians, default=None)
    for kind, shaken in (("static", _STATIC), ("online", _ONLINE)):
        for name, law in shaken.items():
            found[f"earthquake_{kind}_{name}"] = told(law, f"earthquake_{kind}_fit")
    static = [told(law, "earthquake_static_fit") for law in _LAWS.values()]
    means = [float(np.mean(fits)) for fits in static if fits]
    found["earthquake_static_mean"] = max(means, default=None)
    return {key: (value, note) for key, value in found.items()}


def control_figures(quick: bool = False) -> Measured:
    """Figures of the best controller on each road."""
    parts, note = document("control", quick)
    roads = parts["roads"]
    named = ", ".join(f"{road} {name}" for road, name in roads["best"].items())
    return {key: (value, f"{note} The best: {named}.") for key, value in roads["worst"].items()}


# -- cold starts of the identifier on an unknown damper --------------------------------------------

_TWO_LAWS = ("sigmoid", EXTENDED_MODEL)

_GOOD, _NEXT = 0.75, 2.0
"""Smallest good fit, 1 - NRMSE, of the predicted force, and the time [s] of its evaluation after a
set."""

_MOVING = 1e-4
_BEFORE, _AFTER = 1.0, 9.0
"""Duration [s] of a record before and after the start of the motion, and its threshold [m]."""


def _start_of_motion(record: Recording) -> int:
    """Index of the first sample in motion."""
    return int(np.argmax(np.abs(record.displacement - record.displacement[0]) > _MOVING))


def _from_rest(record: Recording, seed: int) -> Recording:
    """The record without so many tenths of its rest before the motion, 0 to 9 by the seed."""
    return recordings.cut(record, slice(_start_of_motion(record) * (seed % 10) // 10, None))


def _begin_of(record: Recording) -> Recording:
    """The first seconds of the motion in a record."""
    begin = max(_start_of_motion(record) - round(_BEFORE / record.period), 0)
    part = slice(begin, begin + round((_BEFORE + _AFTER) / record.period))
    return recordings.cut(record, part)


def _windows_until_good(record: Recording, model: str) -> float:
    """Number of windows in motion until the fit is good, or infinity."""
    said = replay(record, settings=EngineSettings().for_law(model), block_size=20)
    force, following = said.predicted, round(_NEXT / record.period)
    ends = [
        round((report.stamp_ns - record.start_ns) / NANOSECONDS / record.period) + 1
        for report in said.reports
        if report.verdict not in (Verdict.FAULT_OF_DATA, Verdict.ACCEPTED_EARLY)
        and report.window_start_ns < report.stamp_ns
    ]
    for count, end in enumerate(ends, start=1):
        after = slice(end, end + following)
        if after.stop > force.size:
            break
        error = recordings.rms(force[after] - record.force[after])
        if 1.0 - error / np.std(record.force[after]) >= _GOOD:
            return float(count)
    return float("inf")


def cold_start_figures(seed: int = 0) -> Measured:
    """The beginning of the three earthquake records."""
    place = recordings.folder()
    if place is None:
        return {"cold_start_windows": (None, recordings.NONE)}
    records = [_from_rest(each, seed) for each in recordings.unsmoothed_earthquakes(place)]
    begins = [_begin_of(record) for record in records]
    found = [_windows_until_good(record, law) for law in _TWO_LAWS for record in begins]
    return {"cold_start_windows": found}


# -- on line, from the set of the processed records ------------------------------------------------

_RAW_COLUMNS = "-,time:datetime,force:980.665*N,displacement:10*mm"
_RAW_CURRENTS = (0.0, 0.25, 0.5, 0.75, 1.0)


def raw_records(utfsm: Path) -> list[Recording]:
    """The runs in the original files of the logger."""
    paths = sorted((utfsm / "raw").glob("ME*.txt"))
    return [run for path in paths for run in read_runs(path, _RAW_COLUMNS, currents=_RAW_CURRENTS)]


def _fit_and_valid(record: Recording, known: ParameterSet) -> tuple[float, float]:
    """Fit 1 - NRMSE of the predicted force and share of valid samples, in motion [%]."""
    said = replay(record, known, settings=EngineSettings().for_law(known.model))
    moving = slice(_start_of_motion(record), None)
    error = recordings.rms(said.predicted[moving] - record.force[moving])
    fit = 1.0 - error / float(np.std(record.force[moving]))
    return 100.0 * fit, 100.0 * float(np.mean(said.valid[moving]))


def online_figures(
    laws: Sequence[str] = ("sigmoid", EXTENDED_MODEL, "series_springs"),
    longest: float = 100.0,
    seed: int = 0,
) -> Measured:
    """The raw sinusoids by each law, and the earthquakes by the first, at most ``longest`` [s]."""
    keys = ("raw_sines_online_fit", "raw_sines_online_valid_percent")
    place = recordings.folder()
    if place is None:
        return dict.fromkeys((*keys, "earthquake_online_sixteen_fit"), (None, recordings.NONE))
    sets = [judge_records(law, None, place, 1)["set"] for law in laws]
    sines = [_from_rest(record, seed) for record in raw_records(place)]
    found = [np.mean([_fit_and_valid(record, known) for record in sines], axis=0) for known in sets]
    fits = []
    for whole in recordings.unsmoothed_earthquakes(place):
        record = recordings.cut(_from_rest(whole, seed), slice(0, round(longest / whole.period)))
        force = replay(record, sets[0], block_size=20).predicted
        fits.append(recordings.fit_percent(record, force))
    fit, valid = np.transpose(found).tolist()
    return {keys[0]: fit, keys[1]: valid, "earthquake_online_sixteen_fit": fits}
