"""Window of motion, force and current samples for identification, and a check for a whole cycle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mr_damper_ros.kinematics.motion import DataError, Motion, Sine, window_motion
from mr_damper_ros.kinematics.peak_velocity import REVERSAL
from mr_damper_ros.signals.arrays import NOISE_SPAN, Array, Positive, usable, white_noise
from mr_damper_ros.signals.blocks import MOST_SAMPLES

_SAMPLES_PER_CYCLE = 1000
"""Samples per cycle that resolve the steepest sigmoid, which rises within 1/180 of a cycle."""

FEWER_PER_CYCLE = 200
"""Samples per cycle that resolve a hysteresis, which yields over about a tenth of a cycle."""

MOST_UNUSED = 0.25
"""Largest fraction of a window without information: of samples that depend on the unknown motion
before the window, no more are omitted, and a window with a longer rest is rejected."""

_COIL_PERIOD = 1e-3
"""Sample period [s] of a history that resolves how the coil follows a step of the current. In a
motion of 0.1 Hz with a current that switches every 0.2 s, a law with memory whose history resolves
the motion alone has an error of 17 % of the force."""


@dataclass(frozen=True, eq=False)
class MotionHistory:
    """Motion and current (m,), ``period`` [s] apart, that determine the n forces of a window.

    ``places`` (n,) are the positions of the window's samples, in samples of the history. ``branch``
    (n,) is the sign of the acceleration at the samples; the sigmoid force jumps where it changes.
    ``periodic`` means that the history is one period of a motion that repeats.
    """

    motion: Motion
    current: Array
    period: float
    places: Array
    branch: Array
    periodic: bool

    @cached_property
    def _picked(self) -> np.ndarray | slice | None:
        """Places (n,) as indices or a slice; None if one lies between two samples."""
        if np.array_equal(self.places, np.arange(self.current.size)):
            return slice(None)
        places = self.places.astype(int)
        return places if not self.periodic and np.array_equal(places, self.places) else None

    @property
    def holds_samples(self) -> bool:
        """Whether the history contains all samples of the window, so no sample is interpolated."""
        return self._picked is not None

    @cached_property
    def _between(self) -> tuple[np.ndarray, np.ndarray, Array]:
        """The history indices around each sample, and its position between them (0 to 1)."""
        count = self.current.size
        earlier = np.floor(self.places).astype(int)
        if not self.periodic:
            earlier = np.minimum(earlier, count - 2)
        share = np.minimum(self.places - earlier, 1.0)
        earlier, later = earlier % count, (earlier + 1) % count
        # At a jump of the force, the value on the same side as the sample is used.
        branch = np.sign(self.motion.acceleration)
        jumps = branch[earlier] != branch[later]
        share[jumps] = branch[later[jumps]] == self.branch[jumps]
        return earlier, later, share

    @cached_property
    def coarse_stride(self) -> int:
        """Stride of :attr:`coarse` in samples of this history."""
        if self.periodic:
            return self.current.size // FEWER_PER_CYCLE
        return _history_stride(self.motion, self.current, self.period, FEWER_PER_CYCLE)

    @cached_property
    def coarse(self) -> MotionHistory:
        """The same history with fewer samples, for laws that change less steeply than a sigmoid."""
        stride = self.coarse_stride
        if stride == 1:
            return self
        return replace(
            self,
            motion=self.motion.part(slice(None, None, stride)),
            current=self.current[::stride],
            period=stride * self.period,
            places=self.places / stride,
        )

    def at_samples(self, values: Array) -> Array:
        """Values (m, ...) along the history, interpolated at the samples of the window (n, ...)."""
        if isinstance(self._picked, slice):
            return values
        if self._picked is not None:
            # Derivatives are stored by columns, so they are also processed by columns.
            if values.ndim > 1 and values.flags.f_contiguous:
                return np.take(values.T, self._picked, axis=-1).T
            return np.take(values, self._picked, axis=0)
        earlier, later, share = self._between
        share = share.reshape(-1, *(1,) * (values.ndim - 1))
        return np.asarray((1.0 - share) * values[earlier] + share * values[later])

    def unsettled(self, duration: float) -> np.ndarray:
        """Mask (n,) of samples within ``duration`` [s] of the start, before which nothing is known.

        At most a quarter of the samples is marked, even if more of them lie near the start.
        """
        if self.periodic:
            return np.zeros(self.places.size, dtype=bool)
        since = self.places * self.period
        return np.asarray(since < min(duration, since[int(MOST_UNUSED * since.size)]))


_PER_CYCLE = 50
"""Samples per cycle up to which the motion of a run is divided. In random motion up to 12 Hz at 100
Hz, laws with memory have an error of 4 to 13 % of the force with one step per sample, and of at
most 1 % with three (``random_current_error``)."""


def _mean_cycle(motion: Motion, period: float) -> float:
    """Samples in a cycle of a sine with the RMS velocity and acceleration; infinite at rest."""
    power = float(np.mean(motion.velocity**2))
    if power == 0.0:
        return math.inf
    rate = math.sqrt(float(np.mean(motion.acceleration**2)) / power)
    return 2.0 * math.pi / max(rate, 1e-12) / period


def following_stride(motion: Motion, period: float, per_cycle: int = _SAMPLES_PER_CYCLE) -> int:
    """Largest stride, in samples of a motion, that leaves at least ``per_cycle`` in a cycle."""
    samples = _mean_cycle(motion, period)
    return max(int(samples / per_cycle), 1) if math.isfinite(samples) else 1


def _history_stride(motion: Motion, current: Array, period: float, per_cycle: int) -> int:
    """As :func:`following_stride`, but a current (n,) [A] that varies must be followed, too."""
    stride = following_stride(motion, period, per_cycle)
    if float(np.ptp(current)) > 0.0:
        stride = max(min(stride, int(_COIL_PERIOD / period)), 1)
    return stride


TURN = 0.05
"""A reversal is a return by this fraction of the span that also exceeds the span of the noise."""

_COVERED_PART = 0.75
"""Fraction of the span that the strokes of each direction must cover in total, and also a stroke at
the edge of the samples, to be whole."""

_SLOW_START = 0.8
"""A stroke that begins at a reversal is slow at first: the distance of its first third is below
this fraction of the distance of its middle third."""


def averages(array: Array, most: int) -> Array:
    """At most ``most`` averages over equal groups of samples (n,); first samples may be omitted."""
    size = max(-(-array.size // most), 1)
    whole = array[array.size % size :]
    return whole.reshape(-1, size).mean(axis=1) if size > 1 else whole


def holds_cycle(displacement: Array) -> bool:
    """Whether a displacement (n,) reverses at both ends and moves far enough in both directions.

    Only such a motion contains both signs of the velocity with both signs of the acceleration.
    """
    u = averages(displacement, MOST_SAMPLES)
    span = float(np.ptp(u)) if u.size else 0.0
    # A larger return always counts: motion near the sample rate cannot be distinguished from noise.
    turn = min(max(TURN * span, NOISE_SPAN * white_noise(u)), REVERSAL * span)
    if not turn > 0.0:
        return False
    places = turning_points(u.tolist(), turn)
    ways = np.diff(u[places])
    up, down = float(ways[ways > 0.0].sum()), float(-ways[ways < 0.0].sum())
    turns = places.size - 2
    if turns >= 1:
        turns += _is_whole(u[places[0] : places[1] + 1], span)
        turns += _is_whole(u[places[-2] : places[-1] + 1][::-1], span)
    return turns >= 2 and min(up, down) >= _COVERED_PART * span


def _is_whole(stroke: Array, span: float) -> bool:
    """Whether a stroke (n,) is whole: it covers enough of the span and begins slowly."""
    thirds = np.abs(np.diff(stroke[[0, stroke.size // 3, 2 * stroke.size // 3]]))
    return bool(np.ptp(stroke) >= _COVERED_PART * span and thirds[0] < _SLOW_START * thirds[1])


def turning_points(u: list[float], turn: float) -> np.ndarray:
    """Indices of the first sample, the reversals (a return of ``turn`` or more) and the last."""
    places = [0]
    low = high = 0
    sense = 0
    for place, value in enumerate(u):
        if value > u[high]:
            high = place
        if value < u[low]:
            low = place
        if sense >= 0 and u[high] - value >= turn:
            if sense:
                places.append(high)
            sense, low = -1, place
        elif sense <= 0 and value - u[low] >= turn:
            if sense:
                places.append(low)
            sense, high = 1, place
    places.append(len(u) - 1)
    return np.array(places)


def _cycle(sine: Sine, peak_velocity: float, count: int) -> tuple[Motion, float]:
    """One cycle of a sine with this many samples, and their period [s]."""
    period = 1.0 / (sine.frequency * count)
    return Motion.of_sine(sine, period * np.arange(count, dtype=float), peak_velocity), period


_SEED = 0
"""Seed of the places of a thinned window."""

_SPIKE_QUANTILE = 0.995
"""Fraction of the samples that is assumed free of spikes."""


def _quantiles(values: Array, velocity: Array, shares: Sequence[float]) -> list[float]:
    """Quantiles of values (n,), weighted by the absolute velocity."""
    order = np.argsort(values)
    total = np.cumsum(np.abs(velocity)[order])
    places = np.searchsorted(total, np.array(shares) * total[-1])
    return values[order[np.minimum(places, order.size - 1)]].tolist()


@dataclass(frozen=True)
class Window:
    """Motion, force [N] and coil current [A] of a window; arrays of shape (n,).

    Only a law with memory or lag needs the other fields. ``period`` [s] is the sample period. For a
    part of a window, ``whole`` is the complete window and ``places`` (n,) are the positions of the
    samples, in samples of the complete window. For a steady sine, ``whole`` is not needed.

    Raises DataError if a value is not finite and ValueError if lengths differ.
    """

    motion: Motion
    force: Array
    current: Array
    period: Positive = math.nan
    places: Array | None = None
    whole: Window | None = None

    def __post_init__(self) -> None:
        n = self.motion.velocity.size
        for name in ("force", "current"):
            array = np.asarray(getattr(self, name), dtype=float)
            if array.shape != (n,):
                raise ValueError(f"{name} has shape {array.shape}, the motion {n} samples")
            if not np.all(usable(array)):
                raise DataError(f"the {name} holds NaN, infinite or huge values")
            object.__setattr__(self, name, array)

    @classmethod
    def from_samples(
        cls,
        displacement: Array,
        force: Array,
        current: Array | float,
        period: float,
        peak_velocity: Array | None = None,
    ) -> Window:
        """Window of samples taken every ``period`` [s]; see :func:`window_motion` for errors.

        ``peak_velocity`` (n,) [m/s], which may use samples before the window, replaces the estimate
        from the window alone, unless the motion is a sine.
        """
        motion = window_motion(displacement, period)
        if peak_velocity is not None and motion.sine is None:
            motion = replace(motion, peak_velocity=peak_velocity)
        amperes = np.broadcast_to(np.asarray(current, float), np.shape(force))
        return cls(motion, force, amperes, period)

    @classmethod
    def of_sine(cls, peak_velocity: float, frequency: float, current: float) -> Window:
        """One cycle of a sine (velocity [m/s], frequency [Hz]) at a current [A], without force."""
        sine, count = Sine(peak_velocity / (2.0 * np.pi * frequency), frequency), FEWER_PER_CYCLE
        motion, period = _cycle(sine, peak_velocity, count)
        return cls(motion, np.zeros(count), np.full(count, current), period)

    def part(self, chosen: slice | np.ndarray) -> Window:
        """The chosen samples: a slice, or a mask of shape (n,)."""
        motion = self.motion.part(chosen)
        places = self._places
        alone = self.steady or not self.period > 0.0
        whole = None if alone else self.whole or self
        return Window(
            motion, self.force[chosen], self.current[chosen], self.period, places[chosen], whole
        )

    def measured_after(self, delay: Array) -> Window:
        """The window with each force assigned to the motion ``delay`` sample periods later.

        ``delay`` has shape (n,). Motion and current at those times are interpolated.
        """
        grid = np.arange(self.sample_count, dtype=float)
        places = np.clip(grid + delay, 0.0, grid[-1])
        u, v, a, v_m = (np.interp(places, grid, values) for values in self.motion.arrays)
        motion = Motion(u, v, a, v_m, self.motion.sine)
        current = np.interp(places, grid, self.current)
        whole = None if self.steady else self
        return Window(motion, self.force, current, self.period, places, whole)

    def stretch(self, begin: int, count: int) -> Window:
        """``count`` samples of the complete window from ``begin`` on, as a window with no past."""
        whole = self.whole or self
        part = slice(begin, begin + count)
        cut = Window(whole.motion.part(part), whole.force[part], whole.current[part], whole.period)
        if self.places is None:
            return cut
        inside = (self.places >= begin) & (self.places <= begin + cut.sample_count - 1)
        return replace(self.part(inside), places=self.places[inside] - begin, whole=cut)

    def resolved(self, per_cycle: int = _PER_CYCLE) -> Window:
        """A window with all its samples, as part of a ``whole`` that resolves fast hysteresis.

        Between the samples, displacement and velocity are cubic polynomials with the derivatives at
        both ends. The current is held. The window itself is returned if it is a sine or has half of
        ``per_cycle`` samples in a cycle.
        """
        motion, grid = self.motion, np.arange(self.sample_count, dtype=float)
        stride = int(per_cycle / max(_mean_cycle(motion, self.period), 2.0))
        if stride < 2 or self.steady:
            return self
        from scipy.interpolate import CubicHermiteSpline  # late: see mr_damper_ros.entry_points

        places: Array = np.arange((grid.size - 1) * stride + 1) / stride
        u, v, a, v_m = motion.arrays
        fine = Motion(
            CubicHermiteSpline(grid, u, v * self.period)(places),
            CubicHermiteSpline(grid, v, a * self.period)(places),
            np.interp(places, grid, a),
            np.interp(places, grid, v_m),
            motion.sine,
        )
        force = np.interp(places, grid, self.force)
        current = self.current[np.floor(places).astype(int)]
        whole = Window(fine, force, current, self.period / stride)
        return replace(self, places=stride * grid, whole=whole)

    def held_within(self, low: float, high: float) -> Window:
        """The same window with its peak velocity clipped; see :meth:`Motion.held_within`."""
        whole = None if self.whole is None else self.whole.held_within(low, high)
        return replace(self, motion=self.motion.held_within(low, high), whole=whole)

    def thinned(self, most: int) -> Window:
        """The window with one sample, drawn at random, of each of at least ``most`` equal parts.

        A constant stride that is commensurate with the period of the motion would look at a few
        phases of its cycle. A window with fewer than twice ``most`` samples is returned itself.
        """
        size = self.sample_count // most
        return self if size < 2 else self._drawn(size)

    def left_out(self, most: int) -> Window | None:
        """As :meth:`thinned`, but samples that it leaves out; None if there are none."""
        size = self.sample_count // most
        return None if size < 2 else self._drawn(size, other=True)

    def _drawn(self, size: int, *, other: bool = False) -> Window:
        """A random sample of each part of ``size`` samples, or another sample of each part."""
        rng = np.random.default_rng(_SEED)
        count = self.sample_count // size
        drawn = rng.integers(0, size, count)
        if other:
            drawn = (drawn + rng.integers(1, size, count)) % size
        few = self.part(np.arange(0, count * size, size) + drawn)
        if few.whole is None or few.places is None:
            return few
        whole = few.whole
        coarser = _history_stride(whole.motion, whole.current, whole.period, _SAMPLES_PER_CYCLE)
        if coarser == 1:
            return few
        motion = whole.part(slice(None, None, coarser))
        coarse = Window(motion.motion, motion.force, motion.current, coarser * whole.period)
        places = np.minimum(few.places / coarser, coarse.sample_count - 1.0)
        return replace(few, places=places, whole=coarse)

    @property
    def _places(self) -> Array:
        if self.places is not None:
            return self.places
        return np.arange(self.sample_count, dtype=float)

    @cached_property
    def has_constant_current(self) -> bool:
        """Whether the current is constant, also at samples that a thinned window omits."""
        return float(np.ptp((self.whole or self).current)) == 0.0

    @cached_property
    def steady(self) -> bool:
        """Whether the motion is a sine and the current constant."""
        return self.motion.sine is not None and self.has_constant_current

    @cached_property
    def history(self) -> MotionHistory:
        """History that underlies the samples; ValueError if the sample period is unknown."""
        whole, places, sine = self.whole or self, self._places, self.motion.sine
        if not whole.period > 0.0:
            raise ValueError("the sample period of the window is unknown, but a lag depends on it")
        if sine is None or not self.steady:
            branch = np.sign(self.motion.acceleration)
            along = whole.motion, whole.current, whole.period, places, branch
            return MotionHistory(*along, periodic=False)
        motion, period = _cycle(sine, float(self.motion.peak_velocity[0]), _SAMPLES_PER_CYCLE)
        current = np.full(_SAMPLES_PER_CYCLE, self.current[0])
        time = places * self.period
        branch = -np.sign(np.sin(2.0 * np.pi * sine.frequency * time + sine.phase))
        places = time / period % _SAMPLES_PER_CYCLE
        return MotionHistory(motion, current, period, places, branch, periodic=True)

    @property
    def time(self) -> Array:
        """Time of each sample [s] since the start of the complete window, shape (n,)."""
        return self._places * (self.whole or self).period

    @property
    def sample_count(self) -> int:
        """Number of samples."""
        return int(self.force.size)

    @cached_property
    def largest_force(self) -> float:
        """Largest absolute force [N], without spikes of the sensor."""
        return float(np.quantile(np.abs(self.force), _SPIKE_QUANTILE))

    @cached_property
    def covered_speeds(self) -> list[float]:
        """Deciles 1, 5 and 9 of the peak velocity [m/s], weighted by the speed: rest has none."""
        return _quantiles(self.motion.peak_velocity, self.motion.velocity, (0.1, 0.5, 0.9))

    @cached_property
    def covered_currents(self) -> list[float]:
        """Deciles 1, 3, 5, 7 and 9 of the current [A], weighted by the speed."""
        return _quantiles(self.current, self.motion.velocity, (0.1, 0.3, 0.5, 0.7, 0.9))

    @property
    def peak_velocity_range(self) -> tuple[float, float]:
        """5th and 95th percentile of the peak velocity [m/s] in the window."""
        low, high = np.quantile(self.motion.peak_velocity, (0.05, 0.95)).tolist()
        return low, high

    @property
    def dependence_range(self) -> tuple[float, float]:
        """Range of the peak velocity [m/s] in which a fit determines the dependence on it.

        The lowest values occur in small ripples, whose force hardly depends on them.
        """
        return self.peak_velocity_range[0], float(self.motion.peak_velocity.max())

    @cached_property
    def operating_point(self) -> tuple[float, float]:
        """Representative peak velocity [m/s] and current [A] of the window.

        The peak velocity is the root mean square over the samples, weighted by speed, so that rests
        and reversals have little weight. The current is the mean.
        """
        weights = np.abs(self.motion.velocity)
        if not np.any(weights):
            return 0.0, float(np.mean(self.current))
        v_m = np.sqrt(np.average(self.motion.peak_velocity**2, weights=weights))
        return float(v_m), float(np.mean(self.current))
