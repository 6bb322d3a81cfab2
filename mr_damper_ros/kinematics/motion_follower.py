"""Motion of a stream of displacement, block by block, from the past alone.

A steady sine is followed by its fit, any other motion by the observer of
:mod:`mr_damper_ros.kinematics.observer`, whose bandwidth may follow the motion
(:mod:`mr_damper_ros.kinematics.observer`).
"""

from __future__ import annotations

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.motion_centre import MotionCentre
from mr_damper_ros.kinematics.observer import (
    AdaptiveObserver,
    CausalDifferentiator,
    possible_bandwidths,
)
from mr_damper_ros.kinematics.peak_velocity import PeakVelocity
from mr_damper_ros.kinematics.sine_follower import SineFollower
from mr_damper_ros.signals.arrays import Array

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
