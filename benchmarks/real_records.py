"""Real records, if available: cold starts, jumps of the force, and searches from random starts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.figure import Measured
from mr_damper_ros.api.replay import replay
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import GlobalFit, identify_global
from mr_damper_ros.estimation.observability import operating_points_within
from mr_damper_ros.estimation.profile_likelihood import profiled, search_misfit
from mr_damper_ros.io.run_cuts import read_runs
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.sigmoid.following import EXTENDED_MODEL
from mr_damper_ros.processes.process_pool import Notify, ProcessPool
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.engine import EngineSettings
from studies import recordings

LAWS = ("sigmoid", EXTENDED_MODEL)

_RAW_COLUMNS = "-,time:datetime,force:980.665*N,displacement:10*mm"
_RAW_CURRENTS = (0.0, 0.25, 0.5, 0.75, 1.0)


def raw_records(utfsm: Path) -> list[Recording]:
    """The runs in the original files of the logger."""
    paths = sorted((utfsm / "raw").glob("ME*.txt"))
    return [run for path in paths for run in read_runs(path, _RAW_COLUMNS, currents=_RAW_CURRENTS)]


def _unmeasured(*keys: str) -> Measured:
    return dict.fromkeys(keys, (None, recordings.NONE))


# -- cold starts of the identifier on an unknown damper --------------------------------------------

_GOOD, _NEXT = 0.75, 2.0
"""Smallest good fit, 1 - NRMSE, of the predicted force, and the time [s] of its evaluation after a
set."""

_MOVING = 1e-4
_BEFORE, _AFTER = 1.0, 9.0
"""Duration [s] of a record before and after the start of the motion, and its threshold [m]."""

_BLOCK = 0.02


def _begin_of(record: Recording) -> Recording:
    """The first seconds of the motion in a record."""
    moves = np.abs(record.displacement - record.displacement[0]) > _MOVING
    begin = max(int(np.argmax(moves)) - round(_BEFORE / record.period), 0)
    part = slice(begin, begin + round((_BEFORE + _AFTER) / record.period))
    return recordings.cut(record, part)


def _windows_until_good(record: Recording, model: str) -> tuple[float, float]:
    """Number of windows in motion until the fit is good (or infinity), and the largest valid force.

    The force is relative to the largest measured force of the record.
    """
    said = replay(
        record,
        settings=EngineSettings().for_law(model),
        block_size=max(round(_BLOCK / record.period), 1),
    )
    force, following = said.predicted, round(_NEXT / record.period)
    ends = [
        round((report.stamp_ns - record.start_ns) / NANOSECONDS / record.period) + 1
        for report in said.reports
        if report.verdict not in (Verdict.FAULT_OF_DATA, Verdict.ACCEPTED_EARLY)
        and report.window_start_ns < report.stamp_ns
    ]
    largest = float(np.abs(force[said.valid]).max(initial=0.0) / np.abs(record.force).max())
    for count, end in enumerate(ends, start=1):
        after = slice(end, end + following)
        if after.stop > force.size:
            break
        error = force[after] - record.force[after]
        if 1.0 - float(np.sqrt(np.mean(error**2)) / np.std(record.force[after])) >= _GOOD:
            return float(count), largest
    return float("inf"), largest


def cold_start_figures() -> Measured:
    """The beginning of the three earthquake records."""
    place = recordings.folder()
    if place is None:
        return _unmeasured("cold_start_windows", "cold_start_largest_force")
    begins = [_begin_of(record) for record in recordings.unsmoothed_earthquakes(place)]
    found = [_windows_until_good(record, law) for law in LAWS for record in begins]
    return {
        "cold_start_windows": [count for count, _ in found],
        "cold_start_largest_force": [size for _, size in found],
    }


# -- how far the predicted force jumps between two samples -----------------------------------------

_SETTLED = 1.0
"""Time [s] at the start of a record that is ignored, while the observer and the centre settle."""


def _largest_step(force: Array, period: float) -> float:
    return float(np.nanmax(np.abs(np.diff(force[round(_SETTLED / period) :]))))


def _worst_jump(records: Iterable[Recording], parameters: ParameterSet) -> tuple[float, str]:
    """Largest step of the predicted force over that of the measured force, and the record name."""
    return max(
        (
            _largest_step(recordings.predicted(record, parameters, identify=False), record.period)
            / _largest_step(record.force, record.period),
            record.name,
        )
        for record in records
    )


def jump_figures(laws: Sequence[str] = LAWS) -> Measured:
    """Measure the steps with the set of the sinusoid records."""
    place = recordings.folder()
    if place is None:
        return _unmeasured("reversal_jump", "reversal_jump_smoothed")
    rough, smoothed = [], []
    for law in laws:
        known = recordings.sinusoid_set(place, law)
        rough += [
            _worst_jump(records, known)
            for records in (raw_records(place), recordings.unsmoothed_earthquakes(place))
        ]
        smoothed.append(_worst_jump(recordings.processed_records(place), known))
    return {
        key: ([value for value, _ in worst], "; ".join(name for _, name in worst))
        for key, worst in (("reversal_jump", rough), ("reversal_jump_smoothed", smoothed))
    }


# -- convergence of searches from random starts to the lowest minimum ------------------------------

_AS_GOOD = 1.01
"""A search agrees with the published one if its cost is at most this many times as large."""

_SCALES = 1.0
"""Standard deviation of the logarithm of a random scale, around the default start of the model."""

_Search = tuple[str, Sequence[Window], Array, int]


def _random_start(law: str, windows: Sequence[Window], seed: int) -> Array:
    """Parameters (p,) of a random damper with a different force and shape."""
    model, rng = MODELS[law], np.random.default_rng(seed)
    speeds, currents = operating_points_within(windows)
    start = model.initial_values()[0]
    scales = model.places(model.scale_names)
    start[scales] *= np.exp(rng.normal(0.0, _SCALES, scales.size))
    drawn = model.draw_shape(rng, max(speeds), max(currents))
    start[model.places(tuple(drawn))] = list(drawn.values())
    return np.clip(start, *model.bounds)


def _identified(search: _Search, notify: Notify) -> GlobalFit:
    law, windows, start, seed = search
    return identify_global(MODELS[law], windows, start, EvolutionSettings(seed=seed))


def _agreeing(
    law: str, windows: Sequence[Window], published: GlobalFit, starts: int, pool: ProcessPool
) -> float:
    """Fraction of the searches from random starts that reach the cost of the published one.

    All costs use the noise estimate of the published search, because each search scales its own
    cost by the residuals of its fits to single records.
    """
    searches = [
        (law, windows, _random_start(law, windows, seed), seed) for seed in range(1, starts + 1)
    ]
    fits = pool.map(_identified, searches)
    misfit = search_misfit(published, windows)
    most = _AS_GOOD * misfit.mean_square(published.parameter_set.values)
    costs = [misfit.mean_square(fit.parameter_set.values) for fit in fits if fit is not None]
    return float(np.mean(np.array(costs) <= most))


def _containing(
    windows: Sequence[Window], published: GlobalFit, pool: ProcessPool
) -> tuple[float, str]:
    """Fraction of the observable parameters within their interval, and the names of the others."""
    found = published.parameter_set
    names = [n for n, seen in zip(found.law.parameter_names, found.observable, strict=True) if seen]
    fit, profiles = profiled(published, windows, names, EvolutionSettings(), pool)
    values = fit.parameter_set.as_dict()
    missed = [each.name for each in profiles if not each.contains(values[each.name])]
    return 1.0 - len(missed) / len(profiles), ", ".join(missed)


def start_figures(
    starts: int = 20, laws: Sequence[str] = LAWS, step: int = 1, workers: int = 2
) -> Measured:
    """The processed sinusoid records, every ``step``-th."""
    place = recordings.folder()
    if place is None:
        return _unmeasured("starts_agreeing", "profile_contains_estimate")
    windows = recordings.processed_windows(place)[::step]
    parts, contained, notes = [], [], []
    with ProcessPool(workers) as pool:
        for law in laws:
            start = MODELS[law].initial_values()[0]
            published = identify_global(MODELS[law], windows, start, EvolutionSettings())
            parts.append(_agreeing(law, windows, published, starts, pool))
            share, missed = _containing(windows, published, pool)
            contained.append(share)
            notes.append(f"{law}: cost {published.cost:.4g}, outside {missed or 'none'}")
    return {
        "starts_agreeing": (parts, "; ".join(notes)),
        "profile_contains_estimate": contained,
    }
