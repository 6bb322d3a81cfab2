"""Motion of a window of samples: displacement, velocity, acceleration, peak velocity.

A steady sinusoid is described by its fitted sine (thesis 2.8.1), whose derivatives carry almost no
noise. Any other motion is differentiated by a local polynomial (Savitzky and Golay, 1964) whose
length is chosen from the data. The residual of the sine fit decides between the two.
:mod:`mr_damper_ros.kinematics.peak_velocity` defines the peak velocity of any motion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.polynomial import polynomial

from mr_damper_ros.kinematics.peak_velocity import peak_velocity_of_window
from mr_damper_ros.signals.arrays import Array, span_of, white_noise

_ENOUGH_CYCLES = 2.0
_FAR_FROM_SINE = 0.4
"""For a sine of at least ``_ENOUGH_CYCLES``, a fit at the strongest line of the spectrum leaves a
residual of at most 0.15 of the displacement (standard deviations). A motion with a residual above
``_FAR_FROM_SINE`` is not a sine, unless the residual is noise ..."""

_SINE_NOISE = 2.0
"""... that is, at most this many times the white noise of the displacement."""

_ROUGHLY, _LAST_DIGITS = 1e-3, 1e-13
"""Relative tolerances of the two frequency fits. Motions shorter than ``_ENOUGH_CYCLES`` need the
rough fit, because their spectral line is too inaccurate to judge the residual."""


@dataclass(frozen=True)
class Sine:
    """u(t) = offset + amplitude sin(2 pi frequency t + phase), with the residual of its fit.

    ``amplitude`` and ``offset`` [m], ``frequency`` [Hz], ``phase`` [rad] at t = 0;
    ``residual_rms`` [m] is the root mean square of the displacement minus the sine.
    """

    amplitude: float
    frequency: float
    phase: float
    offset: float
    residual_rms: float

    def displacement(self, time: Array) -> Array:
        """Displacement about the centre of the motion (without the offset) [m]."""
        return self.amplitude * np.sin(2.0 * np.pi * self.frequency * time + self.phase)

    def velocity(self, time: Array) -> Array:
        """First derivative [m/s]."""
        omega = 2.0 * np.pi * self.frequency
        return self.amplitude * omega * np.cos(omega * time + self.phase)

    def acceleration(self, time: Array) -> Array:
        """Second derivative [m/s²]."""
        return -((2.0 * np.pi * self.frequency) ** 2) * self.displacement(time)


def fit_sine(displacement: Array, period: float) -> Sine | None:
    """Least-squares sine of a displacement of shape (n,) [m] sampled every ``period`` [s].

    The peak of the spectrum gives the initial frequency. Frequency is the only unknown that enters
    nonlinearly; the other three are solved linearly at each step. Returns None for fewer than eight
    samples, for a constant displacement, or if an early check shows that the motion is far from a
    sine.
    """
    u = np.asarray(displacement, dtype=float)
    n = u.size
    centred = u - u.mean()
    if n < 8 or np.ptp(u) == 0.0:
        return None
    # Zero padding refines the initial frequency to a fraction of a spectral line.
    spectrum = np.abs(np.fft.rfft(centred * np.hanning(n), 8 * n))
    # With less than half a cycle in the window, a sine, an offset and a ramp look alike.
    lowest = 4
    start = float(np.argmax(spectrum[lowest:]) + lowest) / (8 * n)
    # Time is counted from the middle, where frequency and phase are nearly uncorrelated.
    index = np.arange(n) - 0.5 * (n - 1)

    def basis(cycles_per_sample: float) -> Array:
        angle = 2.0 * np.pi * cycles_per_sample * index
        return np.column_stack((np.sin(angle), np.cos(angle), np.ones(n)))

    def solve(cycles_per_sample: float) -> tuple[Array, Array]:
        columns = basis(cycles_per_sample)
        weights = np.linalg.lstsq(columns, u, rcond=None)[0]
        return weights, columns @ weights - u

    scale = float(np.std(u))

    def fitted(start: float, tolerance: float) -> float:
        from scipy.optimize import least_squares  # here: see mr_damper_ros.entry_points

        fit = least_squares(
            lambda x: solve(x[0])[1] / scale,
            x0=[start],
            x_scale=1.0 / (8 * n),
            bounds=(lowest / (8 * n) / 2, 0.5),
            xtol=tolerance,
            ftol=tolerance,
            gtol=tolerance,
        )
        return float(fit.x[0])

    near = start if start * n >= _ENOUGH_CYCLES else fitted(start, _ROUGHLY)
    left = float(np.std(solve(near)[1]))
    if left > _FAR_FROM_SINE * scale and left > _SINE_NOISE * white_noise(u):
        return None
    frequency = fitted(near, _LAST_DIGITS)
    (sine, cosine, offset), residual = solve(frequency)
    omega = 2.0 * np.pi * frequency
    return Sine(
        amplitude=float(np.hypot(sine, cosine)),
        frequency=frequency / period,
        phase=float((np.arctan2(cosine, sine) - omega * 0.5 * (n - 1)) % (2.0 * np.pi)),
        offset=float(offset),
        residual_rms=float(np.sqrt(np.mean(residual**2))),
    )


class SavitzkyGolay:
    """Filter that fits a polynomial of degree ``order`` to ``length`` samples around each sample.

    Raises ValueError if the length is even or does not exceed the order.
    """

    def __init__(self, length: int, order: int) -> None:
        if length % 2 == 0 or length <= order:
            raise ValueError(f"the length is {length}: it must be odd and above {order}, the order")
        self._half = length // 2
        # In units of half the length, all powers are of similar magnitude.
        self._offsets = np.arange(-self._half, self._half + 1) / self._half
        self._fit = np.linalg.pinv(np.vander(self._offsets, order + 1, increasing=True))

    @property
    def length(self) -> int:
        """Number of samples in the filter."""
        return self._offsets.size

    def squared_change(self, shorter: SavitzkyGolay | None = None) -> float:
        """Noise power of the first derivative, or of its difference from that of a shorter filter.

        The input is white noise of power 1 with one unit of time between samples.
        """
        weights = self._fit[1] / self._half
        if shorter is not None:
            margin = self._half - shorter._half
            weights = weights - np.pad(shorter._fit[1] / shorter._half, margin)
        return float(weights @ weights)

    def derivative(self, values: Array, order: int = 0, period: float = 1.0) -> Array:
        """Derivative (n,) of values (n,) sampled every ``period`` [s]; order 0 smooths them.

        Near the ends, the polynomial through the first or last ``length`` samples is evaluated.

        Raises ValueError if there are fewer values than the length.
        """
        length, half = self._offsets.size, self._half
        if values.size < length:
            raise ValueError(f"there are {values.size} values: at least {length} are needed")
        middle = math.factorial(order) * np.correlate(values, self._fit[order], "valid")
        begin, end = (
            polynomial.polyval(self._offsets, polynomial.polyder(self._fit @ part, order))
            for part in (values[:length], values[-length:])
        )
        result = np.concatenate((begin[:half], middle, end[half + 1 :]))
        return np.asarray(result / (half * period) ** order)


SINE_TOLERANCE = 2e-3
"""A window counts as a sine if the fit leaves less than this fraction of the amplitude [1] ...

