"""Motion of a stream of displacement, block by block, from the past alone.

A steady sine is followed by its fit to the latest cycles, which gives velocity and acceleration
without delay and nearly without noise: it averages a cycle of samples, an observer some
milliseconds. As soon as the newest samples leave the sine by more than their noise, the motion is
that of :mod:`mr_damper_ros.kinematics.observer`.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from mr_damper_ros.kinematics.motion import SINE_TOLERANCE, Motion
from mr_damper_ros.kinematics.observer import (
    AdaptiveObserver,
    CausalDifferentiator,
    possible_bandwidths,
)
from mr_damper_ros.kinematics.peak_velocity import PeakVelocity
from mr_damper_ros.signals.arrays import Array, span_of, white_noise

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


_HALF_CYCLES = 4
"""A random motion turns at irregular times: so many of its half-cycles tell how slowly."""

_AT_ONCE = 16
"""Samples of which no more than the last is looked at for a reversal."""

_STRETCHES = 64

_LONGEST = 10
"""A slow cycle is kept whole for up to so many memories."""

_CYCLE = 3
"""Reversals from the begin of a cycle to its end."""

_SMALLEST_RETURN = 1e-4
"""A reversal counts once the motion has come back by this [m] and by a quarter of its span."""

_STILL = 0.01
"""A move by less than this part of the amplitude is none ..."""

_DWELL = 0.4
"""... and a rest is longer than this part of a half-cycle without one. A sine stays within a
hundredth of its amplitude for a tenth of a half-cycle; one of a tenth of the amplitude that was
usual, for a third."""

_SHORTEST = 0.1
"""Seconds; noise and the delay of an observer take some hundredths."""

_LONG = 2.0
"""A rest is told after so long [s] already ..."""

_LONG_DWELL = 0.16
"""... if that is this part of a half-cycle."""


class MotionCentre:
    """Middle of the span of the displacement over the last ``memory`` seconds.

    It is exact for any steady motion. Where the last whole cycle is longer than the memory it is
    taken over that cycle. It is kept by the lowest and highest value of short stretches, so that
    its cost does not grow with the rate.

    ``reversals`` counts the changes of direction; ``half_cycle`` [s] is the time between the last
    two of them, NaN before. ``resting``: the displacement has hardly changed for longer than any
    reversal of the latest motion took.
    """

    def __init__(self, memory: float, period: float) -> None:
        self._memory = max(round(memory / period), 1)
        self._length = max(self._memory // _STRETCHES, 1)
        # Of each stretch: number of samples, lowest and highest value [m].
        self._counts: deque[int] = deque()
        self._lows: deque[float] = deque()
        self._highs: deque[float] = deque()
        self._remembered = 0
        self._turns: deque[int] = deque(maxlen=_CYCLE)
        self._half_cycles: deque[float] = deque(maxlen=_HALF_CYCLES)
        # Where the displacement was when it last moved [m], and samples since.
        self._anchor, self._still = math.nan, 0
        self._direction = 0
        self._bottom, self._top = math.inf, -math.inf
        self._count = 0
        self._turned_at = 0
        self._period = period
        self.reversals = 0
        self.half_cycle = math.nan
        self.resting = False

    def follow(self, displacement: Array) -> float:
        """Centre [m] after these samples of shape (n,), n >= 1."""
        for first in range(0, displacement.size, _AT_ONCE):
            centre = self._follow(displacement[first : first + _AT_ONCE])
        return centre

    def _follow(self, displacement: Array) -> float:
        low, high = span_of(displacement)
        if not self._counts or self._counts[-1] >= self._length:
            self._counts.append(0)
            self._lows.append(low)
            self._highs.append(high)
        self._counts[-1] += displacement.size
        self._lows[-1] = min(self._lows[-1], low)
        self._highs[-1] = max(self._highs[-1], high)
        self._remembered += displacement.size
        while self._remembered - self._counts[0] >= self._needed:
            self._remembered -= self._counts.popleft()
            self._lows.popleft()
            self._highs.popleft()
        self._count += displacement.size
        bottom, top = min(self._lows), max(self._highs)
        self._bottom, self._top = min(self._bottom, low), max(self._top, high)
        newest = float(displacement[-1])
        self._count_reversals(newest, max(0.25 * (top - bottom), _SMALLEST_RETURN))
        still = _STILL * 0.5 * (top - bottom)
        if self._anchor - still <= low and high <= self._anchor + still:
            self._still += displacement.size
            half_cycle = self.usual_half_cycle
            longest = min(_DWELL * half_cycle, max(_LONG, _LONG_DWELL * half_cycle))
            self.resting = self._still * self._period > max(_SHORTEST, longest)
        else:
            self._anchor, self._still = newest, 0
            self.resting = False
        return 0.5 * (bottom + top)

    @property
    def usual_half_cycle(self) -> float:
        """The longest [s] of the latest half-cycles; NaN before the first."""
        return max(self._half_cycles, default=math.nan)

    @property
    def _needed(self) -> int:
        """Samples to remember: the memory's, or those since the begin of the last cycle."""
        if len(self._turns) < _CYCLE:
            return _LONGEST * self._memory
        return min(max(self._memory, self._count - self._turns[0]), _LONGEST * self._memory)

    def _count_reversals(self, newest: float, threshold: float) -> None:
        if self._direction >= 0 and self._top - newest > threshold:
            self._turn(-1)
            self._bottom = newest
        elif self._direction <= 0 and newest - self._bottom > threshold:
            self._turn(1)
            self._top = newest

    def _turn(self, direction: int) -> None:
        if self._direction != 0:
            self.reversals += 1
            if self.reversals > 1:
                self.half_cycle = (self._count - self._turned_at) * self._period
                self._half_cycles.append(self.half_cycle)
            self._turned_at = self._count
            self._turns.append(self._count)
        self._direction = direction


