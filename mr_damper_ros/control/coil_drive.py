"""From the current that the coil should have to the command of its supply.

The coil's current follows that of the supply with a first-order lag, see
:mod:`mr_damper_ros.models.first_order_lag`. The command is the current that brings the coil to
where it should be by the end of a horizon: more than that as long as it rises, less as it falls.
What the supply cannot do it is not asked for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from mr_damper_ros.settings.option_table import CheckedSettings, option


@dataclass(frozen=True)
class SupplyLimits(CheckedSettings):
    """What may be asked of the supply."""

    lowest_current: float = option(
        0.0,
        "The lowest current that is commanded [A], within those that the parameters were "
        "identified at.",
        minimum=-10.0,
        maximum=10.0,
    )
    highest_current: float = option(
        2.0,
        "Highest current [A] that is commanded; the damper's data sheet says what it bears.",
        minimum=-10.0,
        maximum=10.0,
    )
    slew_rate: float = option(
        0.0,
        "Fastest change of the command [A/s]; 0 for no limit.",
        minimum=0.0,
        maximum=1e6,
    )

    def limited(self, command: float, before: float, duration: float) -> float:
        """The command [A] within the limits; it may move from ``before`` for ``duration`` [s]."""
        command = min(max(command, self.lowest_current), self.highest_current)
        if self.slew_rate > 0.0:
            reach = self.slew_rate * duration
            command = min(max(command, before - reach), before + reach)
        return command


class CoilDrive:
    """Commands for a supply within limits, to a coil of this time constant [s], 0 for no lag.

    Raises ValueError where the highest current is not above the lowest.
    """

    def __init__(self, limits: SupplyLimits, time_constant: float) -> None:
        if not limits.lowest_current < limits.highest_current:
            raise ValueError(
                f"highest_current is {limits.highest_current:g} A: it must be above the lowest, "
                f"{limits.lowest_current:g} A"
            )
        self._limits = limits
        self._time_constant = time_constant

    def towards(self, wanted: float, coil: float, horizon: float) -> float:
        """Current [A] that brings the coil from ``coil`` to ``wanted`` [A] in a horizon [s]."""
        if self._time_constant == 0.0:
            return wanted
        return coil + (wanted - coil) / -math.expm1(-horizon / self._time_constant)
