"""How a machine shall move: commands that come and stop coming, within limits."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mr_damper_ros.kinematics.periodic_motion import PeriodicMotion


@dataclass(frozen=True)
class MotionLimits:
    """Largest ``amplitude`` [m] and ``velocity`` [m/s], and how long a command holds [s]."""

    amplitude: float
    velocity: float
    command_timeout: float


class MotionCommander:
    """A motion that is commanded, each command for a while.

    Times are seconds of one steady clock, which nobody sets. When the commands stop, the machine
    comes to rest. ``commanded``: whether there ever was a command; before, it moves by itself.
    ``refused`` counts the commands that were not taken.
    """

    def __init__(self, limits: MotionLimits) -> None:
        self.limits = limits
        self.refused = 0
        self.commanded = False
        self._wanted: PeriodicMotion | None = None
        self._stamp_ns: int | None = None
        self._until = -math.inf

    def command(self, motion: PeriodicMotion | None, stamp_ns: int, age: float, now: float) -> str:
        """Take in a command that was decided ``age`` [s] ago; returns why not, empty if it holds.

        None stands for rest. ``stamp_ns`` is the time of the decision: a command that was
        overtaken is refused.
        """
        refusal = self._refusal(motion, stamp_ns, age, now)
        if refusal:
            self.refused += 1
            return refusal
        self._stamp_ns = stamp_ns
        # Another thread may ask in between: what is wanted is there before it holds.
        self._wanted = motion
        self._until = now + self.limits.command_timeout - max(age, 0.0)
        self.commanded = True
        return ""

    def refuse(self, reason: str) -> str:
        """Count a command that is no motion at all; returns the reason."""
        self.refused += 1
        return reason

    def wanted(self, now: float) -> PeriodicMotion | None:
        """The motion to make now; None for rest."""
        return self._wanted if now < self._until else None

    def _refusal(self, motion: PeriodicMotion | None, stamp_ns: int, age: float, now: float) -> str:
        limits = self.limits
        timeout = limits.command_timeout
        if not -timeout <= age <= timeout:
            when = f"{age:.3g} s old" if age > 0.0 else f"stamped {-age:.3g} s in the future"
            return (
                f"the command is {when}, and command_timeout is {timeout:g} s: are the clocks of "
                "both computers the same?"
            )
        if self._stamp_ns is not None and stamp_ns < self._stamp_ns and now < self._until:
            return "the command came after a newer one"
        if motion is None:
            return ""
        if motion.amplitude > limits.amplitude:
            return f"the amplitude of {motion.amplitude:g} m is beyond {limits.amplitude:g} m"
        velocity = motion.growing_velocity
        if velocity > limits.velocity:
            return f"{motion.sentence} moves at {velocity:.3g} m/s, beyond {limits.velocity:g} m/s"
        return ""
