"""How a machine shall move: commands that come and stop coming, within limits."""

from __future__ import annotations

from dataclasses import dataclass

from mr_damper_ros.kinematics.periodic_motion import PeriodicMotion
from mr_damper_ros.rig.commander import Commander


@dataclass(frozen=True)
class MotionLimits:
    """Largest ``amplitude`` [m] and ``velocity`` [m/s], and how long a command holds [s]."""

    amplitude: float
    velocity: float
    command_timeout: float


class MotionCommander(Commander):
    """A motion that is commanded, each command for a while.

    When the commands stop, the machine comes to rest. ``commanded``: whether there ever was a
    command; before, it moves by itself.
    """

    def __init__(self, limits: MotionLimits) -> None:
        super().__init__(limits.command_timeout)
        self.limits = limits
        self.commanded = False
        self._wanted: PeriodicMotion | None = None

    def command(self, motion: PeriodicMotion | None, stamp_ns: int, age: float, now: float) -> str:
        """Take in a command that was decided ``age`` [s] ago; returns why not, empty if it holds.

        None stands for rest. ``stamp_ns`` is the time of the decision: a command that was
        overtaken is refused.
        """
        objection = self._objection(stamp_ns, age, now) or self._beyond(motion)
        if objection:
            return self.refuse(objection)
        # Another thread may ask in between: what is wanted is there before it holds.
        self._wanted = motion
        self._hold(stamp_ns, age, now)
        self.commanded = True
        return ""

    def wanted(self, now: float) -> PeriodicMotion | None:
        """The motion to make now; None for rest."""
        return self._wanted if now < self._until else None

    def _beyond(self, motion: PeriodicMotion | None) -> str:
        """Which limit a motion is beyond, in words; empty where it is within."""
        limits = self.limits
        if motion is None:
            return ""
        if motion.amplitude > limits.amplitude:
            return f"the amplitude of {motion.amplitude:g} m is beyond {limits.amplitude:g} m"
        velocity = motion.growing_velocity
        if velocity > limits.velocity:
            return f"{motion.sentence} moves at {velocity:.3g} m/s, beyond {limits.velocity:g} m/s"
        return ""
