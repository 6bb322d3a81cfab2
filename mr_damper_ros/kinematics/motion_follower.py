"""Causal estimate of the motion from a stream of displacement, block by block.

A sine fitted to the latest cycles follows steady sinusoidal motion. It gives velocity and
acceleration without delay and nearly without noise, because it averages over a cycle of samples
and an observer only over some milliseconds. As soon as the newest samples deviate from the sine by
more than their noise, :mod:`mr_damper_ros.kinematics.observer` estimates the motion.
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
"""Length of the fit in cycles. A longer fit averages more; a shorter one adapts sooner."""

_FEWEST_CYCLES = 1.0
"""A new sine is fitted as soon as this many cycles exist. Samples from before it are left out, so
the fit does not have to wait until they leave the memory."""

_POINTS = 256
"""The fit uses about this many samples, evenly thinned, so that its cost is independent of the
sample rate."""

_FITS_PER_CYCLE = 25
"""More fits would not follow a steady sine better. With small blocks, they would cost more than all
other work."""

_NOISE_SAMPLES = 256
_NOISE_FACTOR = 1.5
_LEAVING = 5.0
"""A sample that deviates by more than this many times the allowed residual ends the sine."""

_PARTS = 256
"""Number of small blocks that are kept before they are concatenated."""

_FIRST_STEPS = 8
"""Corrections of the frequency after a new start. Afterwards each fit makes one correction."""

_NO_SINE = 0.25
"""Residual as a fraction of the amplitude. A motion with a larger residual is not a sine and will
not become one soon."""

_TRIED = 3
"""Corrections of the frequency after which the residual is compared with ``_NO_SINE`` ..."""

_PATIENCE = 0.2
"""... and cycles to wait before the next attempt, which takes as long as many predictions."""

_LARGEST_STEP = 0.1
"""Largest relative correction of the frequency in one step."""


class SineFollower:
    """Fits a sine to the latest samples of a displacement, ``period`` [s] apart.

    ``memory`` [s] limits the duration of the samples that are kept.
    """

    def __init__(self, period: float, memory: float) -> None:
        self._period = period
        self._parts: list[Array] = []
        self._most = max(round(memory / period), 2)
        # Number of samples that are kept.
        self._count = 0
        self._omega = 0.0
        # Weights of sine, cosine and offset, with the phase at the last sample of the fit (None
        # without a steady sine); samples since that fit; and the allowed residual [m].
        self._weights: Array | None = None
        self._since = 0
        self._allowed = 0.0
        # Number of fitted samples since the present sine began.
        self._length = 0
        # Samples to wait before the next search for a sine.
        self._wait = 0

    @property
    def peak_velocity(self) -> float:
        """Peak velocity of the sine [m/s]; NaN without a sine."""
        if self._weights is None:
            return math.nan
        return self._omega * math.hypot(*self._weights[:2].tolist())

    def motion_of(self, displacement: Array, unlearned: int) -> Motion | None:
        """Motion of samples (n,) that match the sine within their noise; None if they do not.

        ``unlearned`` is the number of samples between the last one passed to :meth:`learn` and
        these.
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
        # The sum of squares is quicker to compute, and its root is an upper bound of the largest.
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
        """Add these samples, and fit the sine again if a fit is due.

        ``half_cycle`` [s] is the time between the last two reversals, NaN while unknown. It gives
        the initial frequency.
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
            # A change of the motion may have looked like a reversal of a slow motion. The next
            # half-cycle gives a new initial frequency.
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
            # The frequency may be wrong: start again from the reversals.
            self._omega = 0.0
            self._wait = round(cycle * (_PATIENCE if hopeless else 1.0 / _FITS_PER_CYCLE))
            return
        self._weights = weights

    def _join(self) -> Array:
        """Concatenate the kept samples and return them."""
        samples = np.concatenate(self._parts)[-self._most :]
        self._parts = [samples]
        return samples

    def _fit(self, time: Array, points: Array) -> tuple[Array, Array]:
        """Weights of sine, cosine and offset, and the residual, after one Gauss-Newton step."""
        angle = self._omega * time
        sine, cosine = np.sin(angle), np.cos(angle)
        columns = np.column_stack((sine, cosine, np.ones(time.size)))
        weights = _solve(columns, points)
        by_frequency = time * (weights[0] * cosine - weights[1] * sine)
        step = _solve(np.column_stack((columns, by_frequency)), points - columns @ weights)
        correction = min(max(float(step[3]) / self._omega, -_LARGEST_STEP), _LARGEST_STEP)
        self._omega *= 1.0 + correction
        residual = points - columns @ (weights + step[:3]) - step[3] * by_frequency
        # The weights hold for the corrected frequency too: time is zero at the newest sample.
        return weights + step[:3], residual


def _solve(columns: Array, values: Array) -> Array:
    """Least squares by the normal equations, which suffice for a few well-scaled columns."""
    gram = columns.T @ columns
    size = np.sqrt(gram.diagonal())
    size[size == 0.0] = 1.0
    scaled = gram / (size * size[:, np.newaxis]) + 1e-12 * np.eye(size.size)
    return np.asarray(np.linalg.solve(scaled, values @ columns / size) / size)


_HALF_CYCLES = 4
"""Number of half-cycles whose longest stands for the motion: random motion reverses irregularly."""

_AT_ONCE = 16
"""Reversals are checked at the last sample of each group of this many samples."""

_STRETCHES = 64

_LONGEST = 10
"""A slow cycle is kept whole if it is no longer than this many memories."""

_CYCLE = 3
"""Reversals from the start of a cycle to its end, both included."""

_SMALLEST_RETURN = 1e-4
"""A reversal counts once the motion has returned by this [m] and by a quarter of its span."""

_STILL = 0.01
"""A displacement that changes by less than this fraction of the amplitude counts as still ..."""

_DWELL = 0.4
"""... and a rest is a still time longer than this fraction of a half-cycle. A sine stays within a
hundredth of its amplitude for a tenth of a half-cycle. After a drop to a tenth of the previous
amplitude, it stays within that limit for a third of a half-cycle."""

_SHORTEST = 0.1
"""Shortest rest [s]. Noise and the delay of an observer take some hundredths of a second."""

_LONG = 2.0
"""In slow motion, a rest is detected after this time [s] ..."""

_LONG_DWELL = 0.16
"""... if it exceeds this fraction of a half-cycle."""


class MotionCentre:
    """Middle of the span of the displacement over the last ``memory`` seconds.

    It is exact for any steady motion. If the last whole cycle is longer than the memory, the span
    covers that cycle. Only the lowest and highest value of short stretches are stored, so that the
    cost is independent of the sample rate.

    ``reversals`` counts the changes of direction. ``half_cycle`` [s] is the time between the last
    two reversals, NaN before the second. ``resting`` is true when the displacement has hardly
    changed for longer than a reversal of the latest motion takes.
    """

    def __init__(self, memory: float, period: float) -> None:
        self._memory = max(round(memory / period), 1)
        self._length = max(self._memory // _STRETCHES, 1)
        # For each stretch, the number of samples and the lowest and highest value [m].
        self._counts: deque[int] = deque()
        self._lows: deque[float] = deque()
        self._highs: deque[float] = deque()
        self._remembered = 0
        self._turns: deque[int] = deque(maxlen=_CYCLE)
        self._half_cycles: deque[float] = deque(maxlen=_HALF_CYCLES)
        # Displacement [m] when it last moved, and the number of samples since then.
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
        """Longest of the latest half-cycles [s]; NaN before the first."""
        return max(self._half_cycles, default=math.nan)

    @property
    def _needed(self) -> int:
        """Samples to remember: the memory, or the samples since the last whole cycle began."""
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
"""The centre of a motion is known after this many reversals. The stream may begin within a stroke,
so the first reversal need not be an end of the steady motion."""

_LONGEST_GAP = 0.5
"""Longest gap as a fraction of a half-cycle. A cubic across it has an error of 1.5 % of the
amplitude."""

_HALF_CYCLES_FOR_PEAK = 4
"""With fewer half-cycles, the angular frequency and the peak velocity are too uncertain."""


_NOISE_SPEED = 1e-4
"""A sine with a peak velocity [m/s] below this is fitted to noise: the damper does not move."""

_TOGETHER = 0.02
"""Seconds of a steady sine that the observer and the fit process together: a hundred samples take
no longer than one."""


class MotionFollower:
    """Estimates the motion from samples of displacement ``period`` [s] apart.

    ``bandwidth`` [Hz] of the observer is clipped to the range that the period allows. With 0, the
    bandwidth adapts to the motion and the noise. ``centre_memory`` [s] must hold a whole cycle of
    the motion.

    :meth:`follow` does only the work that the motion of the block needs. :meth:`catch_up` does the
    rest, which takes longer, and can run after the result is published.
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
        """Whether the last block continued the fitted sine."""
        return self._steady

    @property
    def reversals(self) -> int:
        """Number of reversals up to the last block that the observer has processed."""
        return self._centre.reversals

    def lost_sight(self, gap: float) -> bool:
        """Whether a gap [s] spans too much of a half-cycle for interpolation of the motion."""
        return gap > _LONGEST_GAP * self._centre.half_cycle

    @property
    def resting(self) -> bool:
        """Whether the motion has come to rest.

        A steady sine is slow at its dead centres but not at rest. A sine fitted to noise alone
        counts as a rest.
        """
        if self._steady and self._sine.peak_velocity > _NOISE_SPEED:
            return False
        return self._centre.resting

    @property
    def half_cycle(self) -> float:
        """Longest of the latest half-cycles [s]; NaN before the first one."""
        return self._centre.usual_half_cycle

    @property
    def usual_peak_velocity(self) -> float:
        """Root mean square peak velocity [m/s] of the latest half-cycles that were observed."""
        return self._peak.root_mean_square

    @property
    def unsettled(self) -> str:
        """Reason why the velocity of the last block is not settled; empty if it is settled."""
        if self._steady or self._differentiator.settled:
            return ""
        return "the velocity is still settling after the start or a jump of the displacement"

    @property
    def doubt(self) -> str:
        """Reason why the motion of the last block is uncertain; empty if it is reliable."""
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
            # The sine has ended: first pass its last samples to the observer.
            self._learn()
        self._steady = motion is not None
        self._unlearned.append(displacement)
        self._unlearned_count += displacement.size
        return motion or self._observe(displacement)

    def catch_up(self) -> None:
        """Do the deferred work for the last block; :meth:`follow` calls this first."""
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
        v_m = self._peak.follow_settled(v, a, self._differentiator.settled_count)
        centred = u - self._centre.follow(displacement)
        return Motion(
            displacement=centred, velocity=v, acceleration=a, peak_velocity=v_m, sine=None
        )
