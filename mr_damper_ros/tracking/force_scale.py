"""How the force has changed against a baseline, with its standard error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mr_damper_ros.estimation.covariance import NoiseModel
from mr_damper_ros.estimation.window_fit import WindowFit, fit_of
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.misfit import WindowProblem
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.cusum import ScaleFit
from mr_damper_ros.tracking.operating_point import OperatingPoint, nearest_same

_MOST_POWER = 1e100
"""Sum of squared forces [N²] beyond any damper's, far below where its square overflows."""

_ALIKE = 0.5
"""A force of less correlation with that of the baseline is no multiple of it."""

_REMEMBERED = 40
_FEWEST_PAIRS = 5

_MEDIAN_SQUARE = 0.4549
"""Median of a squared normal number."""


@dataclass(frozen=True)
class ForceScale:
    """Force against the baseline, 1 = unchanged; NaN where there is no baseline to compare with.

    ``standard_error`` is that from window to window of the same motion; ``discrepancy``: what
    another motion or another law may say besides, as far as that is known. ``misfit``: in a motion
    that is no steady sine, root mean square of what the baseline cannot follow, over that of the
    force; else NaN.
    """

    value: float = math.nan
    standard_error: float = math.nan
    misfit: float = math.nan
    discrepancy: float = math.nan


@dataclass(frozen=True)
class SeenScale:
    """A scale in a motion that was no steady sine, and the stamps of its window."""

    start_ns: int
    end_ns: int
    value: float
    standard_error: float


def widened(
    scale: ForceScale, seen: tuple[SeenScale, ...], start_ns: int, end_ns: int
) -> tuple[ForceScale, tuple[SeenScale, ...]]:
    """The scale of a window with an error that holds its scatter, and the scales seen with it.

    How much the scale of a constant damper varies with the motion is learnt from window to window.
    What a law cannot follow depends on the motion and may last longer than a window, so no window
    tells by itself how far off its scale is. The difference of two windows that have no sample in
    common does: the standard errors are widened until its median is what they say (the ratio of
    Birge, Physical Review 40, 1932). A median, since a damper that changes at once is another
    matter.
    """
    if not (math.isfinite(scale.misfit) and scale.standard_error > 0.0):
        return scale, seen
    if seen and start_ns < seen[-1].start_ns:
        seen = ()  # time was set back
    seen = (*seen, SeenScale(start_ns, end_ns, scale.value, scale.standard_error))[-_REMEMBERED:]
    squares = _squares(seen)
    if len(squares) < _FEWEST_PAIRS:
        # Until it is known, it may be all that is not understood.
        return replace(scale, standard_error=max(scale.misfit, scale.standard_error)), seen
    ratio = math.sqrt(float(np.median(squares)) / _MEDIAN_SQUARE)
    return replace(scale, standard_error=max(ratio, 1.0) * scale.standard_error), seen


def _squares(seen: Sequence[SeenScale]) -> list[float]:
    """Squared differences of neighbours without a sample in common, in their variances."""
    squares = []
    for place, later in enumerate(seen):
        before = [each for each in seen[:place] if each.end_ns <= later.start_ns]
        if before:
            variance = before[-1].standard_error ** 2 + later.standard_error**2
            squares.append((later.value - before[-1].value) ** 2 / variance)
    return squares


def force_scale(
    model: Model, window: Window, fit: WindowFit, baselines: Sequence[WindowFit]
) -> ForceScale:
    """Scale that maps the force of the baseline onto that of a window, in the least-squares sense.

    In a steady sine the force of the window is what its fit predicts: what the law cannot follow is
    in both and plays no part. The standard error is that of the fit from window to window; that of
    the baseline is common to all reports and left out. In any other motion a fit follows the motion
    of its window more than the damper: there the oldest baseline at the current is the one
    reference, held against the measured force; see :func:`widened` for its error. ``baselines``:
    the first accepted fit of each operating point, oldest first.
    """
    steady = window.motion.sine is not None
    point = fit.operating_point
    baseline = baseline_at(baselines, point) if steady else _at_current(baselines, point)
    if baseline is None:
        return ForceScale()
    problem = WindowProblem(model, window, fit.parameters)
    settled = problem.settled
    reference = model.window_force(window, baseline.parameters)[settled]
    if not steady:
        return _measured_scale(reference, window.force[settled])
    present = model.window_force(window, fit.parameters)[settled]
    jacobian = problem.jacobian(fit.scales)[settled]
    scale = scale_between(reference, present, jacobian, fit.covariance)
    if fit.discrepancy is None:
        return scale
    besides = scale_between(reference, present, jacobian, fit.discrepancy).standard_error
    return replace(scale, discrepancy=besides)


def baseline_at(baselines: Sequence[WindowFit], point: OperatingPoint) -> WindowFit | None:
    """That of an operating point (peak velocity [m/s], current [A]), if any."""
    index = nearest_same([fit.operating_point for fit in baselines], point)
    return None if index is None else baselines[index]


def _at_current(baselines: Sequence[WindowFit], point: OperatingPoint) -> WindowFit | None:
    """The oldest at the current of an operating point, whatever its motion."""
    speed, _ = point
    for fit in baselines:
        if nearest_same([(speed, fit.operating_point[1])], point) == 0:
            return fit
    return None


def _measured_scale(reference: Array, measured: Array) -> ForceScale:
    """Scale that maps the force (n,) [N] of a baseline onto the measured one, in least squares."""
    power = float(reference @ reference)
    if not _alike(reference, measured):
        return ForceScale()
    value = float(measured @ reference) / power
    noise = NoiseModel.of(measured - value * reference)
    variance = float(noise.score_covariance(reference[:, np.newaxis])[0, 0]) / power**2
    misfit = math.sqrt(noise.variance * reference.size / power)
    return ForceScale(value, math.sqrt(max(variance, 0.0)), misfit, misfit)


def with_strength(
    model: Model, window: Window, start: Array, found: ScaleFit, method: str
) -> WindowFit:
    """Parameters ``start`` (p,) with the strength of the damper changed, as a fit of the window."""
    # What follows the current rises and falls too, and no window is fitted with it.
    rest = np.setdiff1d(model.strength_indices, model.free_indices)
    start = start.copy()
    start[rest] *= found.factor
    problem = WindowProblem(model, window, start)
    moved = np.where(problem.strength, problem.start, 0.0)
    return fit_of(
        problem,
        problem.start + moved * (found.factor - 1.0),
        np.outer(moved, moved) * found.standard_error**2,
        method=method,
        evaluations=2,
    )


def scale_between(
    reference: Array, present: Array, jacobian: Array, covariance: Array
) -> ForceScale:
    """Scale that maps one force (n,) [N] onto another in the least-squares sense.

    ``jacobian`` (n, k) is that of the present force by unknowns of this ``covariance`` (k, k).
    """
    power = float(reference @ reference)
    if not _alike(reference, present):
        return ForceScale()
    # An unknown that the samples do not determine does not change the force either.
    determined = ~np.isnan(np.diag(covariance))
    gradient = (reference @ jacobian / power)[determined]
    variance = float(gradient @ covariance[np.ix_(determined, determined)] @ gradient)
    return ForceScale(float(present @ reference) / power, math.sqrt(max(variance, 0.0)))


def _alike(one: Array, other: Array) -> bool:
    """Whether one force (n,) [N] is about a multiple of another, which may be another damper's."""
    power = float(one @ one)
    product = float(one @ other)
    if not (0.0 < power < _MOST_POWER and product > 0.0):
        return False
    return product**2 > _ALIKE**2 * power * float(other @ other)
