"""How a machine shall move: commands that come and stop coming, within limits."""

from __future__ import annotations

import math
from dataclasses import dataclass

_REST = (0.0, 0.0)


@dataclass(frozen=True)
class MotionLimits:
    """Largest ``amplitude`` [m] and ``velocity`` [m/s], and how long a command holds [s]."""

    amplitude: float
    velocity: float
    command_timeout: float


class MotionCommander:
    """A sine that is commanded, amplitude [m] and frequency [Hz], each command for a while.

    Times are seconds of one steady clock, which nobody sets. When the commands stop, the machine
    comes to rest. ``commanded``: whether there ever was a command; before, it moves by itself.
    ``refused`` counts the commands that were not taken.
    """

    def __init__(self, limits: MotionLimits) -> None:
        self.limits = limits
        self.refused = 0
        self.commanded = False
        self._wanted = _REST
        self._stamp_ns: int | None = None
        self._until = -math.inf

    def command(
        self, amplitude: float, frequency: float, stamp_ns: int, age: float, now: float
    ) -> str:
        """Take in a command that was decided ``age`` [s] ago; returns why not, empty if it holds.

        ``stamp_ns`` is the time of the decision: a command that was overtaken is refused.
        """
        refusal = self._refusal(amplitude, frequency, stamp_ns, age, now)
        if refusal:
            self.refused += 1
            return refusal
        self._stamp_ns = stamp_ns
        # Another thread may ask in between: what is wanted is there before it holds.
        self._wanted = (amplitude, frequency) if amplitude > 0.0 else _REST
        self._until = now + self.limits.command_timeout - max(age, 0.0)
        self.commanded = True
        return ""

    def wanted(self, now: float) -> tuple[float, float]:
        """Amplitude [m] and frequency [Hz] to move with now; zeros for rest."""
        return self._wanted if now < self._until else _REST

    def _refusal(
        self, amplitude: float, frequency: float, stamp_ns: int, age: float, now: float
    ) -> str:
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
        if not (math.isfinite(amplitude) and amplitude >= 0.0):
            return f"the commanded amplitude is {amplitude} m: it must be a size"
        if amplitude == 0.0:
            return ""
        if amplitude > limits.amplitude:
            return f"the amplitude of {amplitude:g} m is beyond {limits.amplitude:g} m"
        if not (math.isfinite(frequency) and frequency > 0.0):
            return f"the commanded frequency is {frequency} Hz: it must be positive"
        velocity = 2.0 * math.pi * frequency * amplitude
        if velocity > limits.velocity:
            return (
                f"{amplitude:g} m at {frequency:g} Hz moves at {velocity:.3g} m/s, beyond "
                f"{limits.velocity:g} m/s"
            )
        return ""