_REVERSALS_FOR_CENTRE = 3
"""The centre of a motion is known once its ends have been seen, the first of them surely whole."""

_LONGEST_GAP = 0.5
"""Part of a half-cycle; a cubic over it is off by 1.5 % of the amplitude."""

_HALF_CYCLES_FOR_PEAK = 4
"""Of fewer half-cycles the angular frequency, and with it the peak velocity, is a guess."""


_NOISE_SPEED = 1e-4
"""A sine whose peak velocity [m/s] is below this does not move: it is that of noise."""

_TOGETHER = 0.02
"""Seconds of a steady sine that the observer and the fit learn at once: a hundred samples take them
the time of one."""


class MotionFollower:
    """Follows samples of displacement ``period`` [s] apart.

    ``bandwidth`` [Hz] of the observer is brought into the range that the period allows; with 0 it
    follows the motion and the noise;
    ``centre_memory`` [s] must hold a whole cycle of the motion.

    Only what a block's own motion needs is done when it comes. The rest, which takes longer, is
    done by :meth:`catch_up`.
    """

    def __init__(self, period: float, bandwidth: float, centre_memory: float) -> None:
        self._differentiator: CausalDifferentiator | AdaptiveObserver
        if bandwidth == 0.0:
            self._differentiator = AdaptiveObserver(period)
        else:
            possible = float(np.clip(bandwidth, *possible_bandwidths(period)))
            self._differentiator = CausalDifferentiator(period, possible)
        self._centre = MotionCentre(centre_memory, period)
        self._peak = PeakVelocity(period, centre_memory)
        self._sine = SineFollower(period, centre_memory)
        self._together = round(_TOGETHER / period)
        self._unlearned: list[Array] = []
        self._unlearned_count = 0
        self._steady = False

    @property
    def steady(self) -> bool:
        """Whether the motion of the last block was a sine that goes on."""
        return self._steady

    @property
    def reversals(self) -> int:
        """Changes of direction up to the last block caught up with."""
        return self._centre.reversals

    def lost_sight(self, gap: float) -> bool:
        """Whether so long a gap [s] is too much of a half-cycle for its motion to be reckoned."""
        return gap > _LONGEST_GAP * self._centre.half_cycle

    @property
    def resting(self) -> bool:
        """Whether the motion has come to rest.

        A steady sine is slow at its dead centres, and a rest is a sine of nothing but noise.
        """
        if self._steady and self._sine.peak_velocity > _NOISE_SPEED:
            return False
        return self._centre.resting

    @property
    def half_cycle(self) -> float:
        """The longest [s] of the latest half-cycles, NaN before the first."""
        return self._centre.usual_half_cycle

    @property
    def usual_peak_velocity(self) -> float:
        """Root mean square [m/s] over the latest half-cycles up to the last block observed."""
        return self._peak.root_mean_square

    @property
    def unsettled(self) -> str:
        """Why the velocity of the last block is not known yet; empty where it is."""
        if self._steady or self._differentiator.settled:
            return ""
        return "the velocity is still settling after the start or a jump of the displacement"

    @property
    def doubt(self) -> str:
        """Why the motion of the last block is not known well yet; empty where it is."""
        if self._steady:
            return ""
        if self._centre.reversals < _REVERSALS_FOR_CENTRE:
            return "the centre of the motion is unknown until the motion has reversed three times"
        if self._peak.half_cycles < _HALF_CYCLES_FOR_PEAK:
            return "the peak velocity is unknown until the motion has made four half-cycles"
        return ""

    def follow(self, displacement: Array) -> Motion:
        """Motion at the next samples [m], shape (n,)."""
        self.catch_up()
        motion = self._sine.motion_of(displacement, self._unlearned_count)
        if motion is None:
            # Before the sine is over: the observer has not seen the last of it.
            self._learn()
        self._steady = motion is not None
        self._unlearned.append(displacement)
        self._unlearned_count += displacement.size
        return motion or self._observe(displacement)

    def catch_up(self) -> None:
        """Learn from the last block what only those after it need; :meth:`follow` does it, too."""
        if not self._steady or self._unlearned_count >= self._together:
            self._learn()

    def _learn(self) -> None:
        if not self._unlearned:
            return
        displacement = np.concatenate(self._unlearned)
        self._unlearned.clear()
        self._unlearned_count = 0
        if self._steady:
            self._observe(displacement)
        if isinstance(self._differentiator, AdaptiveObserver):
            self._differentiator.adapt()
        self._sine.learn(displacement, self._centre.half_cycle)

    def _observe(self, displacement: Array) -> Motion:
        u, v, a = self._differentiator.follow(displacement)
        # What overshoots while the observer settles must not be remembered as a peak.
        v_m = self._peak.follow(v, a) if self._differentiator.settled else np.abs(v)
        centred = u - self._centre.follow(displacement)
        return Motion(
            displacement=centred, velocity=v, acceleration=a, peak_velocity=v_m, sine=None
        )
