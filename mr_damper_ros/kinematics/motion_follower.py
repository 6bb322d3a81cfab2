"""Motion of a stream of displacement, block by block, from the past alone.

A steady sine is followed by its fit, any other motion by the observer of
:mod:`mr_damper_ros.kinematics.causal`, whose bandwidth may follow the motion
(:mod:`mr_damper_ros.kinematics.adaptive_observer`).
"""

from __future__ import annotations

import numpy as np

from mr_damper_ros.kinematics.adaptive_observer import AdaptiveObserver
from mr_damper_ros.kinematics.causal import CausalDifferentiator, possible_bandwidths
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.motion_centre import MotionCentre
from mr_damper_ros.kinematics.peak_velocity import PeakVelocity, peak_velocity
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

_AHEAD = 0.02
"""Seconds of a sine that are foreseen at once where blocks are smaller: a hundred numbers are
computed in the time of one."""


class MotionFollower:
    """Follows samples of displacement ``period`` [s] apart.

    ``bandwidth`` [Hz] of the observer is brought into the range that the period allows; with 0 it
    follows the motion and the noise;
    ``centre_memory`` [s] must hold a whole cycle of the motion.

    Only what a block's own motion needs is done when it comes. The rest, which takes longer, is
    done by :meth:`catch_up`. ``foreseen`` is the motion of the next samples if the sine goes on;
    ``came`` of them have come so far, as :attr:`steady` then says. As long as they do there is
    nothing else to do for a while.
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
        self._ahead = round(_AHEAD / period)
        self._unlearned: list[Array] = []
        self.foreseen: Motion | None = None
        self.came = 0
        self._steady = False
        # Whether the sine that is foreseen is more than noise.
        self._moves = False

    @property
    def steady(self) -> bool:
        """Whether the motion of the last block was a sine that goes on, as it was foreseen."""
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
        if self._steady and self.foreseen is not None and self._moves:
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
            return (
                "the centre of the motion is not known before the motion has reversed three times"
            )
        if self._peak.half_cycles < _HALF_CYCLES_FOR_PEAK:
            return "the peak velocity is not known before the motion has made four half-cycles"
        return ""

    def follow(self, displacement: Array) -> Motion:
        """Motion at the next samples [m], shape (n,)."""
        if self.foreseen is None or self.came >= self._ahead:
            self._learn()
            self._foresee(displacement.size)
        end = self.came + displacement.size
        if self.foreseen is not None and end > self.foreseen.displacement.size:
            self._foresee(end)
        if self.foreseen is not None:
            motion = self.foreseen.part(slice(self.came, end))
            if self._sine.holds(motion.displacement, displacement):
                self._steady = True
                self._unlearned.append(displacement)
                self.came = end
                return motion
        # Before it is said that the sine is over: the observer has not seen the last of it.
        self._learn()
        self._steady = False
        self._unlearned.append(displacement)
        return self._observe(displacement)

    def catch_up(self) -> None:
        """Learn from the last block what only those after it need; :meth:`follow` does it, too."""
        if not self._unlearned:
            return
        if not self._steady or self.came >= self._ahead:
            count = self._unlearned[-1].size
            self._learn()
            self._foresee(count)

    def _learn(self) -> None:
        if not self._unlearned:
            return
        displacement = np.concatenate(self._unlearned)
        self._unlearned.clear()
        if self._steady:
            self._observe(displacement)
        if isinstance(self._differentiator, AdaptiveObserver):
            self._differentiator.adapt()
        self._sine.learn(displacement, self._centre.half_cycle)
        self.foreseen, self.came = None, 0

    def _foresee(self, count: int) -> None:
        """Foresee a block of so many samples that begins before the time to learn again."""
        sine = self._sine.ahead(self._ahead + count)
        self.foreseen = None if sine is None else _steady_motion(*sine)
        if self.foreseen is not None:
            self._moves = float(self.foreseen.peak_velocity.max()) > _NOISE_SPEED

    def _observe(self, displacement: Array) -> Motion:
        u, v, a = self._differentiator.follow(displacement)
        # What overshoots while the observer settles must not be remembered as a peak.
        v_m = self._peak.follow(v, a) if self._differentiator.settled else np.abs(v)
        centred = u - self._centre.follow(displacement)
        return Motion(
            displacement=centred, velocity=v, acceleration=a, peak_velocity=v_m, sine=None
        )


def _steady_motion(displacement: Array, velocity: Array, acceleration: Array) -> Motion:
    return Motion(
        displacement=displacement,
        velocity=velocity,
        acceleration=acceleration,
        peak_velocity=peak_velocity(displacement, velocity, acceleration),
        sine=None,
    )
