"""How the force has changed against a baseline, and how it falls with temperature.

The force scale of the windows at one operating point is fitted over the temperature that was
measured with them:

    ln s(T) = c0 + c1 z + c2 z²,   z = (T - centre) / half of the span

c1 alone is the exponential law, to which Arrhenius' law of the viscosity comes down over some ten
kelvin; c2 is used where the data ask for it (Schwarz' criterion). A map that does not rise or fall
throughout is none. It holds where temperatures were measured and nowhere else. Parameters are
never interpolated: sets of different temperatures may lie in different basins.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import Polynomial
from numpy.polynomial.polynomial import polyvander

from mr_damper_ros.estimation.covariance import NoiseModel, least_squares_covariance
from mr_damper_ros.estimation.observability import SURE
from mr_damper_ros.estimation.window_fit import WindowFit, fit_of
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.misfit import WindowProblem
from mr_damper_ros.signals.arrays import NORMAL_MEDIAN, Array
from mr_damper_ros.tracking.cusum import ScaleFit
from mr_damper_ros.tracking.operating_point import (
    KnownPoints,
    OperatingPoint,
    PointRecord,
    nearest_same,
)

_MOST_POWER = 1e100
"""Sum of squared forces [N²] beyond any damper's, far below where its square overflows."""

_ALIKE = 0.5
"""A force of less correlation with that of the baseline is no multiple of it."""

_REMEMBERED = 40
_FEWEST_PAIRS = 5


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
    ratio = math.sqrt(float(np.median(squares))) / NORMAL_MEDIAN
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


_FEWEST_WINDOWS = 8
"""Fewer windows than this give no map."""

_MOST_WINDOWS = 400
"""More windows than this are averaged in pairs of neighbouring temperature."""

_LARGEST = 1e6
"""No temperature [°C] and no force scale [1] is beyond this."""


@dataclass(frozen=True)
class FluidTemperature:
    """Temperature [°C] with its standard error [K]; NaN where it is not known."""

    celsius: float = math.nan
    standard_error: float = math.nan


@dataclass(frozen=True, eq=False)
class TemperatureMap:
    """Force scale over temperature at one operating point (peak velocity [m/s], current [A]).

    ``curve`` is ln s over the temperature [°C]; its domain is that of the ``windows`` windows from
    which it was identified. ``covariance`` (k, k) is that of its k coefficients over z, ``scatter``
    the standard deviation of ln s about it.
    """

    operating_point: OperatingPoint
    curve: Polynomial
    covariance: Array
    scatter: float
    windows: int

    @property
    def low(self) -> float:
        """Lowest temperature [°C]."""
        return float(self.curve.domain[0])

    @property
    def high(self) -> float:
        """Highest temperature [°C]."""
        return float(self.curve.domain[1])

    @property
    def coefficients(self) -> Array:
        """Those (k,) of ln s over z, k being 2 or 3."""
        return np.asarray(self.curve.coef)

    def scale(self, celsius: float) -> ForceScale:
        """Force scale at a temperature [°C] within the map; unknown outside."""
        if not self.low <= celsius <= self.high:
            return ForceScale()
        value = math.exp(float(self.curve(celsius)))
        return ForceScale(value, value * self._error(celsius))

    def slope(self, celsius: float) -> float:
        """Relative change of the force by a kelvin [1/K], also just outside of the map."""
        return float(self.curve.deriv()(celsius))

    def temperature(self, scale: ForceScale) -> FluidTemperature:
        """Temperature that a force scale tells of; unknown where none within the map has it.

        The standard error holds that of the map, and that of the scale or the scatter of scales
        about the map, whichever is larger.
        """
        if not scale.value > 0.0:
            return FluidTemperature()
        roots = np.asarray((self.curve - math.log(scale.value)).roots(), dtype=complex)
        inside = [
            float(root.real)
            for root in roots
            if root.imag == 0.0 and self.low <= root.real <= self.high
        ]
        if len(inside) != 1:
            return FluidTemperature()
        told = max(scale.standard_error / scale.value, self.scatter)
        error = math.hypot(self._error(inside[0]), told)
        return FluidTemperature(inside[0], error / abs(self.slope(inside[0])))

    def _error(self, celsius: float) -> float:
        """Standard error of ln s."""
        basis = _basis(self.curve, celsius)
        return math.sqrt(float(basis @ self.covariance @ basis))


