"""One sample of a motion in plain numbers: for what is reckoned for one sample at a time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion


class MotionSample(NamedTuple):
    """What :class:`Motion` holds of one sample [m], [m/s], [m/s²], [m/s]."""

    displacement: float
    velocity: float
    acceleration: float
    peak_velocity: float

    @classmethod
    def of(cls, motion: Motion, place: int) -> MotionSample:
        """The sample at a place of a motion."""
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
        """The same with a peak velocity within [m/s]; see :meth:`Motion.held_within`."""
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
