"""A sine that is fitted to the latest cycles of a stream, block by block.

While the motion is a steady sinusoid the fit gives velocity and acceleration at the newest sample
without delay and nearly without noise: that of a whole cycle of samples is averaged, where an
observer averages some milliseconds. As soon as the newest samples leave the sine by more than
their noise it says so, and something else must be used.
"""

from __future__ import annotations

import math

import numpy as np

from mr_damper_ros.kinematics.motion import SINE_TOLERANCE, Motion
from mr_damper_ros.signals.arrays import Array, white_noise

_CYCLES = 1.5
"""Length of the fit in cycles: longer averages more, shorter forgets a change sooner."""

_FEWEST_CYCLES = 1.0
"""A new sine is fitted to so many: it need not wait for what was before it to be forgotten."""
_POINTS = 256
"""The fit takes every so-many-th sample, so that its cost does not grow with the rate."""

_FITS_PER_CYCLE = 25
"""More would follow a steady sine no better, and cost more than all else at a small block size."""

_NOISE_SAMPLES = 256
_NOISE_FACTOR = 1.5
_LEAVING = 5.0
"""A sample this many times the allowed residual away from the sine ends it."""

_PARTS = 256
"""Of small blocks so many are kept before they are joined."""

_FIRST_STEPS = 8
"""Corrections of the frequency after a new start; one per block keeps it afterwards."""

_NO_SINE = 0.25
"""Part of the amplitude; a motion that leaves so much is no sine, nor will it be one at once."""

_TRIED = 3
"""Corrections of the frequency after which that shows ..."""

_PATIENCE = 0.2
"""... and cycles until it is worth while to try again: a try takes as long as many predictions."""

_LARGEST_STEP = 0.1
"""The frequency is corrected by at most this part of itself per block."""


class SineFollower:
    """Fits a sine to the latest samples of a displacement, ``period`` [s] apart.

    ``memory`` [s] is the longest stretch that is kept.
    """

    def __init__(self, period: float, memory: float) -> None:
        self._period = period
        self._parts: list[Array] = []
        self._most = max(round(memory / period), 2)
        # Samples that are kept.
        self._count = 0
        self._omega = 0.0
        # Weights of sine, cosine and offset about the last sample of the fit, None without a steady
        # sine; samples that have come since; and the residual [m] that is allowed.
        self._weights: Array | None = None
        self._since = 0
        self._allowed = 0.0
        # Samples from the first of the present sine on, as far as they are fitted.
        self._length = 0
        # Samples until it is worth while to look for a sine again.
        self._wait = 0

    @property
    def peak_velocity(self) -> float:
        """That of the sine [m/s]; NaN without one."""
        if self._weights is None:
            return math.nan
        return self._omega * math.hypot(*self._weights[:2].tolist())

    def motion_of(self, displacement: Array, unlearned: int) -> Motion | None:
        """Motion of samples (n,) that lie on the sine within their noise; None where they do not.

        So many ``unlearned`` samples came between them and the last that :meth:`learn` was given.
        """
        if self._weights is None:
            return None
        by_sine, by_cosine, offset = self._weights.tolist()
        first = self._since + unlearned + 1
        angle = self._omega * self._period * np.arange(first, first + displacement.size)
        sine, cosine = np.sin(angle), np.cos(angle)
        centred = by_sine * sine + by_cosine * cosine
        error = centred + offset - displacement
        limit = _LEAVING * self._allowed
        # The root of the sum of squares, which is quicker, is no less than the largest.
        if not (error.dot(error) <= limit**2 or np.abs(error).max() <= limit):
            return None
        return Motion(
            displacement=centred,
            velocity=self._omega * (by_sine * cosine - by_cosine * sine),
            acceleration=-(self._omega**2) * centred,
            peak_velocity=np.full(angle.size, self.peak_velocity),
            sine=None,
        )

    def learn(self, displacement: Array, half_cycle: float) -> None:
        """Fit the sine to these samples too, if it is time to.

        ``half_cycle`` [s] is the time between the last two reversals, NaN while unknown: the
        start of the frequency.
        """
        self._parts.append(displacement)
        if len(self._parts) > _PARTS:
            self._join()
        self._count = min(self._count + displacement.size, self._most)
        self._since += displacement.size
        self._wait = max(self._wait - displacement.size, 0)
        if self._omega == 0.0 and self._wait:
            return
        turned = self._omega * self._period * self._since / (2.0 * math.pi)
        if self._omega != 0.0 and turned < 1.0 / _FITS_PER_CYCLE:
            return
        self._weights = None
        self._length += self._since
        self._since = 0
        steps = 1
        if self._omega == 0.0:
            if math.isnan(half_cycle):
                return
            self._omega = math.pi / half_cycle
            self._length = 0
            steps = _FIRST_STEPS
        cycle = 2.0 * math.pi / self._omega / self._period
        if self._count < round(_FEWEST_CYCLES * cycle):
            # A change of the motion may have looked like a reversal of a slow one: the next time
            # between two of them is another start.
            self._omega = 0.0
            return
        samples = self._join()
        self._length = max(self._length, round(_FEWEST_CYCLES * cycle))
        recent = samples[-min(self._length, round(_CYCLES * cycle)) :]
        stride = max(recent.size // _POINTS, 1)
        # Time counts back from the newest sample.
        time: Array = self._period * np.arange(1.0 - recent.size, 1.0, stride)
        points = recent[::stride]
        for step in range(1, steps + 1):
            weights, residual = self._fit(time, points)
            amplitude = math.hypot(weights[0], weights[1])
            left = math.sqrt(float(residual @ residual) / residual.size)
            hopeless = step >= _TRIED and left > _NO_SINE * amplitude
            if hopeless:
                break
        self._allowed = max(
            SINE_TOLERANCE * amplitude / math.sqrt(2.0),
            _NOISE_FACTOR * white_noise(recent[-_NOISE_SAMPLES:]),
        )
        if left > self._allowed:
            # Perhaps the frequency has been lost: start again from the reversals.
            self._omega = 0.0
            self._wait = round(cycle * (_PATIENCE if hopeless else 1.0 / _FITS_PER_CYCLE))
            return
        self._weights = weights

    def _join(self) -> Array:
        """The samples that are kept."""
        samples = np.concatenate(self._parts)[-self._most :]
        self._parts = [samples]
        return samples

    def _fit(self, time: Array, points: Array) -> tuple[Array, Array]:
        """One step of Gauss and Newton: weights of sine, cosine and offset; residual."""
        angle = self._omega * time
        sine, cosine = np.sin(angle), np.cos(angle)
        columns = np.column_stack((sine, cosine, np.ones(time.size)))
        weights = _solve(columns, points)
        by_frequency = time * (weights[0] * cosine - weights[1] * sine)
        step = _solve(np.column_stack((columns, by_frequency)), points - columns @ weights)
        correction = min(max(float(step[3]) / self._omega, -_LARGEST_STEP), _LARGEST_STEP)
        self._omega *= 1.0 + correction
        residual = points - columns @ (weights + step[:3]) - step[3] * by_frequency
        # The weights belong to the corrected frequency: the basis turns about the newest sample.
        return weights + step[:3], residual


def _solve(columns: Array, values: Array) -> Array:
    """Least squares by the normal equations: a handful of well-scaled columns."""
    gram = columns.T @ columns
    size = np.sqrt(gram.diagonal())
    size[size == 0.0] = 1.0
    scaled = gram / (size * size[:, np.newaxis]) + 1e-12 * np.eye(size.size)
    return np.asarray(np.linalg.solve(scaled, values @ columns / size) / size)
