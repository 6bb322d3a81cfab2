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

_HALF_CYCLES_FOR_PEAK = 4
"""Of fewer half-cycles the angular frequency, and with it the peak velocity, is a guess."""


class MotionFollower:
    """Follows samples of displacement ``period`` [s] apart.

    ``bandwidth`` [Hz] of the observer is brought into the range that the period allows; with 0 it
    follows the motion and the noise;
    ``centre_memory`` [s] must hold a whole cycle of the motion.

    Only what a block's own motion needs is done when it comes. The rest, which takes longer, is
    done by :meth:`catch_up`. ``foreseen`` is the motion of the next block if the sine goes on and
    the block is as long as the last one; :attr:`steady` then says that it was so.
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
        self._unlearned: Array | None = None
        self.foreseen: Motion | None = None
        self._steady = False

    @property
    def steady(self) -> bool:
        """Whether the motion of the last block was a sine that goes on, as it was foreseen."""
        return self._steady

    @property
    def reversals(self) -> int:
        """Changes of direction up to the last block caught up with."""
        return self._centre.reversals

    @property
    def resting(self) -> bool:
        """Whether the motion has come to rest."""
        return not self._steady and self._centre.resting

    @property
    def half_cycle(self) -> float:
        """The longest [s] of the latest half-cycles, NaN before the first."""
        return self._centre.usual_half_cycle

    @property
    def usual_peak_velocity(self) -> float:
        """Root mean square [m/s] over the latest half-cycles up to the last block observed."""
        return self._peak.root_mean_square

    @property
    def doubt(self) -> str:
        """Why the motion of the last block is not known well yet; empty where it is."""
        if self._steady:
            return ""
        if not self._differentiator.settled:
            return "the velocity estimate is still settling after the start of the stream"
        if self._centre.reversals < _REVERSALS_FOR_CENTRE:
            return (
                "the centre of the motion is not known before the motion has reversed three times"
            )
        if self._peak.half_cycles < _HALF_CYCLES_FOR_PEAK:
            return "the peak velocity is not known before the motion has made four half-cycles"
        return ""

    def follow(self, displacement: Array) -> Motion:
        """Motion at the next samples [m], shape (n,)."""
        self.catch_up()
        if self.foreseen is None or self.foreseen.displacement.size != displacement.size:
            self._foresee(displacement.size)
        self._unlearned = displacement
        foreseen = self.foreseen
        self._steady = foreseen is not None and self._sine.holds(
            foreseen.displacement, displacement
        )
        if foreseen is not None and self._steady:
            return foreseen
        return self._observe(displacement)

    def catch_up(self) -> None:
        """Learn from the last block what only those after it need; :meth:`follow` does it, too."""
        if self._unlearned is None:
            return
        if self._steady:
            self._observe(self._unlearned)
        if isinstance(self._differentiator, AdaptiveObserver):
            self._differentiator.adapt()
        self._sine.learn(self._unlearned, self._centre.half_cycle)
        self._foresee(self._unlearned.size)
        self._unlearned = None

    def _foresee(self, count: int) -> None:
        sine = self._sine.ahead(count)
        self.foreseen = None if sine is None else _steady_motion(*sine)

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
