"""Causal estimate of the motion from a stream of displacement, block by block.

A sine fitted to the latest cycles follows steady sinusoidal motion. The sine gives velocity and
acceleration without delay and nearly without noise, because the fit averages over a whole cycle; an
observer averages over some milliseconds. As soon as the newest samples deviate from the sine by
more than their noise, :mod:`mr_damper_ros.kinematics.observer` estimates the motion.
"""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise

import numpy as np

from mr_damper_ros.kinematics.motion import NO_SINE, Motion, allowed_residual, refined_sine
from mr_damper_ros.kinematics.observer import (
    AdaptiveObserver,
    CausalDifferentiator,
    possible_bandwidths,
)
from mr_damper_ros.kinematics.peak_velocity import HALF_CYCLES, REVERSAL, PeakVelocity
from mr_damper_ros.signals.arrays import NEGLIGIBLE, Array, RollingRows, largest_magnitude

_CYCLES = 1.5
"""Longest fit in cycles; the first fit covers one cycle. A longer fit averages more; a shorter one
adapts sooner."""

_POINTS = 256
"""The fit uses about this many samples, thinned by a constant stride, so that its cost does not
depend on the sample rate. The noise is estimated from the same number of newest samples."""

_FITS_PER_CYCLE = 25
"""Number of fits per cycle. More fits would not follow a steady sine better, and with small blocks
they would cost more than all other work."""

_PATIENCE = 0.2
"""Cycles until the next fit if the motion is far from a sine, because a fit takes as long as many
predictions."""

_END_OF_SINE = 5.0
"""A sample that deviates by more than this multiple of the allowed residual ends the sine."""


