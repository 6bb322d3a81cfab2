"""Commands of current and motion with a dead-man timeout."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeVar

from mr_damper_ros.kinematics.periodic_motion import PeriodicMotion
from mr_damper_ros.settings.option_table import CheckedSettings, option

STAMP_TOLERANCE = 0.05
"""Largest time [s] by which a stamp may be ahead, because two computers' clocks may differ."""

_CLOCKS = (
    "the clocks differ: synchronise both computers, or set use_sim_time in both nodes or in neither"
)

T = TypeVar("T")


def named(commander: str) -> str:
    """The name of a commander, for a sentence; it is foreign text."""
    return " ".join(commander.split())[:80] or "the commander without a name"


CommandState = tuple[str, Mapping[str, object], bool]
"""What is commanded at present, as a sentence; values by name; whether the commands have stopped.
"""


class Commander(ABC, Generic[T]):
    """The latest command; a command holds for a limited time from its stamp on.

    Times are seconds of one steady clock. A command holds for ``timeout`` [s], and may be stamped
    ahead by ``tolerance`` [s]. ``refused`` counts the rejected commands. The first to command is
    the ``holder`` until its last command has expired; meanwhile, commands of others are rejected.
    """

    def __init__(self, first: T, timeout: float, tolerance: float = STAMP_TOLERANCE) -> None:
        self.refused = 0
        self.holder = ""
        self._target = first
        self._timeout = timeout
        self.tolerance = tolerance
        self._until = -math.inf
        self._stamp_ns: int | None = None

    @abstractmethod
    def state(self, now: float) -> CommandState:
        """The present command."""

    def refuse(self, reason: str) -> str:
        """Count a rejected command; returns the reason."""
        self.refused += 1
        return reason

    def is_held(self, now: float) -> bool:
        """Whether a command is in force."""
        return self._stamp_ns is not None and now < self._until

    def command(self, target: T, stamp_ns: int, age: float, now: float, commander: str = "") -> str:
        """Accept a command issued ``age`` [s] ago; returns the reason if it is rejected, or "".

        ``stamp_ns`` is the time of issue. A command older than the one in force is rejected.
        """
        objection = (
            self._holder_objection(commander, now)
            or self._limit_objection(target)
            or self._time_objection(stamp_ns, age, now)
        )
        if objection:
            return self.refuse(objection)
        self.holder = commander
        # Another thread may read in between, so the value must be set before its time limit.
        self._target = self._within(target)
        self._until = now + self._timeout - max(age, 0.0)
        # A command stamped ahead must not block later commands with correct stamps.
        self._stamp_ns = stamp_ns + round(1e9 * min(age, 0.0))
        return ""

    def _limit_objection(self, target: T) -> str:
        """Reason why a command is invalid at any time, in words; empty if it is valid."""
        return ""

    def _within(self, target: T) -> T:
        """Limit a command to the allowed range."""
        return target

    def _holder_objection(self, commander: str, now: float) -> str:
        if commander == self.holder or not self.is_held(now):
            return ""
        holder = named(self.holder)
        return (
            f"{holder} commands at present, so {named(commander)} is refused until {holder} has "
            f"been silent for {self._timeout:g} s: stop one of them"
        )

    def _time_objection(self, stamp_ns: int, age: float, now: float) -> str:
        if age < -self.tolerance:
            return (
                f"the command is stamped {-age:.3g} s ahead, more than the tolerance of "
                f"{self.tolerance:g} s: {_CLOCKS}"
            )
        if not age <= self._timeout:
            return (
                f"the command is stamped {age:.3g} s behind, more than command_timeout, "
                f"{self._timeout:g} s: {_CLOCKS}, unless the command was delayed"
            )
        if self._stamp_ns is not None and stamp_ns < self._stamp_ns and self.is_held(now):
            return "the command is older than the last one"
        return ""


class MotionCommander(Commander[PeriodicMotion | None]):
    """The commanded motion, None for rest. The machine stops when the commands stop.

    Motions beyond the ``amplitude`` [m] or the ``velocity`` [m/s] are rejected.
    """

    def __init__(self, amplitude: float, velocity: float, timeout: float) -> None:
        super().__init__(None, timeout)
        self._amplitude = amplitude
        self._velocity = velocity

    @property
    def commanded(self) -> bool:
        """Whether there has been a command; before that, the machine makes its own motion."""
        return self._stamp_ns is not None

    def state(self, now: float) -> CommandState:
        """The present command."""
        if not self.commanded:
            sentence = "the machine makes its own motion until a command arrives"
            return sentence, {"excitation": "its own"}, False
        motion = self.motion(now)
        if motion is None:
            return "the machine rests", {"excitation": "at rest"}, False
        return f"{motion.sentence} commanded", {"excitation": motion.sentence}, False

    def motion(self, now: float) -> PeriodicMotion | None:
        """The present motion; None for rest."""
        return self._target if now < self._until else None

    def _limit_objection(self, motion: PeriodicMotion | None) -> str:
        if motion is None:
            return ""
        if motion.amplitude > self._amplitude:
            return f"the amplitude of {motion.amplitude:g} m is beyond {self._amplitude:g} m"
        velocity = motion.growing_velocity
        if velocity > self._velocity:
            return f"{motion.sentence} moves at {velocity:.3g} m/s, beyond {self._velocity:g} m/s"
        return ""


