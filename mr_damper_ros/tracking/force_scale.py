"""The force scale against a baseline, and its dependence on temperature.

The force scales of the windows at one operating point are fitted over the measured temperature:

    ln s(T) = c0 + c1 z + c2 z²,   z = (T - centre) / half of the span

With c1 alone this is an exponential law, which approximates Arrhenius' law of the viscosity over
some tens of kelvin. c2 is included if Schwarz' criterion selects it. A map must be monotonic, and
holds only within the range of measured temperatures. Parameters are never interpolated between
temperatures, because sets may belong to different local minima.
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
from mr_damper_ros.estimation.window_fit import WindowFit
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.misfit import UNHELD, WindowProblem
from mr_damper_ros.signals.arrays import NORMAL_MEDIAN, Array, Positive
from mr_damper_ros.signals.recording import TEMPERATURES
from mr_damper_ros.tracking.operating_point import (
    MOST_WINDOWS,
    KnownPoints,
    OperatingPoint,
    PointRecord,
    nearest_same,
)

_SMALLEST_CORRELATION = 0.5
"""Smallest correlation with the baseline's force at which a force scale is computed."""

_FEWEST_WINDOWS = 8
"""Smallest number of windows for a map, and of differences between windows to estimate a scatter.
"""


@dataclass(frozen=True)
class ForceScale:
    """Force relative to the baseline (1: unchanged); NaN without a baseline.

    ``standard_error`` is the scatter between windows of the same motion. ``discrepancy`` is the
    model error: the additional error in a different motion; NaN if unknown. ``misfit`` is the RMS
    error of the scaled baseline relative to the RMS force; NaN in a steady sine.
    """

    value: float = math.nan
    standard_error: float = math.nan
    misfit: float = math.nan
    discrepancy: float = math.nan


@dataclass(frozen=True)
class WindowScale:
    """A force scale in a motion other than a steady sine, and the stamps of its window."""

    start_ns: int
    end_ns: int
    value: float
    standard_error: Positive


def widened(
    scale: ForceScale, seen: tuple[WindowScale, ...], start_ns: int, end_ns: int
) -> tuple[ForceScale, tuple[WindowScale, ...]]:
    """The scale with its standard error increased by the scatter, and the extended list of scales.

    Because of model error, the scale varies with the motion even if the damper does not change. The
    standard errors are increased until they agree with the median difference between windows
    without common samples (Birge ratio, Physical Review 40, 1932), which no sudden change affects.
    """
    if not (math.isfinite(scale.misfit) and scale.standard_error > 0.0):
        return scale, seen
    if seen and start_ns < seen[-1].start_ns:
        seen = ()  # the clock was set back
    seen = (*seen, WindowScale(start_ns, end_ns, scale.value, scale.standard_error))[-MOST_WINDOWS:]
    squares = []
    for place, later in enumerate(seen):
        before = [each for each in seen[:place] if each.end_ns <= later.start_ns]
        if before:
            variance = before[-1].standard_error ** 2 + later.standard_error**2
            squares.append((later.value - before[-1].value) ** 2 / variance)
    if len(squares) < _FEWEST_WINDOWS:
        # Until the scatter is known, the whole misfit counts as error.
        return replace(scale, standard_error=max(scale.misfit, scale.standard_error)), seen
    ratio = math.sqrt(float(np.median(squares))) / NORMAL_MEDIAN
    return replace(scale, standard_error=max(ratio, 1.0) * scale.standard_error), seen


