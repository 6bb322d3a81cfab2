"""The motion behind the samples of a window: what a lag needs, also where samples were left out.

A lag acts on the motion as it went on, not on the samples that a search picked from it. A steady
sine is known at all times: one cycle of it, as a periodic motion, stands for all that went before.
Of any other motion the samples of the whole window are kept, or enough of them to follow it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mr_damper_ros.kinematics.motion import Motion, Sine
from mr_damper_ros.signals.arrays import Array

_SAMPLES_PER_CYCLE = 1000
"""So many follow the steepest sigmoid, whose rise takes two degrees of a cycle."""

_FEWER_PER_CYCLE = 200
"""So many follow a hysteresis, which yields over a tenth of a cycle or so."""

LONGEST_SETTLING = 0.25
"""No more than this part of a window is left out because its past is not known."""


@dataclass(frozen=True, eq=False)
class MotionHistory:
    """Motion and current (m,), ``period`` [s] apart, behind the n samples of a window.

    ``places`` (n,) are where the window's samples lie, counted in samples of the history;
    ``branch`` (n,) is the sign of their acceleration, at whose change the sigmoid force jumps.
    ``periodic``: the history is one period, which has always gone on before.
    """

    motion: Motion
    current: Array
    period: float
    places: Array
    branch: Array
    periodic: bool

    @classmethod
    def of_sine(
        cls, sine: Sine, peak_velocity: float, current: float, time: Array
    ) -> MotionHistory:
        """One cycle of a steady sine; ``time`` [s] of the samples, on the clock of the sine."""
        count = _SAMPLES_PER_CYCLE
        period = 1.0 / (sine.frequency * count)
        cycle: Array = np.arange(count, dtype=float) * period
        motion = Motion.of_sine(sine, cycle, peak_velocity)
        places = time / period % count
        branch = np.sign(sine.acceleration(time))
        return cls(motion, np.full(count, current), period, places, branch, periodic=True)

    @cached_property
    def is_window(self) -> bool:
        """Whether the samples of the history are those of the window."""
        count = self.current.size
        return self.places.size == count and bool(np.all(self.places == np.arange(count)))

    @cached_property
    def _picked(self) -> np.ndarray | None:
        """Places (n,) of the window's samples as indices; None where some lie between two."""
        places = self.places.astype(int)
        return places if not self.periodic and np.array_equal(places, self.places) else None

    @property
    def holds_samples(self) -> bool:
        """Whether all samples of the window are some of the history: nothing is interpolated."""
        return self.is_window or self._picked is not None

    @cached_property
    def _between(self) -> tuple[np.ndarray, np.ndarray, Array]:
        """Of each sample the earlier and the later place in the history, and the way between."""
        count = self.current.size
        earlier = np.floor(self.places).astype(int)
        if not self.periodic:
            earlier = np.minimum(earlier, count - 2)
        share = np.minimum(self.places - earlier, 1.0)
        earlier, later = earlier % count, (earlier + 1) % count
        # Nothing is interpolated across a jump.
        branch = np.sign(self.motion.acceleration)
        jumps = branch[earlier] != branch[later]
        share[jumps] = branch[later[jumps]] == self.branch[jumps]
        return earlier, later, share

    @cached_property
    def coarse(self) -> MotionHistory:
        """The same with fewer samples, for what changes less steeply than a sigmoid."""
        stride = following_stride(self.motion, self.period, _FEWER_PER_CYCLE)
        if self.periodic:
            stride = self.current.size // _FEWER_PER_CYCLE
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
        if self.is_window:
            return values
        if self._picked is not None:
            # As they lie in memory: derivatives by columns.
            if values.ndim > 1 and values.flags.f_contiguous:
                return np.take(values.T, self._picked, axis=-1).T
            return np.take(values, self._picked, axis=0)
        earlier, later, share = self._between
        share = share.reshape(-1, *(1,) * (values.ndim - 1))
        return np.asarray((1.0 - share) * values[earlier] + share * values[later])

    def unsettled(self, duration: float) -> np.ndarray:
        """Mask (n,) of samples that follow the unknown past by less than this duration [s].

        Never more than a quarter of the samples, which may all be at the beginning of the history.
        """
        if self.periodic:
            return np.zeros(self.places.size, dtype=bool)
        since = self.places * self.period
        return np.asarray(since < min(duration, since[int(LONGEST_SETTLING * since.size)]))


def following_stride(
    motion: Motion, period: float, samples_per_cycle: int = _SAMPLES_PER_CYCLE
) -> int:
    """How many samples of a motion one step of a history that still follows it may span."""
    power = float(np.mean(motion.velocity**2))
    if power == 0.0:
        return 1
    rate = math.sqrt(float(np.mean(motion.acceleration**2)) / power)
    return max(int(2.0 * math.pi / max(rate, 1e-12) / period / samples_per_cycle), 1)
