"""The current of a supply that is turned while a rig runs."""

from __future__ import annotations

import math

from mr_damper_ros.rig.emulator import CurrentSchedule
from mr_damper_ros.rig.supplies.current_commander import CurrentCommander


class SupplyKnob:
    """The current of a supply, as a schedule that goes on from block to block."""

    def __init__(self, current: float = 0.0) -> None:
        # The schedule reads these lists, which grow while the rig runs.
        self._times, self._currents = [0.0], [current]
        self.schedule = CurrentSchedule(self._times, self._currents)

    def turn(self, time: float, current: float) -> None:
        """Supply this current [A] from a time [s] on, or from right after the last turn."""
        if current != self._currents[-1]:
            # Of what is past only the latest matters.
            del self._times[:-1], self._currents[:-1]
            self._times.append(max(time, math.nextafter(self._times[-1], math.inf)))
            self._currents.append(current)


class CommandedKnob(SupplyKnob):
    """A knob that is turned by a commander; ``clock`` is the steady clock [s] of its commands."""

    def __init__(self, commander: CurrentCommander, clock: float) -> None:
        super().__init__(commander.step(clock))
        self._commander = commander

    def follow(self, time: float, clock: float) -> None:
        """Supply from a time [s] on what the commander now says."""
        self.turn(time, self._commander.step(clock))