def force_scale(
    model: Model, window: Window, fit: WindowFit, baselines: Sequence[PointRecord]
) -> ForceScale:
    """Least-squares factor from the force of the baseline to the force of a window.

    In a steady sine the force of the window's fit is compared with the force of the baseline, so
    that their common model error cancels. The error of the baseline is the same in all reports and
    is omitted. In any other motion a fit adapts to the motion of its window, so the measured force
    is compared with the oldest baseline at this current, and :func:`widened` gives the error.
    ``baselines`` are the records with a baseline, oldest first.
    """
    steady = window.motion.sine is not None
    speed, _ = point = fit.operating_point
    points = [each.point for each in baselines]
    if steady:
        place = nearest_same(points, point)
    else:
        same = [nearest_same([(speed, current)], point) == 0 for _, current in points]
        place = same.index(True) if any(same) else None
    if place is None or (baseline := baselines[place].baseline) is None:
        return ForceScale()
    problem = WindowProblem(model, window, fit.parameters, held=fit.held)
    settled = problem.settled
    as_then = window.held_within(*(baselines[place].held or UNHELD))
    reference = model.window_force(as_then, baseline)[settled]
    if not steady:
        return measured_scale(reference, window.force[settled])
    present = model.window_force(window.held_within(*fit.held), fit.parameters)[settled]
    jacobian = problem.jacobian(fit.scales)[settled]
    scale = scale_between(reference, present, jacobian, fit.covariance)
    if fit.discrepancy is None:
        return scale
    besides = scale_between(reference, present, jacobian, fit.discrepancy).standard_error
    return replace(scale, discrepancy=besides)


def measured_scale(reference: Array, measured: Array) -> ForceScale:
    """Least-squares scale that maps a predicted force (n,) [N] onto the measured force.

    It is NaN if the forces are hardly correlated. A fraction of a cycle determines this single
    factor well, but not seven coefficients.
    """
    power = float(reference @ reference)
    if not _are_proportional(reference, measured):
        return ForceScale()
    value = float(measured @ reference) / power
    noise = NoiseModel.of(measured - value * reference)
    variance = float(noise.score_covariance(reference[:, np.newaxis])[0, 0]) / power**2
    misfit = math.sqrt(noise.variance * reference.size / power)
    return ForceScale(value, math.sqrt(max(variance, 0.0)), misfit, misfit)


def scale_between(
    reference: Array, present: Array, jacobian: Array, covariance: Array
) -> ForceScale:
    """Least-squares scale that maps the ``reference`` onto the ``present`` force, (n,) [N].

    ``jacobian`` (n, k) holds the derivatives of the present force by the unknowns, whose covariance
    is ``covariance`` (k, k).
    """
    power = float(reference @ reference)
    if not _are_proportional(reference, present):
        return ForceScale()
    # An unknown that the samples do not determine has no effect on the force.
    determined = ~np.isnan(np.diag(covariance))
    gradient = (reference @ jacobian / power)[determined]
    variance = float(gradient @ covariance[np.ix_(determined, determined)] @ gradient)
    return ForceScale(float(present @ reference) / power, math.sqrt(max(variance, 0.0)))


def _are_proportional(one: Array, other: Array) -> bool:
    """Whether two forces (n,) [N] are roughly proportional, as forces of one damper are."""
    with np.errstate(over="ignore", invalid="ignore"):
        sizes = np.linalg.norm(one) * np.linalg.norm(other)
        usable = bool(sizes > 0.0 and np.square(one @ one) < math.inf)
        return usable and bool(one @ other > _SMALLEST_CORRELATION * sizes)


@dataclass(frozen=True)
class FluidTemperature:
    """Temperature [°C] with its standard error [K]; NaN if unknown."""

    celsius: float = math.nan
    standard_error: float = math.nan


@dataclass(frozen=True, eq=False)
class TemperatureMap:
    """Force scale over temperature at one operating point (peak velocity [m/s], current [A]).

    ``curve`` is ln s over the temperature [°C]; its domain is the range of the temperatures of its
    ``windows``. ``covariance`` (k, k) belongs to its k coefficients over z, and ``scatter`` is the
    standard deviation of ln s about the curve.
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
        """Coefficients (k,) of ln s over z; k is 2 or 3."""
        return np.asarray(self.curve.coef)

    def scale(self, celsius: float) -> ForceScale:
        """Force scale at a temperature [°C] within the map; NaN outside."""
        if not self.low <= celsius <= self.high:
            return ForceScale()
        value = math.exp(float(self.curve(celsius)))
        return ForceScale(value, value * self.error(celsius))

    def slope(self, celsius: float) -> float:
        """Relative change of the force per kelvin [1/K]; also defined just outside the map."""
        return float(self.curve.deriv()(celsius))

    def temperature(self, scale: ForceScale) -> FluidTemperature:
        """Temperature that corresponds to a force scale; NaN if the map contains none.

        The standard error combines the error of the map with either the standard error of the scale
        or the scatter of the scales about the map, whichever is larger.
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
        error = math.hypot(self.error(inside[0]), told)
        return FluidTemperature(inside[0], error / abs(self.slope(inside[0])))

    def error(self, celsius: float) -> float:
        """Standard error of ln s at a temperature [°C]."""
        basis = _basis(self.curve, celsius)
        return math.sqrt(float(basis @ self.covariance @ basis))