class SineFollower:
    """Fits a sine to the latest samples of a displacement, ``period`` [s] apart.

    ``memory`` [s] limits the duration of the samples that are kept.
    """

    def __init__(self, period: float, memory: float) -> None:
        self._period = period
        self._most = max(round(memory / period), 2)
        self._samples = RollingRows(1)
        self._omega = 0.0
        # Amplitude [m], phase [rad] at the last sample of the fit and offset [m] of the sine (None
        # without a steady sine); samples since that fit; and the allowed residual [m].
        self._sine: tuple[float, float, float] | None = None
        self._since = 0
        self._allowed = 0.0
        # Number of fitted samples since the present sine began.
        self._length = 0
        # Samples to wait before the next search for a sine.
        self._wait = 0

    @property
    def amplitude(self) -> float:
        """Amplitude of the sine [m]; NaN without a sine."""
        return math.nan if self._sine is None else self._sine[0]

    def motion_of(self, displacement: Array, unlearned: int) -> Motion | None:
        """Motion of samples (n,) that match the sine within their noise; None if they do not.

        ``unlearned`` is the number of samples since the last one passed to :meth:`learn`.
        """
        if self._sine is None:
            return None
        amplitude, phase, offset = self._sine
        first = self._since + unlearned + 1
        angle = self._omega * self._period * np.arange(first, first + displacement.size) + phase
        centred, fastest = amplitude * np.sin(angle), self._omega * amplitude
        if largest_magnitude(centred + offset - displacement) > _END_OF_SINE * self._allowed:
            return None
        return Motion(
            displacement=centred,
            velocity=fastest * np.cos(angle),
            acceleration=-(self._omega**2) * centred,
            peak_velocity=np.full(angle.size, fastest),
            sine=None,
        )

    def learn(self, displacement: Array, half_cycle: float) -> None:
        """Add these samples, and fit the sine again if a fit is due.

        ``half_cycle`` [s] is the time between the last two reversals, NaN while unknown; it gives
        the initial frequency.
        """
        samples = self._samples
        samples.add([displacement], displacement.size)
        samples.keep(self._most)
        self._since += displacement.size
        self._wait = max(self._wait - displacement.size, 0)
        is_new = self._omega == 0.0
        if is_new:
            if self._wait or math.isnan(half_cycle):
                return
            self._omega, self._length, self._since = math.pi / half_cycle, 0, 0
        cycle = 2.0 * math.pi / self._omega / self._period
        if not is_new and self._since < cycle / _FITS_PER_CYCLE:
            return
        self._sine = None
        # Samples from before the sine are excluded from the fit.
        self._length = max(self._length + self._since, round(cycle))
        self._since = 0
        if samples.count < round(cycle):
            # A change of the motion may have been mistaken for a reversal of a slow motion. The
            # next half-cycle gives a new initial frequency.
            self._omega = 0.0
            return
        recent = samples.newest[0, -min(self._length, round(_CYCLES * cycle)) :]
        stride = max(recent.size // _POINTS, 1)
        # Time is relative to the newest sample, so the phase also holds for a new frequency.
        time: Array = self._period * np.arange(1.0 - recent.size, 1.0, stride)
        self._omega, weights, left = refined_sine(
            time, recent[::stride], self._omega, steps=None if is_new else 1
        )
        by_sine, by_cosine, offset = weights.tolist()
        amplitude = math.hypot(by_sine, by_cosine)
        self._allowed = allowed_residual(amplitude, recent[-_POINTS:])
        if left <= self._allowed:
            self._sine = amplitude, math.atan2(by_cosine, by_sine), offset
        else:
            # The frequency may be wrong; the next search starts from the reversals.
            self._omega = 0.0
            is_near = left <= NO_SINE * amplitude
            self._wait = round(cycle / _FITS_PER_CYCLE if is_near else _PATIENCE * cycle)


_HALF_CYCLES = HALF_CYCLES // 2
"""Number of half-cycles that are always stored, and that give a usable angular frequency and peak
velocity. The longest of them represents the motion, because random motion reverses irregularly."""

_SMALLEST_RETURN = 1e-4
"""A reversal counts once the motion has returned by this [m] and by a quarter of its span. A sine
with a smaller amplitude is a fit of noise, and the damper does not move."""

_REST_PART = 0.4
"""If the displacement is still for longer than this fraction of a half-cycle, the damper is at
rest. A sine stays within a hundredth of its amplitude for a tenth of a half-cycle. If its amplitude
drops to a tenth, it stays within a hundredth of the previous one for a third of a half-cycle."""

_SHORTEST = 0.1
"""Shortest rest [s]; noise and the delay of an observer may look like shorter ones."""


class MotionCentre:
    """Middle of the span of the displacement over the last ``memory`` seconds.

    For a steady motion it is exact. The span covers at least the latest five reversals. Between
    reversals only the lowest and highest value are stored.

    ``reversals`` counts the changes of direction. ``half_cycle`` [s] is the time between the last
    two reversals, NaN before the second. ``resting`` is true if the displacement has hardly changed
    for longer than a reversal of the latest motion takes.
    """

    def __init__(self, memory: float, period: float) -> None:
        self._memory, self._period = max(round(memory / period), 1), period
        self._count = 0
        # Sample and displacement [m] of the latest reversals, and their span.
        self._turns: deque[tuple[int, float]] = deque()
        self._low, self._high = math.inf, -math.inf
        # Direction, start and span of the present stroke.
        self._direction, self._began = 0, 0
        self._bottom, self._top = math.inf, -math.inf
        # Displacement [m] when it last moved, and the number of samples since then.
        self._anchor, self._still = math.nan, 0
        self.reversals = 0
        self.half_cycle = math.nan
        self.usual_half_cycle = math.nan
        """Longest of the latest half-cycles [s]; NaN before the first."""

    @property
    def resting(self) -> bool:
        """Whether the displacement has hardly changed for longer than a reversal takes."""
        return self._still * self._period > max(_SHORTEST, _REST_PART * self.usual_half_cycle)

    def follow(self, displacement: Array) -> float:
        """Centre [m] after these samples of shape (n,), n >= 0."""
        for value in displacement.tolist():
            self._count += 1
            self._bottom, self._top = min(self._bottom, value), max(self._top, value)
            low, high = min(self._low, self._bottom), max(self._high, self._top)
            threshold = max(REVERSAL * (high - low), _SMALLEST_RETURN)
            if self._direction >= 0 and self._top - value > threshold:
                self._turn(-1, self._top, value)
            elif self._direction <= 0 and value - self._bottom > threshold:
                self._turn(1, self._bottom, value)
            elif self._count - self._began > HALF_CYCLES * self._memory:
                # The peak velocity has forgotten the motion before this stroke, too.
                self._turns.clear()
                self._turn(0, value, value)
            if abs(value - self._anchor) <= 0.5 * NEGLIGIBLE * (high - low):
                self._still += 1
            else:
                self._anchor, self._still = value, 0
        return 0.5 * (min(self._low, self._bottom) + max(self._high, self._top))

    def _turn(self, direction: int, extreme: float, value: float) -> None:
        """Begin a stroke at a ``value`` [m] after the ``extreme`` [m] of the last one."""
        if self._direction != 0 and direction != 0:
            self.reversals += 1
            self._turns.append((self._count, extreme))
        oldest = self._count - self._memory
        while len(self._turns) > _HALF_CYCLES + 1 and self._turns[0][0] < oldest:
            self._turns.popleft()
        latest = [count for count, _ in self._turns][-_HALF_CYCLES - 1 :]
        half_cycles = [(end - begin) * self._period for begin, end in pairwise(latest)]
        self.half_cycle = half_cycles[-1] if half_cycles else math.nan
        self.usual_half_cycle = max(half_cycles, default=math.nan)
        self._low = min((place for _, place in self._turns), default=math.inf)
        self._high = max((place for _, place in self._turns), default=-math.inf)
        self._bottom = self._top = value
        self._direction, self._began = direction, self._count


_STEPS = 8
"""Number of changes of the displacement that give the velocity before it froze."""

_MISSING_STEPS = 4.0
"""The displacement is frozen if it has not followed at least this many of the largest steps."""

_FAST = 0.1
"""Part of the usual peak velocity above which a motion cannot stop within a sample. Just before a
reversal or a rest the velocity is lower."""

_ROUNDING = 1e-3
"""Tolerance of a step as a multiple of the resolution."""

_EQUAL = 5
"""Number of equal samples that noise of the displacement excludes."""


class FreezeDetector:
    """Detects a displacement that stops changing within a sample, ``period`` [s] apart.

    A machine that comes to rest decelerates first, and noise goes on. ``speed`` [m/s] is the
    velocity at which the displacement froze; NaN if it is not frozen.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        # Sample number and displacement [m] of the latest changes.
        self._changes: deque[tuple[int, float]] = deque(maxlen=_STEPS + 1)
        self._count = 0
        self._last = math.nan
        self.speed = math.nan

    def follow(self, displacement: Array, usual_peak: float) -> None:
        """Process samples (n,) [m]; ``usual_peak`` [m/s] is the peak velocity of the motion."""
        if not displacement.size:
            return
        changes = np.flatnonzero(np.diff(displacement, prepend=self._last))[-_STEPS - 1 :]
        for place, value in zip(changes.tolist(), displacement[changes].tolist(), strict=True):
            self._changes.append((self._count + place + 1, value))
        self._count += displacement.size
        self._last = float(displacement[-1])
        self.speed = math.nan
        if len(self._changes) <= _STEPS or self._changes[-1][0] == self._count:
            return
        (first, start), (half, middle), (last, end) = (
            self._changes[place] for place in (0, _STEPS // 2, -1)
        )
        steps = [abs(two - one) for (_, one), (_, two) in pairwise(self._changes)]
        before = (middle - start) / ((half - first) * self._period)
        after = (end - middle) / ((last - half) * self._period)
        # Velocity at the last change; a deceleration before it goes on.
        speed = min(abs(after + 0.5 * (after - before)), abs(after))
        missing = speed * (self._count - last) * self._period
        if not usual_peak > 0.0:
            return
        stops = speed > _FAST * usual_peak and missing >= _MISSING_STEPS * max(steps)
        # Every sample differed from the one before, by noise, and now several are equal.
        dense = last - first == _STEPS and self._count - last >= _EQUAL
        if stops or (dense and _is_noisy(np.array([value for _, value in self._changes]))):
            self.speed = speed


def _is_noisy(values: Array) -> bool:
    """Whether noise prevails in the second differences of samples (n,), n > 3.

    Samples on the lattice of a digital sensor are not noisy: equal ones are frequent.
    """
    second = np.diff(values, 2)
    third = np.diff(second)
    steps = np.abs(np.diff(values))
    parts = steps / steps.min()
    is_lattice = bool(np.max(np.abs(parts - np.round(parts))) < _ROUNDING)
    return not is_lattice and bool(np.mean(third**2) > np.mean(second**2))


_REVERSALS_FOR_CENTRE = 3
"""Number of reversals after which the centre of a motion is known. More than two are needed,
because the first may belong to a transition into the steady motion."""

_LONGEST_GAP = 0.5
"""Longest gap that is interpolated, as a fraction of a half-cycle. The error of the cubic is then
1.5 % of the amplitude."""

_BATCH_TIME = 0.02
"""Time [s] of a steady sine that the observer and the fit process at once; a hundred samples take
no longer than one."""


class MotionFollower:
    """Estimates the motion from samples of displacement ``period`` [s] apart.

    ``bandwidth`` [Hz] of the observer is clipped to the range that the period allows. With 0, the
    bandwidth adapts to the motion and the noise. ``centre_memory`` [s] must hold a whole cycle of
    the motion.

    :meth:`follow` computes only the motion of the block. :meth:`catch_up` updates the estimates,
    which takes longer and can be done after the result is published. ``steady`` is true if the last
    block continued the fitted sine. ``centre`` and ``peak`` hold what is known of the reversals and
    of the peak velocity up to the last block that the observer has processed.
    """

    def __init__(self, period: float, bandwidth: float, centre_memory: float) -> None:
        self._differentiator: CausalDifferentiator | AdaptiveObserver
        if bandwidth == 0.0:
            self._differentiator = AdaptiveObserver(period)
        else:
            possible = float(np.clip(bandwidth, *possible_bandwidths(period)))
            self._differentiator = CausalDifferentiator(period, possible)
        self.centre = MotionCentre(centre_memory, period)
        self.peak = PeakVelocity(period, centre_memory)
        self._sine = SineFollower(period, centre_memory)
        self.freeze = FreezeDetector(period)
        """Detects whether the displacement is frozen."""
        self._together = round(_BATCH_TIME / period)
        self._unlearned: list[Array] = []
        self._unlearned_count = 0
        # Whether the initial transient of the observer has died away.
        self._started = False
        self.steady = False

    def lost_sight(self, gap: float) -> bool:
        """Whether a gap [s] is too long, relative to a half-cycle, to be interpolated."""
        return gap > _LONGEST_GAP * self.centre.half_cycle

    @property
    def resting(self) -> bool:
        """Whether the motion has come to rest.

        A motion that follows a fitted sine has not, unless the sine is a fit of noise.
        """
        if self.steady and self._sine.amplitude > _SMALLEST_RETURN:
            return False
        return self.centre.resting

    @property
    def unsettled(self) -> str:
        """Reason why the velocity of the last block is not settled; empty if it is settled."""
        if self.steady or self._differentiator.settled_count:
            return ""
        return "the velocity is still settling after the start or a jump of the displacement"

    @property
    def doubt(self) -> str:
        """Reason why the motion of the last block is uncertain; empty if it is reliable."""
        if self.steady:
            return ""
        if self.centre.reversals < _REVERSALS_FOR_CENTRE:
            return "the centre of the motion is unknown until the motion has reversed three times"
        if self.peak.half_cycles < _HALF_CYCLES:
            return "the peak velocity is unknown until the motion has made four half-cycles"
        return ""

    def follow(self, displacement: Array) -> Motion:
        """Motion at the next samples [m], shape (n,)."""
        self.catch_up()
        self.freeze.follow(displacement, self.peak.root_mean_square)
        motion = self._sine.motion_of(displacement, self._unlearned_count)
        if motion is None:
            # The sine has ended, so the observer first processes the last samples of the sine.
            self._learn()
        self.steady = motion is not None
        self._unlearned.append(displacement)
        self._unlearned_count += displacement.size
        return motion or self._observe(displacement)

    def catch_up(self) -> None:
        """Do the deferred work for the last block; :meth:`follow` calls this first."""
        if not self.steady or self._unlearned_count >= self._together:
            self._learn()

    def _learn(self) -> None:
        if not self._unlearned:
            return
        displacement = np.concatenate(self._unlearned)
        self._unlearned.clear()
        self._unlearned_count = 0
        if self.steady:
            self._observe(displacement)
        if isinstance(self._differentiator, AdaptiveObserver):
            self._differentiator.adapt()
        self._sine.learn(displacement, self.centre.half_cycle)

    def _observe(self, displacement: Array) -> Motion:
        u, v, a = self._differentiator.follow(displacement)
        settled = min(self._differentiator.settled_count, v.size)
        v_m = self.peak.follow(v, a, settled)
        # Unsettled samples after those of the start may be a spike of the sensor.
        centre = self.centre.follow(displacement[v.size - settled if self._started else 0 :])
        self._started = self._started or settled > 0
        return Motion(
            displacement=u - centre, velocity=v, acceleration=a, peak_velocity=v_m, sine=None
        )