A third harmonic of 0.2 % of the displacement is 0.6 % of the velocity: below the noise of the
force in all published conditions. A larger distortion would bias the fit of the force.
"""

_NOISE_FACTOR = 1.2
"""... or less than this many times the noise of the displacement."""

_POLYNOMIAL_ORDER = 4
_SHORTEST_FILTER = 7


class DataError(ValueError):
    """The samples cannot be used for identification; the message gives the reason."""


@dataclass(frozen=True)
class Motion:
    """Kinematics of a window; arrays of shape (n,), SI units.

    ``displacement`` is measured from the centre of the motion. ``sine`` is the fitted sine if it
    describes the window, otherwise None.
    """

    displacement: Array
    velocity: Array
    acceleration: Array
    peak_velocity: Array
    sine: Sine | None

    @classmethod
    def of_sine(cls, sine: Sine, time: Array, peak_velocity: float) -> Motion:
        """Motion of a sine with the given peak velocity [m/s] at times (n,) [s]."""
        return cls(
            displacement=sine.displacement(time),
            velocity=sine.velocity(time),
            acceleration=sine.acceleration(time),
            peak_velocity=np.full(time.size, peak_velocity),
            sine=sine,
        )

    @classmethod
    def joined(cls, motions: Sequence[Motion]) -> Motion:
        """Consecutive motions concatenated into one, without a sine."""
        arrays = zip(*(motion.arrays for motion in motions), strict=True)
        u, v, a, v_m = (np.concatenate(parts) for parts in arrays)
        return cls(u, v, a, v_m, sine=None)

    @property
    def arrays(self) -> tuple[Array, Array, Array, Array]:
        """Displacement, velocity, acceleration and peak velocity."""
        return self.displacement, self.velocity, self.acceleration, self.peak_velocity

    def held_within(self, low: float, high: float) -> Motion:
        """The same motion with its peak velocity clipped to ``low`` to ``high`` [m/s].

        The dependence of a law's coefficients on the peak velocity is known only within the
        identified range.
        """
        v_m = self.peak_velocity
        lowest, highest = span_of(v_m)
        if lowest >= low and highest <= high:
            return self
        return replace(self, peak_velocity=v_m.clip(low, high))

    def part(self, chosen: slice | np.ndarray) -> Motion:
        """The chosen samples, given as a slice, a mask of shape (n,) or indices."""
        u, v, a, v_m = (values[chosen] for values in self.arrays)
        return Motion(u, v, a, v_m, self.sine)

    @property
    def amplitude(self) -> float:
        """Amplitude of the sine, or half the span of the displacement if there is no sine [m]."""
        if self.sine is not None:
            return self.sine.amplitude
        return float(0.5 * np.ptp(self.displacement))

    @property
    def frequency(self) -> float:
        """Frequency of the sine [Hz]; NaN if the motion is not a sine."""
        return math.nan if self.sine is None else self.sine.frequency


def _smooth(displacement: Array, period: float) -> tuple[Array, Array, Array]:
    """Displacement, velocity and acceleration from the filter with the least velocity error.

    The expected mean square error is the sum of the noise that the filter passes and its squared
    bias. The bias is estimated from the difference between this filter and the previous one, which
    is two thirds as long and therefore has a fifth of the bias: it is the power of that difference
    in excess of noise. On emulated random motion with eight kinds of noise, the velocity error is
    1.0 times that of the best length (median; at most 3.1 times).
    """
    # The mean includes bursts of noise and the steps of a digital sensor; the median would not.
    noise = float(np.mean(np.diff(displacement, 4) ** 2)) / 70.0
    length = _SHORTEST_FILTER
    best, least = SavitzkyGolay(length, _POLYNOMIAL_ORDER), math.inf
    shorter, before = best, displacement
    while length < displacement.size // 2:
        smoother = SavitzkyGolay(length, _POLYNOMIAL_ORDER)
        velocity = smoother.derivative(displacement, 1)
        bias = 0.0
        if smoother.length > shorter.length:
            half = smoother.length // 2
            change = (velocity - before)[half:-half]
            passed = noise * smoother.squared_change(shorter)
            bias = max(float(change @ change) / change.size - passed, 0.0)
        error = bias + noise * smoother.squared_change()
        if error < least:
            best, least = smoother, error
        elif bias > least:
            break
        shorter, before = smoother, velocity
        length = 2 * (3 * length // 4) + 1
    u, v, a = (best.derivative(displacement, order, period) for order in range(3))
    return u, v, a


def window_motion(displacement: Array, period: float) -> Motion:
    """Motion of a window of displacement samples.

    ``displacement`` [m] has shape (n,), sampled every ``period`` [s]. The centre of the motion
    is the offset of the sine, or the middle of the span if the motion is not a sine.

    Raises DataError for fewer than 16 samples, values that are not finite, or a constant
    displacement, and ValueError for a period that is not positive.
    """
    u = np.asarray(displacement, dtype=float)
    if u.ndim != 1 or u.size < 16:
        raise DataError(f"a window needs at least 16 samples of displacement (got {u.size})")
    if not (math.isfinite(period) and period > 0.0):
        raise ValueError(f"the sample period is {period} s: it must be positive")
    if not np.all(np.isfinite(u)):
        raise DataError("the displacement holds NaN or infinite values: repair the recording")
    if np.ptp(u) == 0.0:
        raise DataError("the displacement does not change: there is no motion to identify from")
    sine = fit_sine(u, period)
    if sine is not None:
        noise = white_noise(u)
        limit = max(SINE_TOLERANCE * sine.amplitude / math.sqrt(2.0), _NOISE_FACTOR * noise)
        cycles = sine.frequency * period * u.size
        if sine.residual_rms <= limit and cycles >= 0.5:
            time: Array = np.arange(u.size, dtype=float) * period
            top_speed = 2.0 * np.pi * sine.frequency * sine.amplitude
            return Motion.of_sine(sine, time, top_speed)
    smooth, velocity, acceleration = _smooth(u, period)
    centred = smooth - 0.5 * (smooth.max() + smooth.min())
    return Motion(
        displacement=centred,
        velocity=velocity,
        acceleration=acceleration,
        peak_velocity=peak_velocity_of_window(velocity, acceleration, period),
        sine=None,
    )


class MotionSample(NamedTuple):
    """One sample of a :class:`Motion`, in [m], [m/s], [m/s²] and [m/s]."""

    displacement: float
    velocity: float
    acceleration: float
    peak_velocity: float

    @classmethod
    def of(cls, motion: Motion, place: int) -> MotionSample:
        """The sample of a motion at index ``place``."""
        return cls(
            float(motion.displacement[place]),
            float(motion.velocity[place]),
            float(motion.acceleration[place]),
            float(motion.peak_velocity[place]),
        )

    @classmethod
    def each(cls, motion: Motion) -> list[MotionSample]:
        """All samples of a motion."""
        columns = motion.displacement, motion.velocity, motion.acceleration, motion.peak_velocity
        return [cls(*row) for row in zip(*(column.tolist() for column in columns), strict=True)]

    def held_within(self, low: float, high: float) -> MotionSample:
        """The same with the peak velocity [m/s] clipped; see :meth:`Motion.held_within`."""
        if low <= self.peak_velocity <= high:
            return self
        return self._replace(peak_velocity=min(max(self.peak_velocity, low), high))

    def moved_on(self, time: float) -> MotionSample:
        """The sample some time [s] later, at constant acceleration."""
        u, v, a, v_m = self
        velocity = v + a * time
        return MotionSample(u + (v + 0.5 * a * time) * time, velocity, a, max(v_m, abs(velocity)))

    @property
    def motion(self) -> Motion:
        """The motion of this sample alone."""
        u, v, a, v_m = (np.array([value]) for value in self)
        return Motion(u, v, a, v_m, sine=None)