def _basis(curve: Polynomial, celsius: float | Array) -> Array:
    """Powers (..., k) of z at temperatures [°C]: the basis of a curve's coefficients."""
    offset, factor = curve.mapparms()
    return polyvander(offset + factor * celsius, curve.degree()).squeeze()


def temperature_map(known: PointRecord) -> TemperatureMap | None:
    """The map of an operating point, fitted to the temperatures and force scales of its windows.

    Returns None with fewer than eight windows, if the curve is not monotonic, or if the standard
    error of a temperature computed from the force exceeds a quarter of the measured range.
    """
    celsius, scales, errors = known.temperatures.T
    good = np.isfinite(celsius) & np.isfinite(errors) & (scales > 0.0) & (errors > 0.0)
    celsius, scales, errors = celsius[good], scales[good], errors[good]
    if celsius.size < _FEWEST_WINDOWS or np.ptp(celsius) == 0.0:
        return None
    ends = [float(celsius.min()), float(celsius.max())]
    logarithm, weights = np.log(scales), (scales / errors) ** 2

    def criterion(curve: Polynomial) -> float:
        """Schwarz' criterion; smaller is better."""
        power = max(float(np.sum(weights * (curve(celsius) - logarithm) ** 2)), 1e-300)
        return celsius.size * math.log(power) + curve.coef.size * math.log(celsius.size)

    curves = (Polynomial.fit(celsius, logarithm, k, ends, w=np.sqrt(weights)) for k in (1, 2))
    monotone = [each for each in curves if np.prod(each.deriv()(np.array(ends))) > 0.0]
    if not monotone:
        return None
    curve = min(monotone, key=criterion)
    residual = curve(celsius) - logarithm
    scatter = math.sqrt(float(residual @ residual) / max(celsius.size - curve.coef.size, 1))
    root = np.sqrt(weights)
    covariance = least_squares_covariance(root[:, None] * _basis(curve, celsius), root * residual)
    found = TemperatureMap(known.point, curve, covariance, scatter, int(celsius.size))
    widest = SURE * (ends[1] - ends[0])
    for place in (*ends, 0.5 * sum(ends)):
        if not math.hypot(scatter, found.error(place)) < widest * abs(found.slope(place)):
            return None
    return found


def is_plausible(seen: Array) -> bool:
    """Whether rows (n, 3) of temperature [°C], force scale and its error are plausible.

    A thermometer without a sensor reports 9.9e37 °C, the value that SCPI defines for NaN.
    """
    low, high = TEMPERATURES
    possible = (low <= seen[:, 0]) & (seen[:, 0] <= high)
    return bool(possible.all() and np.isfinite(seen).all() and np.all(seen[:, 1:] > 0.0))


def with_temperature(
    known: KnownPoints, point: OperatingPoint, celsius: float, scale: ForceScale
) -> KnownPoints:
    """The records with the temperature [°C] and the force scale of a window added, if plausible.

    All force scales of one operating point must refer to the same baseline. If there are too many
    entries, pairs of neighbouring temperatures are averaged.
    """
    row = np.array([[celsius, scale.value, scale.standard_error]])
    if not is_plausible(row):
        return known
    seen = np.concatenate([known.at(point).temperatures, row])
    return known.noted(point, temperatures=_paired(seen) if len(seen) > 4 * MOST_WINDOWS else seen)


def _paired(seen: Array) -> Array:
    """Average rows (n, 3) with neighbouring temperatures in pairs; the first and last row stay."""
    ordered = seen[np.argsort(seen[:, 0], kind="stable")]
    inner = ordered[1:-1]
    count = len(inner) // 2 * 2
    couples = inner[:count].reshape(-1, 2, 3)
    pairs = couples.mean(axis=1)
    pairs[:, 2] = 0.5 * np.hypot(*couples[:, :, 2].T)
    return np.concatenate([ordered[:1], pairs, inner[count:], ordered[-1:]])