_RAMP_STEP = 0.01
"""Time [s] between two steps of a ramp."""


@dataclass(frozen=True)
class CommandSettings(CheckedSettings):
    """Limits and timeouts for commands to a supply."""

    largest_current: float = option(
        2.0,
        "Rated current of the coil [A]; larger commands are limited to it and counted.",
        within=(0.0, 1000.0),
    )
    smallest_current: float = option(
        0.0, "Smallest current [A]; negative for a bipolar supply.", within=(-1000.0, 0.0)
    )
    slew_rate: float = option(
        0.0,
        "Largest rate of change of the current [A/s]; 0: no limit. Switching to a safe state "
        "is immediate.",
        within=(0.0, 1e6),
    )
    command_timeout: float = option(
        0.5,
        "Time [s] for which a command holds from its stamp on. When commands stop, the "
        "current is zero until another command arrives or the current is set by hand; a "
        "commanded motion ends. Older commands are rejected.",
        within=(0.01, 3600.0),
    )
    stamp_tolerance: float = option(
        STAMP_TOLERANCE,
        "Largest time [s] by which a command may be stamped ahead of this node's clock; "
        "commands stamped further ahead are rejected. Stamps that are always behind by more are a "
        "warning. Increase it only if the clocks of two computers cannot be synchronised.",
        within=(0.0, 3600.0),
    )


class Origin(Enum):
    """Origin of the present current."""

    HAND = "set by hand"
    COMMAND = "commanded"
    TIMED_OUT = "zero, because the commands have stopped"


class CurrentCommander(Commander[float]):
    """Current [A] from commands, each for a limited time, or set by hand, without a time limit.

    A command replaces a current set by hand. When the commands stop, the current is zero at once,
    until another command arrives or the current is set by hand again. ``cut`` counts the commands
    that were limited.
    """

    def __init__(self, settings: CommandSettings, by_hand: float = 0.0) -> None:
        super().__init__(0.0, settings.command_timeout, settings.stamp_tolerance)
        self.settings = settings
        self.cut = 0
        self._given, self._at = 0.0, 0.0
        self.set_by_hand(by_hand)

    def set_by_hand(self, current: float) -> None:
        """Set this current until a command arrives."""
        self._target, self._stamp_ns, self.holder = self._limited(current), None, ""
        self._until = math.inf

    def state(self, now: float) -> CommandState:
        """The present command."""
        origin = self.origin(now)
        values = {"origin": origin.name, "cut": self.cut}
        return f"the current is {origin.value}", values, origin is Origin.TIMED_OUT

    def origin(self, now: float) -> Origin:
        """Origin of the current at this time."""
        if math.isinf(self._until):
            return Origin.HAND
        return Origin.COMMAND if now < self._until else Origin.TIMED_OUT

    def step(self, now: float) -> float:
        """The present current [A]; its change since the last call is within the slew rate."""
        elapsed, self._at = max(now - self._at, 0.0), now
        if self.origin(now) is Origin.TIMED_OUT:
            self._given = 0.0
        else:
            rate = self.settings.slew_rate
            most = rate * elapsed if rate > 0.0 else math.inf
            self._given += min(max(self._target - self._given, -most), most)
        return self._given

    def wait(self, now: float) -> float:
        """Seconds until the current changes without a new command, in a ramp or at the timeout."""
        origin = self.origin(now)
        if origin is Origin.TIMED_OUT:
            return math.inf
        return _RAMP_STEP if self._given != self._target else max(self._until - now, 0.0)

    def start(self, now: float) -> None:
        """Start at zero current, because the output has just been switched on."""
        self._given, self._at = 0.0, now

    def _limit_objection(self, current: float) -> str:
        return "" if math.isfinite(current) else "the commanded current is not finite"

    def _within(self, current: float) -> float:
        within = self._limited(current)
        self.cut += within != current
        return within

    def _limited(self, current: float) -> float:
        return min(max(current, self.settings.smallest_current), self.settings.largest_current)
