"""Motion of a window of samples: displacement, velocity, acceleration, peak velocity.

A steady sinusoid is described by its fitted sine (thesis 2.8.1), whose derivatives carry almost no
noise. Any other motion is differentiated by a local polynomial (Savitzky and Golay, 1964) whose
length is chosen from the data. The residual of the sine fit decides between the two.
:mod:`mr_damper_ros.kinematics.peak_velocity` defines the peak velocity of any motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.polynomial import polynomial

from mr_damper_ros.kinematics.peak_velocity import peak_velocity_of_window
from mr_damper_ros.kinematics.periodic_motion import Kinematics
from mr_damper_ros.signals.arrays import (
    MOST_ITERATIONS,
    Array,
    noise_power,
    span_of,
    usable,
    white_noise,
)

SINE_TOLERANCE = 2e-3
"""A motion counts as a sine if the residual of the fit is below this fraction of the amplitude [1].

A third harmonic of 0.2 % of the displacement is 0.6 % of the velocity. In all published conditions
its effect is below the noise of the force. A larger distortion would bias the fit of the force.
"""

_NOISE_FACTOR = 1.5
"""A motion also counts as a sine if the residual is below this multiple of the noise of the
displacement, which is estimated from few samples."""

NO_SINE, _TRIED = 0.25, 3
"""A motion is not a sine if the residual exceeds this fraction of the amplitude after this many
corrections of the frequency."""

_LARGEST_STEP = 0.1
"""Largest relative correction of the frequency in one step."""

_ROWS = 1 << 16
"""Number of samples whose equations are in memory at a time, 64 bytes for each sample."""


@dataclass(frozen=True)
class Sine:
    """u(t) = offset + amplitude sin(2 pi frequency t + phase), with the residual of its fit.

    ``amplitude`` and ``offset`` [m], ``frequency`` [Hz], ``phase`` [rad] at t = 0;
    ``residual_rms`` [m] is the root mean square of the displacement minus the sine.
    """

    amplitude: float
    frequency: float
    phase: float = 0.0
    offset: float = 0.0
    residual_rms: float = 0.0

    def at(self, time: Array) -> Kinematics:
        """Kinematics about the centre of the motion (without the offset) at the times [s], (n,)."""
        scale, rate = self.amplitude, 2.0 * np.pi * self.frequency
        angle = rate * time + self.phase
        sine, cosine = np.sin(angle), np.cos(angle)
        return Kinematics(scale * sine, scale * rate * cosine, -scale * rate**2 * sine)


def allowed_residual(amplitude: float, displacement: Array) -> float:
    """Largest residual [m, root mean square] of a sine fitted to a displacement (n,) [m]."""
    noise = _NOISE_FACTOR * white_noise(displacement)
    return max(SINE_TOLERANCE * amplitude / math.sqrt(2.0), noise)


def refined_sine(
    time: Array, values: Array, omega: float, steps: int | None = None
) -> tuple[float, Array, float]:
    """Least-squares sine by Gauss-Newton steps from an angular frequency ``omega`` [rad/s].

    ``time`` [s] and ``values`` [m] have shape (n,). The fit takes ``steps`` steps. With None it
    iterates until it converges, or until the residual shows that the motion is not a sine. Returns
    the angular frequency, the weights (3,) of sine, cosine and offset [m], and the residual [m,
    root mean square], which is infinite if the samples span less than half a cycle.
    """
    for step in range(1, (steps or MOST_ITERATIONS) + 1):
        angle = omega * time
        sine, cosine = np.sin(angle), np.cos(angle)

        def sine_equations(rows: slice, s: Array = sine, c: Array = cosine) -> tuple[Array, Array]:
            part = s[rows], c[rows]
            return np.column_stack((*part, np.ones(part[0].size))), values[rows]

        weights = _least_squares(sine_equations, values.size)

        def step_equations(rows: slice, w: Array = weights) -> tuple[Array, Array]:
            columns, wanted = sine_equations(rows)
            by_frequency = time[rows] * (w[0] * columns[:, 1] - w[1] * columns[:, 0])
            return np.column_stack((columns, by_frequency)), wanted - columns @ w

        change = _least_squares(step_equations, values.size)
        change *= min(1.0, _LARGEST_STEP * omega / max(abs(float(change[3])), 1e-300))
        correction = float(change[3]) / omega
        omega += float(change[3])
        squares = 0.0
        for rows in _slices(values.size):
            columns, remainder = step_equations(rows)
            remainder = remainder - columns @ change
            squares += float(remainder @ remainder)
        weights = weights + change[:3]
        left = math.sqrt(squares / values.size)
        if abs(correction) < 1e-13 or (
            step >= _TRIED and left > NO_SINE * math.hypot(weights[0], weights[1])
        ):
            break
    # With less than half a cycle, a sine, an offset and a ramp look alike.
    return omega, weights, left if omega * np.ptp(time) > 0.99 * math.pi else math.inf


def _slices(count: int) -> list[slice]:
    return [slice(first, first + _ROWS) for first in range(0, count, _ROWS)]


def _least_squares(equations: Callable[[slice], tuple[Array, Array]], count: int) -> Array:
    """Least-squares solution of ``count`` equations, which are given as columns and values of rows.

    Of many equations, only the triangular factor is kept.
    """
    slices = _slices(count)
    if len(slices) == 1:
        return np.asarray(np.linalg.lstsq(*equations(slices[0]), rcond=None)[0])
    factor: Array | None = None
    for rows in slices:
        block = np.column_stack(equations(rows))
        stacked = block if factor is None else np.vstack((factor, block))
        factor = np.asarray(np.linalg.qr(stacked, mode="r"))
    assert factor is not None
    return np.asarray(np.linalg.lstsq(factor[:, :-1], factor[:, -1], rcond=None)[0])


def fit_sine(displacement: Array, period: float) -> Sine | None:
    """Least-squares sine of a displacement of shape (n,) [m] sampled every ``period`` [s].

    The peak of the spectrum gives the initial frequency. Returns None for fewer than eight samples
    or a constant displacement. The residual shows whether the motion is a sine.
    """
    u = np.asarray(displacement, dtype=float)
    n = u.size
    if n < 8 or np.ptp(u) == 0.0:
        return None
    # Zero padding refines the initial frequency to a fraction of a spectral line. A quarter of a
    # line suffices, and of many samples the padded spectrum would be the largest array.
    size = 1 << ((8 if n <= _ROWS else 2) * n - 1).bit_length()
    spectrum = np.abs(np.fft.rfft((u - u.mean()) * np.hanning(n), size))
    lowest = size // (2 * n)  # half a cycle
    start = float(np.argmax(spectrum[lowest:]) + lowest) / size
    del spectrum
    # Time is counted from the middle, where frequency and phase are nearly uncorrelated.
    index: Array = np.arange(0.5 - 0.5 * n, 0.5 * n)
    omega, (sine, cosine, offset), left = refined_sine(index, u, 2.0 * np.pi * start)
    return Sine(
        amplitude=float(np.hypot(sine, cosine)),
        frequency=omega / (2.0 * np.pi * period),
        phase=float((np.arctan2(cosine, sine) - omega * 0.5 * (n - 1)) % (2.0 * np.pi)),
        offset=float(offset),
        residual_rms=left,
    )


class SavitzkyGolay:
    """Filter that fits a polynomial of degree ``order`` to ``length`` samples around each sample.

    The length is odd and exceeds the order.
    """

    def __init__(self, length: int, order: int) -> None:
        self.length, self._half = length, length // 2
        # In units of half the length, all powers are of similar magnitude.
        self._offsets = np.arange(-self._half, self._half + 1) / self._half
        self._fit = np.linalg.pinv(np.vander(self._offsets, order + 1, increasing=True))

    def noise_gain(self, shorter: SavitzkyGolay | None = None) -> float:
        """Power of the second derivative, per sample, that this filter gives for unit white noise.

        With a ``shorter`` filter, the power of the difference between the derivatives of both.
        """
        weights = self._curvature
        if shorter is not None:
            weights = weights - np.pad(shorter._curvature, self._half - shorter._half)
        return float(weights @ weights)

    @property
    def _curvature(self) -> Array:
        return np.asarray(2.0 / self._half**2 * self._fit[2])

    def derivative(self, values: Array, order: int = 0, period: float = 1.0) -> Array:
        """Derivative (n,) of values (n,) sampled every ``period`` [s]; order 0 smooths them.

        There are at least as many values as the filter is long. Near the ends, the polynomial
        through the first or last ``length`` samples is evaluated.
        """
        length, half = self.length, self._half
        middle = math.factorial(order) * np.correlate(values, self._fit[order], "valid")
        begin, end = (
            polynomial.polyval(self._offsets, polynomial.polyder(self._fit @ part, order))
            for part in (values[:length], values[-length:])
        )
        result = np.concatenate((begin[:half], middle, end[half + 1 :]))
        return np.asarray(result / (half * period) ** order)


_POLYNOMIAL_ORDER = 4

_NOISE_RISE = 4.0
"""A longer filter may remove so many times the power of the noise that the shorter one removed.
The noise of sensors is not white, but a motion rises more steeply. In the motions of
:func:`_smooth`, the velocity error is 1.32 times the least one with 2.5, where the noise of a
filtered sensor counts as motion (at most 633 times), and 1.16 times with 5 (at most 7.4 times)."""


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
        return cls(*sine.at(time), np.full(time.size, peak_velocity), sine)

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
        """The same motion with its peak velocity clipped to the range ``low``, ``high`` [m/s].

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
    """Displacement and velocity, and the acceleration from the next longer filter.

    Each filter is half as long again as the previous one. It is better as long as the part of the
    second derivative that it removes besides the previous one can be noise. The best filter for
    the velocity is the next shorter one. In emulated random motion, sweeps and earthquakes with
    eight kinds of noise, the velocity error is 1.10 times the error with the best length (geometric
    mean; at most 4.2 times), and that of the acceleration 1.5 times.
    """
    # A motion near the sample rate shows in the lower differences, too.
    noise = min(noise_power(displacement), noise_power(displacement, 8))
    length = _POLYNOMIAL_ORDER + 3
    # The polynomial through all samples of the shortest filter has hardly any bias.
    shorter = SavitzkyGolay(length, length - 1)
    before = shorter.derivative(displacement, 2)
    found = shorter, shorter
    excess = least = 0.0
    while length < displacement.size // 2:
        longer = SavitzkyGolay(length, _POLYNOMIAL_ORDER)
        curvature, half = longer.derivative(displacement, 2), longer.length // 2
        removed, gain = (curvature - before)[half:-half], longer.noise_gain(shorter)
        power = float(removed @ removed) / removed.size
        excess += power - _NOISE_RISE * noise * gain
        if excess < least:
            found, least = (shorter, longer), excess
        elif excess - least > noise * found[1].noise_gain():
            break
        noise, shorter, before = power / gain, longer, curvature
        length = 2 * (3 * length // 4) + 1
    for_velocity, for_acceleration = found
    return (
        for_velocity.derivative(displacement, 0, period),
        for_velocity.derivative(displacement, 1, period),
        for_acceleration.derivative(displacement, 2, period),
    )


def window_motion(displacement: Array, period: float) -> Motion:
    """Motion of a window of displacement samples.

    ``displacement`` [m] has shape (n,), sampled every ``period`` [s]. The centre of the motion
    is the offset of the sine, or the middle of the span if the motion is not a sine.

    Raises DataError for fewer than 16 samples, values that are not finite, or a constant
    displacement, and ValueError for a period that is not positive.
    """
    u = np.asarray(displacement, dtype=float)
    if u.ndim != 1 or u.size < 16:
        raise DataError(f"a window needs at least 16 samples of displacement, but has {u.size}")
    if not 1e-9 <= period <= 1e9:
        raise ValueError(
            f"the sample period is {period} s: it must be positive, from 1e-09 to 1e+09 s"
        )
    if not np.all(usable(u)):
        raise DataError("the displacement holds NaN, infinite or huge values: correct them")
    if np.ptp(u) == 0.0:
        raise DataError("the displacement does not change: there is no motion")
    sine = fit_sine(u, period)
    if sine is not None and sine.residual_rms <= allowed_residual(sine.amplitude, u):
        time: Array = np.arange(u.size, dtype=float) * period
        return Motion.of_sine(sine, time, 2.0 * np.pi * sine.frequency * sine.amplitude)
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
        return cls(*(float(values[place]) for values in motion.arrays))

    @classmethod
    def each(cls, motion: Motion) -> list[MotionSample]:
        """All samples of a motion."""
        columns = (values.tolist() for values in motion.arrays)
        return [cls(*row) for row in zip(*columns, strict=True)]

    def held_within(self, low: float, high: float) -> MotionSample:
        """The same sample with a clipped peak velocity [m/s]; see :meth:`Motion.held_within`."""
        if low <= self.peak_velocity <= high:
            return self
        return self._replace(peak_velocity=min(max(self.peak_velocity, low), high))

    def moved_on(self, time: float) -> MotionSample:
        """The sample some time [s] later, at constant acceleration."""
        u, v, a, v_m = self
        velocity = v + a * time
        return MotionSample(u + (v + 0.5 * a * time) * time, velocity, a, max(v_m, abs(velocity)))
