"""How the force at an operating point falls with temperature, and the temperature from the force.

The force scale (:mod:`force_scale`) of the windows at one operating point is fitted over the
temperature that was measured with them:

    ln s(T) = c0 + c1 z + c2 z²,   z = (T - centre) / half of the span

c1 alone is the exponential law, to which Arrhenius' law of the viscosity comes down over some ten
kelvin; c2 is used where the data ask for it (Schwarz' criterion). A map that does not rise or fall
throughout is none. It holds where temperatures were measured and nowhere else. Parameters are
never interpolated: sets of different temperatures may lie in different basins.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.estimation.covariance import least_squares_covariance
from mr_damper_ros.estimation.observability import SURE
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.force_scale import ForceScale
from mr_damper_ros.tracking.operating_point import KnownPoints, OperatingPoint, PointRecord

_FEWEST = 8
"""Fewer windows than this give no map."""

_MOST = 400
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

    Identified from ``low`` to ``high`` [°C] from ``windows`` windows. ``coefficients`` (k,) and
    their ``covariance`` (k, k) are those of ln s over z, k being 2 or 3; ``scatter`` is the
    standard deviation of ln s about the map.
    """

    operating_point: OperatingPoint
    low: float
    high: float
    coefficients: Array
    covariance: Array
    scatter: float
    windows: int

    def scale(self, celsius: float) -> ForceScale:
        """Force scale at a temperature [°C] within the map; unknown outside."""
        if not self.low <= celsius <= self.high:
            return ForceScale()
        basis = self._basis(celsius)
        value = math.exp(float(basis @ self.coefficients))
        return ForceScale(value, value * math.sqrt(float(basis @ self.covariance @ basis)))

    def slope(self, celsius: float) -> float:
        """Relative change of the force by a kelvin [1/K], also just outside of the map."""
        z = self._place(celsius)
        powers = np.arange(1, self.coefficients.size)
        return float(np.sum(powers * self.coefficients[1:] * z ** (powers - 1))) / self._half

    def temperature(self, scale: ForceScale) -> FluidTemperature:
        """Temperature that a force scale tells of; unknown where none within the map has it.

        The standard error holds that of the map, and that of the scale or the scatter of scales
        about the map, whichever is larger.
        """
        if not scale.value > 0.0:
            return FluidTemperature()
        wanted = math.log(scale.value) - float(self.coefficients[0])
        places = np.array([wanted / self.coefficients[1]])
        if self.coefficients.size == 3:
            places = np.roots([self.coefficients[2], self.coefficients[1], -wanted])
        inside = [float(z.real) for z in places if abs(z.imag) == 0.0 and -1.0 <= z.real <= 1.0]
        if len(inside) != 1:
            return FluidTemperature()
        celsius = 0.5 * (self.low + self.high) + inside[0] * self._half
        basis = self._basis(celsius)
        variance = float(basis @ self.covariance @ basis)
        variance += max(scale.standard_error / scale.value, self.scatter) ** 2
        return FluidTemperature(celsius, math.sqrt(variance) / abs(self.slope(celsius)))

    @property
    def _half(self) -> float:
        return 0.5 * (self.high - self.low)

    def _place(self, celsius: float) -> float:
        return (celsius - 0.5 * (self.low + self.high)) / self._half

    def _basis(self, celsius: float) -> Array:
        return np.asarray(self._place(celsius) ** np.arange(self.coefficients.size))


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
    if celsius.size < _FEWEST or np.ptp(celsius) == 0.0:
        return None
    low, high = float(celsius.min()), float(celsius.max())
    z = (2.0 * celsius - (low + high)) / (high - low)
    logarithm, weights = np.log(scales), (scales / errors) ** 2
    fits = [_polynomial(z, logarithm, weights, count) for count in (2, 3)]
    monotone = [fit for fit in fits if _is_monotone(fit[0])]
    if not monotone:
        return None
    coefficients, residual = min(monotone, key=lambda fit: _schwarz(fit[1], weights, fit[0].size))
    jacobian = z[:, np.newaxis] ** np.arange(coefficients.size)
    scatter = math.sqrt(float(residual @ residual) / max(z.size - coefficients.size, 1))
    found = TemperatureMap(
        operating_point,
        low,
        high,
        coefficients,
        least_squares_covariance(jacobian, residual, weights),
        scatter,
        int(z.size),
    )
    for place in (low, 0.5 * (low + high), high):
        known_to = math.hypot(scatter, found.scale(place).standard_error / found.scale(place).value)
        if not known_to < SURE * (high - low) * abs(found.slope(place)):
            return None
    return found


def _polynomial(z: Array, values: Array, weights: Array, count: int) -> tuple[Array, Array]:
    """Weighted least-squares coefficients (count,) and the residual (n,)."""
    basis, root = z[:, np.newaxis] ** np.arange(count), np.sqrt(weights)
    coefficients = np.linalg.lstsq(basis * root[:, np.newaxis], values * root, rcond=None)[0]
    return np.asarray(coefficients), np.asarray(basis @ coefficients - values)


def _is_monotone(coefficients: Array) -> bool:
    curvature = 2.0 * abs(float(coefficients[2])) if coefficients.size == 3 else 0.0
    return bool(abs(float(coefficients[1])) > curvature)


def _schwarz(residual: Array, weights: Array, count: int) -> float:
    """Schwarz' criterion, the smaller the better."""
    power = max(float(np.sum(weights * residual**2)), 1e-300)
    return residual.size * math.log(power) + count * math.log(residual.size)


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
    return known.noted(point, temperatures=_paired(seen) if len(seen) > _MOST else seen)


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
