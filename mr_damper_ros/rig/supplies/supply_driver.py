"""Drives a supply by commands: sets, reads back, and notices where the two do not agree."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mr_damper_ros.rig.supplies.current_commander import CurrentCommander
from mr_damper_ros.rig.supplies.scpi_supply import ScpiSupply

_ASK_FOR_ERRORS = 1.0
"""Seconds between two looks into the instrument's queue of errors."""

_SETTLING = 1.0
"""Seconds that a coil and a supply may take to reach a new current."""


@dataclass
class SupplyState:
    """What is known of a supply that is driven: currents [A], and what it has complained of."""

    given: float = 0.0
    measured: float = math.nan
    deviates: bool = False
    complaints: int = 0
    last_complaint: str = ""


class SupplyDriver:
    """A supply under command; times are seconds of one steady clock.

    ``tolerance`` [A] is by how much the measured current may be off. What the supply raises passes
    through: whoever drives it then has to see that it is off.
    """

    def __init__(self, supply: ScpiSupply, commander: CurrentCommander, tolerance: float) -> None:
        self._supply = supply
        self._commander = commander
        self._tolerance = tolerance
        self._agreed = math.inf
        self._asked = -math.inf
        self.state = SupplyState()

    def start(self, now: float) -> None:
        """Switch on, at no current."""
        self.state = SupplyState()
        self._agreed = now
        self._supply.switch_on()
        self._commander.start(now)

    def obey(self, now: float) -> None:
        """Set the current that is to be given now."""
        given = self._commander.step(now)
        self._supply.give(given)
        self.state.given = given

    def wait(self, now: float) -> float:
        """Seconds until there is something to obey again."""
        return self._commander.wait(now)

    def read(self, now: float) -> float:
        """The measured current [A]."""
        measured = self._supply.measured()
        self.state.measured = measured
        if abs(measured - self.state.given) <= self._tolerance:
            self._agreed = now
        self.state.deviates = now - self._agreed > _SETTLING
        return measured

    def check(self, now: float) -> None:
        """Read one of the instrument's complaints, now and then, and while there are more."""
        if now - self._asked < _ASK_FOR_ERRORS:
            return
        complaint = self._supply.next_error()
        if complaint:
            self.state.complaints += 1
            self.state.last_complaint = complaint
        else:
            self._asked = now

    def stop(self) -> None:
        """Switch off."""
        self.state.given = 0.0
        self._supply.switch_off()
