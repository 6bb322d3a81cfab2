"""What the errors of an identified set show of its runs: wrong times, steps, zeros, another law."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from mr_damper_ros.api.comparison import Comparison
from mr_damper_ros.api.measured_runs import MeasuredRun, all_windows
from mr_damper_ros.data_check.channels import extent
from mr_damper_ros.data_check.findings import NOTE, WARN, Finding, Kind
from mr_damper_ros.data_check.lag import are_several
from mr_damper_ros.data_check.samples import skew_finding
from mr_damper_ros.estimation.local_search import LocalSearch
from mr_damper_ros.estimation.window_fit import WindowFit, fit_window
from mr_damper_ros.kinematics.window import TURN, Window, averages, turning_points
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.misfit import ChosenParameters, Misfit
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.quantities import SAME_CURRENT
from mr_damper_ros.signals.arrays import SIGMAS, Array

LARGEST_NRMSE = 0.3
"""Largest acceptable NRMSE of a run; above it, the set explains too little of the force."""

_RATIO, _POINTS = 1.4, 0.02
"""A cause matters if it increases the NRMSE of the set by this factor and by this much."""

_SAMPLES, _OF_ALL, _EXCERPT = 2000, 4000, 40_000
"""Approximate number of samples of a window, and of all windows, that are fitted to find a cause,
and number of samples of a window from which they are drawn."""

_POOR = 0.08
"""NRMSE above which fits from other starts and of other laws are tried."""


def matters(change: float, left: float) -> bool:
    """Whether a cause matters that changes the force this much; ``left`` is the NRMSE without it.

    Both are relative to the standard deviation of the force, and independent of each other.
    """
    error = math.hypot(change, left)
    return error > max(_RATIO * left, left + _POINTS)


class Explained(NamedTuple):
    """A run of an identified set: its forces, and its NRMSE, with its own level."""

    comparison: Comparison
    measured: MeasuredRun
    nrmse: float


def causes(
    found: ParameterSet, runs: Sequence[Explained], *, levelled: bool = False
) -> list[Finding]:
    """Findings on the errors of a set; ``levelled``: each run has a zero of its own."""
    # The samples of a shifted force must follow one another.
    whole = [run.measured for run in runs if run.measured.whole]
    findings = _times(found, all_windows(whole)) if whole else []
    findings += [each for run in runs for each in _steps(run.comparison)]
    if not (levelled or findings):
        findings += _zeros(found, runs)
    worst = max(runs, key=lambda run: run.nrmse)
    if not findings:
        laws = _other_law(found.model, worst.measured.longest, worst.nrmse)
        findings += [replace(each, source=worst.comparison.name) for each in laws]
    for run in runs:
        if run.nrmse > LARGEST_NRMSE:
            each = Kind.UNEXPLAINED.found(value=run.nrmse, nrmse=run.nrmse, limit=LARGEST_NRMSE)
            findings.append(replace(each, source=run.comparison.name))
    return findings


# -- fits of changed windows -----------------------------------------------------------------


class _Refit(NamedTuple):
    """The parameters (p,) that fit some windows best from a start, and their NRMSE."""

    values: Array
    nrmse: float


def _thinned(windows: Sequence[Window]) -> list[Window]:
    most = min(_SAMPLES, _OF_ALL // len(windows))
    return [window.thinned(most) for window in windows]


def _refitted(
    found: ParameterSet, windows: Sequence[Window], start: Array, *, anew: bool = False
) -> _Refit:
    """Least squares over the parameters that are observable in the set; infinite if it fails.

    ``anew``: a poor result is compared with that from a fit of the first window.
    """
    few = _thinned(windows)
    misfit = Misfit(
        found.law, [*map(found.held, few)], [float(np.std(window.force)) for window in few], start
    )
    problem = ChosenParameters(misfit, start, np.flatnonzero(found.observable).tolist())
    search = LocalSearch(problem, problem.start)
    try:
        search.least_squares(tolerance=1e-3, most_steps=12)
    except (ValueError, ArithmeticError):
        return _Refit(start, math.inf)
    fitted = replace(found, values=problem.parameters(search.best))
    refit = _Refit(fitted.values, _nrmse_of(fitted, few))
    if not anew or refit.nrmse <= _POOR:
        return refit
    other = _window_fit(found.model, few[0])
    if other is None:
        return refit
    fitted = replace(found, values=other.parameters)
    return min(refit, _Refit(fitted.values, _nrmse_of(fitted, few)), key=lambda fit: fit.nrmse)


def _nrmse_of(found: ParameterSet, windows: Sequence[Window]) -> float:
    """Root mean square of the NRMSE of a set in windows, as it predicts them."""
    squares = []
    for window in windows:
        gradual = found.turns_gradually(window)
        known = found.settled(window, gradual=gradual)
        error = (found.window_force(window, gradual=gradual) - window.force)[known]
        squares.append(float(error @ error) / max(error.size, 1) / float(np.var(window.force)))
    return math.sqrt(float(np.mean(squares)))


def _change(found: ParameterSet, values: Array, windows: Sequence[Window]) -> float:
    """RMS change of the force of the set with other ``values`` (p,), relative to the deviation."""
    few = _thinned(windows)
    other = replace(found, values=values)
    squares = [
        float(np.mean((other.window_force(w) - found.window_force(w)) ** 2) / np.var(w.force))
        for w in few
    ]
    return math.sqrt(float(np.mean(squares)))


def _excerpt(window: Window) -> Window:
    """The middle of a long window."""
    if window.sample_count <= _EXCERPT:
        return window
    return window.stretch((window.sample_count - _EXCERPT) // 2, _EXCERPT)


def _longest(windows: Sequence[Window]) -> list[Window]:
    """Excerpts of the longest windows."""
    chosen = sorted(windows, key=lambda window: -window.sample_count)
    return [*map(_excerpt, chosen[:_MOST_WINDOWS])]


# -- wrong times -----------------------------------------------------------------------------

_SHIFTS = (2e-3, 5e-3, 10e-3, 20e-3, 40e-3, 60e-3)
"""Shifts [s] of the force that are tried in both directions, and then halfway around the best."""

_SHIFTED = 0.7
"""Part of the NRMSE that a shift leaves at most, where it is named. A damper with a lag seems to be
late: those of ``silent_wrong`` leave 0.71 or more without a shift, and 0.67 or less with one."""

_HOPELESS = 1.3
"""Ratio of the NRMSE to the best so far at which larger shifts are not tried."""

_STROKE_SAMPLES = 5000
"""Approximate number of samples of a motion in which strokes are looked for."""

_MOST_WINDOWS = 6
"""Largest number of windows whose force or current is shifted."""


def _times(found: ParameterSet, windows: Sequence[Window]) -> list[Finding]:
    """A finding on a force, or else on a current, that was recorded late or early."""
    findings = _late_force(found, _telling(windows))
    if not findings:
        late, error = current_lateness(found, windows)
        findings = lateness_finding(late, error)
        if findings:
            changing = [_with_shifted_current(w, late) for w in _longest(_changing(windows))]
            refit = _refitted(found, changing, found.values)
            serious = matters(_change(found, refit.values, changing), refit.nrmse)
            findings = [replace(f, severity=WARN if serious else NOTE) for f in findings]
    return findings


def _telling(windows: Sequence[Window]) -> list[Window]:
    """The longest windows if they tell a shift in time from the hysteresis, otherwise none.

    They must hold strokes of several durations: at a single frequency, the hysteresis makes up for
    a shift.
    """
    chosen = _longest(windows)
    durations = [duration for window in chosen for duration in _strokes(window)]
    return chosen if are_several(np.array(durations)) else []


def _strokes(window: Window) -> list[float]:
    """Durations [s] of the strokes of a motion."""
    position = averages(window.motion.displacement, _STROKE_SAMPLES)
    places = turning_points(position.tolist(), TURN * float(np.ptp(position)))[1:-1]
    duration = window.sample_count * window.period / position.size
    return (np.diff(places) * duration).tolist()


def _late_force(found: ParameterSet, windows: Sequence[Window]) -> list[Finding]:
    """A finding on the shift of the force with which the law explains the windows much better."""
    if not windows or not found.observable.any():
        return []
    here = _refitted(found, windows, found.values)
    trials = {0.0: here}

    def attempt(shift: float, start: Array) -> _Refit:
        moved = [_with_shifted_force(window, shift) for window in windows]
        found_there = trials[shift] = _refitted(found, moved, start, anew=True)
        return found_there

    for sign in (1.0, -1.0):
        last = here
        for size in _SHIFTS:
            last = attempt(sign * size, last.values)
            if last.nrmse > _HOPELESS * min(each.nrmse for each in trials.values()):
                break
    late = min(trials, key=lambda shift: trials[shift].nrmse)
    if late == 0.0:
        return []
    for other in _neighbours(late, trials):
        attempt(0.5 * (late + other), trials[late].values)
    late = min(trials, key=lambda shift: trials[shift].nrmse)
    best = trials[late]
    # The fits at other times may have found a better minimum.
    again = _refitted(found, windows, best.values, anew=True)
    if best.nrmse > min(_SHIFTED * min(here.nrmse, again.nrmse), 0.5 * LARGEST_NRMSE):
        return []
    doubt = 0.5 * float(np.mean([abs(each - late) for each in _neighbours(late, trials)]))
    serious = matters(_change(found, best.values, windows), best.nrmse)
    return [replace(skew_finding(late, doubt), severity=WARN if serious else NOTE)]


def _neighbours(shift: float, trials: Iterable[float]) -> list[float]:
    """The shifts that were tried next to one of them."""
    tried = sorted(trials)
    place = tried.index(shift)
    return [tried[each] for each in (place - 1, place + 1) if 0 <= each < len(tried)]


def _with_shifted_force(window: Window, late: float) -> Window:
    """The window with the force that was recorded ``late`` [s] moved back to its motion."""
    places = np.arange(window.sample_count) + round(late / window.period)
    inside = (places >= 0) & (places < window.sample_count)
    moved = replace(window, force=window.force[places.clip(0, window.sample_count - 1)])
    return moved.part(inside)


_LATEST, _STEP = 0.3, 0.01
"""Largest shift of a current that is tried, and the step between two [s]."""

_PARTS = 10
"""Number of parts of the windows whose scatter gives the error of the shift."""

_FOLLOWS, _PRECEDES = 0.04, 0.01
"""Delay [s] with which the field of a damper may follow its current, and by which a force seems to
precede its current because of the error of the law."""

_BETTER = 0.9
"""Part of the squared error that is left with a shift that is reported, at most."""


def _changing(windows: Iterable[Window]) -> list[Window]:
    """The windows in which the current changes."""
    return [w for w in windows if float(np.ptp(w.current)) > 2.0 * SAME_CURRENT]


def current_lateness(found: ParameterSet, windows: Sequence[Window]) -> tuple[float, float]:
    """How much later than the current the force changes [s], and its standard error [s].

    It is the shift of the current with which a set explains the windows best, relative to the
    current as it was recorded. NaN with an infinite error if the current is constant, or if no
    shift explains the windows much better.
    """
    changing = _changing(windows)
    shifts = np.arange(-_LATEST, _LATEST + 0.5 * _STEP, _STEP)
    if not changing:
        return math.nan, math.inf
    errors = np.array([_squared_errors(found, changing, shift) for shift in shifts.tolist()])

    def best(sums: Array) -> float:
        """The shift at the minimum of a parabola through the smallest of the errors (m,)."""
        place = int(np.clip(np.argmin(sums), 1, sums.size - 2))
        before, least, after = sums[place - 1 : place + 2]
        bend = before - 2.0 * least + after
        return float(shifts[place] + 0.5 * _STEP * (before - after) / bend if bend > 0.0 else 0.0)

    whole = errors.sum(axis=1)
    if whole.min() > _BETTER * whole[shifts.size // 2]:
        return math.nan, math.inf
    without = [best(whole - part) for part in errors.T]
    return best(whole), math.sqrt((_PARTS - 1) * float(np.var(without)))


def lateness_finding(late: float, error: float) -> list[Finding]:
    """A finding on a force that follows the current too late, or precedes it; both in [s]."""
    limit = _FOLLOWS if late > 0.0 else _PRECEDES
    if not abs(late) > max(limit, SIGMAS * error):
        return []
    direction = "later" if late > 0.0 else "earlier"
    return [
        Kind.CURRENT_SKEW.found(
            "current",
            value=late,
            error=error,
            late=abs(late),
            doubt=error,
            direction=direction,
            lateness=-late,
        )
    ]


def _squared_errors(found: ParameterSet, windows: Sequence[Window], shift: float) -> Array:
    """Squared errors [N²] of the set with a shifted current, summed over each part, (parts,)."""
    sums = np.zeros(_PARTS)
    for window in windows:
        few = _with_shifted_current(window, shift).thinned(2 * _SAMPLES)
        square = (found.window_force(few) - few.force) ** 2
        sums += [float(part.sum()) for part in np.array_split(square, _PARTS)]
    return sums


def _with_shifted_current(window: Window, shift: float) -> Window:
    """The window with its current ``shift`` [s] later."""
    places = np.arange(window.sample_count) - round(shift / window.period)
    current = window.current[places.clip(0, window.sample_count - 1)]
    whole = None if window.whole is None else _with_shifted_current(window.whole, shift)
    return replace(window, current=current, whole=whole)


# -- steps of zero and gain ------------------------------------------------------------------

_PLACES = 20
"""A step may lie between any two of so many parts of a run."""

_DRAWN = 500
"""Number of samples of a run that are compared."""

_DRIFT = 0.7
"""Part of the squared error with a steady drift that is left with steps, at most."""


def _steps(run: Comparison) -> list[Finding]:
    """A finding on a zero or a gain of the force that changes at once, once or twice, in a run."""
    known = ~np.isnan(run.predicted)
    drawn = np.flatnonzero(known)
    if (size := drawn.size // _DRAWN) > 1:
        # A constant stride would look at a few phases of the cycle.
        parts = np.arange(0, _DRAWN * size, size)
        drawn = drawn[parts + np.random.default_rng(0).integers(0, size, _DRAWN)]
    if drawn.size < 2 * _PLACES or not np.std(run.predicted[drawn]) > 0.0:
        return []
    predicted, measured = run.predicted[drawn], run.measured[drawn]
    # A run often begins and ends with another motion.
    places = np.linspace(0, drawn.size, _PLACES + 1).astype(int)[2:-2].tolist()
    usual = [np.ones(drawn.size), predicted]
    whole, _ = _left(usual, measured)
    scale, time = math.sqrt(drawn.size) * float(np.std(measured)), np.linspace(-1, 1, drawn.size)
    steps: list[tuple[float, Finding]] = []
    for kind, amount in (
        (Kind.ZERO_CHANGES, np.ones(drawn.size)),
        (Kind.GAIN_CHANGES, predicted - predicted.mean()),
    ):
        drift, _ = _left([*usual, time * amount], measured)
        for chosen in (*combinations(places, 1), *combinations(places, 2)):
            edges = [amount * (np.arange(drawn.size) >= place) for place in chosen]
            left, factors = _left([*usual, *edges], measured)
            change = math.sqrt(max(whole - left, 0.0)) / scale
            if left < _DRIFT * drift and matters(change, math.sqrt(left) / scale):
                step = float(max(factors[2:], key=abs))
                steps.append((left, replace(kind.found("force", value=step, step=step))))
    named = sorted(steps, key=lambda each: each[0])[:1]
    return [replace(finding, source=run.name) for _, finding in named]


def _left(columns: Sequence[Array], values: Array) -> tuple[float, Array]:
    """Sum of the squares that a combination of columns leaves of values, and its factors."""
    matrix = np.column_stack(columns)
    factors = np.linalg.lstsq(matrix, values, rcond=None)[0]
    rest = values - matrix @ factors
    return float(rest @ rest), np.asarray(factors)


_TRACE = 0.4
"""A zero leaves a mean residual of at least this part of the RMSE of its run: 0.5 and more in
``silent_wrong``, and at most 0.3 in twenty real runs without one. Without this limit, the fits of
those took 1.2 s longer (``sigmoid``), or 3 s (``sigmoid_lag``)."""

_ROUNDS, _MOST_RUNS = 4, 20
"""Number of fits in which the zeros of runs are found, and largest number of these runs."""


def _zeros(found: ParameterSet, runs: Sequence[Explained]) -> list[Finding]:
    """A finding on the run whose zero differs most from those of the others, if it matters.

    The set has made up for the zeros in part, so that they are found by fits.
    """
    if not (1 < len(runs) <= _MOST_RUNS and found.observable.any()):
        return []
    off = np.array([float(np.nanmean(run.comparison.residual)) for run in runs])
    rest = np.array([run.comparison.error.rmse for run in runs])
    if np.all(np.abs(off - np.median(off)) <= _TRACE * rest):
        return []
    windows = _thinned([_excerpt(run.measured.longest) for run in runs])
    # A preload of gas is one zero for all runs, which some laws lack.
    middle = float(np.mean([extent(window.force)[0] for window in windows]))
    starts = (np.zeros(len(runs)), np.full(len(runs), middle))
    common = min(
        (_with_zeros(found, windows, start, common=True) for start in starts),
        key=lambda each: each[0],
    )
    own, zeros = _with_zeros(found, windows, common[1], common=False)
    if common[0] <= max(_RATIO * own, own + _POINTS):
        return []
    apart = zeros - np.median(zeros)
    place = int(np.argmax(np.abs(apart)))
    differs = Kind.ZERO_DIFFERS.found("force", value=float(apart[place]), step=apart[place])
    return [replace(differs, source=runs[place].comparison.name)]


def _with_zeros(
    found: ParameterSet, windows: Sequence[Window], zeros: Array, *, common: bool
) -> tuple[float, Array]:
    """NRMSE with a zero of each window (m,) [N], or with a ``common`` one, and the zeros."""
    last, trials = found.values, []
    for _ in range(2 if common else _ROUNDS):
        moved = [replace(w, force=w.force - z) for w, z in zip(windows, zeros, strict=True)]
        refit = _refitted(found, moved, last)
        trials.append((refit.nrmse, zeros))
        last, fitted = refit.values, replace(found, values=refit.values)
        off = np.array([_zero_of(fitted, window) for window in moved])
        zeros = zeros + (np.mean(off) if common else off)
    return min(trials, key=lambda trial: trial[0])


def _zero_of(found: ParameterSet, window: Window) -> float:
    """Mean [N] of the measured force minus that of the set."""
    known = found.settled(window)
    off = (window.force - found.window_force(window, gradual=None))[known]
    return float(off.mean()) if off.size else 0.0


# -- another law -----------------------------------------------------------------------------

_MUCH_BETTER = 0.6
"""Another law is named if its NRMSE is at most this part of that of the law."""


def _other_law(model: str, window: Window, nrmse: float) -> list[Finding]:
    """A finding on a law that fits a window much better, with the unknowns of the window."""
    if nrmse <= _POOR:
        return []
    here = min(_nrmse(model, window), nrmse)
    trials = {other: _nrmse(other, window) for other in MODELS if other != model}
    other = min(trials, key=trials.__getitem__)
    if not trials[other] <= _MUCH_BETTER * here:
        return []
    better = trials[other]
    found = Kind.OTHER_LAW.found(value=better, other=other, better=better, model=model, nrmse=here)
    return [replace(found, severity=WARN if nrmse > LARGEST_NRMSE else NOTE)]


def _window_fit(model: str, window: Window) -> WindowFit | None:
    """The fit of a law to a window from its initial values; None if it fails."""
    law = MODELS[model]
    start = law.initial_values()[0]
    try:
        return fit_window(law, window.thinned(_SAMPLES), start, method="least_squares")
    except (ValueError, ArithmeticError):
        return None


def _nrmse(model: str, window: Window) -> float:
    """NRMSE of the window fit of a law; infinite if it fails."""
    fit = _window_fit(model, window)
    return math.inf if fit is None else fit.nrmse