def _basis(curve: Polynomial, celsius: float | Array) -> Array:
    """Powers (..., k) of z, by which the coefficients of a curve are multiplied."""
    offset, factor = curve.mapparms()
    return polyvander(offset + factor * celsius, curve.degree()).squeeze()


def fit_temperature_map(
    operating_point: OperatingPoint, celsius: Array, scales: Array, errors: Array
) -> TemperatureMap | None:
    """Map from the temperatures [°C] and the force scales of windows, with their standard errors.

    Arrays have shape (n,), in the order of time. None where they do not identify a map: fewer than
    eight windows, a force that does not rise or fall throughout, or one that tells the temperature
    no better than to a quarter of the span that was seen.
    """
    good = np.isfinite(celsius) & np.isfinite(errors) & (scales > 0.0) & (errors > 0.0)
    celsius, scales, errors = celsius[good], scales[good], errors[good]
    if celsius.size < _FEWEST_WINDOWS or np.ptp(celsius) == 0.0:
        return None
    ends = [float(celsius.min()), float(celsius.max())]
    logarithm, weights = np.log(scales), (scales / errors) ** 2

    def criterion(curve: Polynomial) -> float:
        """Schwarz' criterion, the smaller the better."""
        power = max(float(np.sum(weights * (curve(celsius) - logarithm) ** 2)), 1e-300)
        return celsius.size * math.log(power) + curve.coef.size * math.log(celsius.size)

    curves = (Polynomial.fit(celsius, logarithm, k, ends, w=np.sqrt(weights)) for k in (1, 2))
    monotone = [each for each in curves if np.prod(each.deriv()(np.array(ends))) > 0.0]
    if not monotone:
        return None
    curve = min(monotone, key=criterion)
    residual = curve(celsius) - logarithm
    scatter = math.sqrt(float(residual @ residual) / max(celsius.size - curve.coef.size, 1))
    covariance = least_squares_covariance(_basis(curve, celsius), residual, weights)
    found = TemperatureMap(operating_point, curve, covariance, scatter, int(celsius.size))
    for place in (*ends, 0.5 * sum(ends)):
        known_to = math.hypot(scatter, found.scale(place).standard_error / found.scale(place).value)
        if not known_to < SURE * (ends[1] - ends[0]) * abs(found.slope(place)):
            return None
    return found


def can_be_seen(seen: Array) -> bool:
    """Whether these (n, 3), temperature [°C], force scale and its error, can be those of a damper.

    A thermometer whose sensor is not connected tells 9.9e37 °C: SCPI's word for it.
    """
    return bool(np.all(np.abs(seen) < _LARGEST) and np.all(seen[:, 1:] > 0.0))


def with_temperature(
    known: KnownPoints, point: OperatingPoint, celsius: float, scale: ForceScale
) -> KnownPoints:
    """The records after a window, if its temperature [°C] and its force scale are known.

    The force scales of one operating point must be against one baseline.
    """
    row = np.array([[celsius, scale.value, scale.standard_error]])
    if not can_be_seen(row):
        return known
    seen = np.concatenate([known.at(point).temperatures, row])
    return known.noted(point, temperatures=_paired(seen) if len(seen) > _MOST_WINDOWS else seen)


def temperature_map(known: PointRecord) -> TemperatureMap | None:
    """The map of an operating point, if what was seen there identifies one."""
    return fit_temperature_map(known.point, *known.temperatures.T)


def _paired(seen: Array) -> Array:
    """Half as many (n, 3), each the mean of two neighbours in temperature; the ends stay."""
    ordered = seen[np.argsort(seen[:, 0], kind="stable")]
    inner = ordered[1:-1]
    count = len(inner) // 2 * 2
    one, other, odd = inner[0:count:2], inner[1:count:2], inner[count:]
    pairs = 0.5 * (one + other)
    pairs[:, 2] = 0.5 * np.hypot(one[:, 2], other[:, 2])
    return np.concatenate([ordered[:1], pairs, odd, ordered[-1:]])
