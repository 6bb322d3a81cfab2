"""Options of the goal and of the machine of a campaign, for the node and ``mr-damper plan``."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mr_damper_ros.estimation.experiment_design import ForceGoal, MachineLimits, motions_of
from mr_damper_ros.kinematics.periodic_motion import MotionKind
from mr_damper_ros.settings.option_table import ParameterTable, option


@dataclass(frozen=True)
class GoalOptions(ParameterTable):
    """The accuracy and the operating range to reach; a goal of the action may override them."""

    error: float = option(
        0.01,
        "Required error of the force at the worst point, relative to the largest force of a cycle.",
        within=(1e-5, 0.9),
    )
    lowest_peak_velocity: float = option(
        0.02, "Lowest peak velocity [m/s] of the goal.", within=(1e-5, 10.0)
    )
    highest_peak_velocity: float = option(
        0.2, "Highest peak velocity [m/s] of the goal.", within=(1e-5, 10.0)
    )
    lowest_current: float = option(0.0, "Lowest current [A] of the goal.", within=(0.0, 50.0))
    highest_current: float = option(1.5, "Highest current [A] of the goal.", within=(0.0, 50.0))

    def goal(self) -> ForceGoal:
        """Return the goal; raises ValueError if it is impossible."""
        return ForceGoal(
            self.error,
            (self.lowest_peak_velocity, self.highest_peak_velocity),
            (self.lowest_current, self.highest_current),
        )


@dataclass(frozen=True)
class MachineOptions(ParameterTable):
    """The limits of the machine; a goal of the action cannot widen them."""

    amplitude: float = option(0.01, "Largest amplitude [m] about the centre.", within=(1e-5, 0.25))
    peak_velocity: float = option(0.2, "Largest peak velocity [m/s].", within=(1e-5, 10.0))
    force: float = option(
        2000.0,
        "Largest magnitude of the force [N]. Runs with a larger predicted force are not planned. "
        "If a sample exceeds it, the campaign ends and the machine rests.",
        within=(1.0, 1e6),
    )
    current: float = option(1.5, "Largest current [A].", within=(0.0, 50.0))
    duration: float = option(
        4.0,
        "Steady time [s] of a run. In addition, the motion grows within two cycles, two cycles "
        "are checked, and the motion fades within two cycles.",
        within=(0.1, 3600.0),
    )
    heat: float = option(
        0.0, "Largest heat [J] dissipated in a run; 0: no limit.", within=(0.0, 1e9)
    )
    lowest_frequency: float = option(
        0.1, "Lowest frequency [Hz] of the motion.", within=(1e-3, 100.0)
    )
    highest_frequency: float = option(
        20.0, "Highest frequency [Hz] of the motion.", within=(1e-3, 100.0)
    )
    sample_rate: float = option(
        1000.0,
        "Sample rate of the machine [Hz], used to compute the information of a run.",
        within=(10.0, 100_000.0),
    )

    motions: str = option(
        MotionKind.SINE.value,
        "Motions that the machine supports, one or more of: sine, sweep (a swept sine), "
        "random (with a spectrum). A manual press makes sines only.",
    )

    def limits(self, *, manual: bool) -> MachineLimits:
        """Return the limits; a manual press makes only sines, each at constant current.

        Raises ValueError if they are impossible.
        """
        same = ("amplitude", "peak_velocity", "force", "current", "duration", "sample_rate")
        return MachineLimits(
            **{name: getattr(self, name) for name in same},
            heat=self.heat or math.inf,
            frequency=(self.lowest_frequency, self.highest_frequency),
            steps=not manual,
            motions=motions_of(["sine"] if manual else self.motions.split()),
        )
