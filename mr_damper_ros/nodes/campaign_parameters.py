"""The parameters of the campaign node: the goal, the limits of the machine, and the node's own."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mr_damper_ros.campaign.conductor import ConductSettings
from mr_damper_ros.estimation.force_knowledge import ForceGoal
from mr_damper_ros.estimation.planned_run import MachineLimits, motions_of
from mr_damper_ros.kinematics.periodic_motion import MotionKind
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL
from mr_damper_ros.settings.option_table import ParameterTable, group, option


@dataclass(frozen=True)
class GoalOptions(ParameterTable):
    """What is to be known of the damper; a goal of the action may say otherwise."""

    error: float = option(
        0.01,
        "Worst error of the force to be reached, relative to the largest force of a cycle.",
        minimum=1e-5,
        maximum=0.9,
    )
    lowest_peak_velocity: float = option(
        0.02, "Lowest peak velocity [m/s] of the goal.", minimum=1e-5, maximum=10.0
    )
    highest_peak_velocity: float = option(
        0.2, "Highest peak velocity [m/s] of the goal.", minimum=1e-5, maximum=10.0
    )
    lowest_current: float = option(
        0.0, "Lowest current [A] of the goal.", minimum=0.0, maximum=50.0
    )
    highest_current: float = option(
        1.5, "Highest current [A] of the goal.", minimum=0.0, maximum=50.0
    )

    def goal(self) -> ForceGoal:
        """The goal; raises ValueError, in a sentence, where it cannot be meant."""
        return ForceGoal(
            self.error,
            (self.lowest_peak_velocity, self.highest_peak_velocity),
            (self.lowest_current, self.highest_current),
        )


@dataclass(frozen=True)
class MachineOptions(ParameterTable):
    """What the machine may do; no goal of the action can widen it."""

    amplitude: float = option(
        0.01, "Largest amplitude [m] about the centre.", minimum=1e-5, maximum=0.25
    )
    peak_velocity: float = option(0.2, "Largest peak velocity [m/s].", minimum=1e-5, maximum=10.0)
    force: float = option(
        2000.0,
        "Largest force [N] of either sign. No run is planned that may exceed it, as far as the "
        "damper is known; where a sample exceeds it, the campaign ends and the machine rests.",
        minimum=1.0,
        maximum=1e6,
    )
    current: float = option(1.5, "Largest current [A].", minimum=0.0, maximum=50.0)
    duration: float = option(
        4.0,
        "Time [s] of a run, once it is steady. Besides, the motion grows and fades within two "
        "cycles each, and two are looked at.",
        minimum=0.1,
        maximum=3600.0,
    )
    heat: float = option(
        0.0, "Heat [J] that a run may bring in; 0: as much as it does.", minimum=0.0, maximum=1e9
    )
    lowest_frequency: float = option(
        0.1, "Lowest frequency [Hz] of the motion.", minimum=1e-3, maximum=100.0
    )
    highest_frequency: float = option(
        20.0, "Highest frequency [Hz] of the motion.", minimum=1e-3, maximum=100.0
    )
    sample_rate: float = option(
        1000.0,
        "Samples per second [Hz] that it gives; they tell what a run is worth.",
        minimum=10.0,
        maximum=100_000.0,
    )

    motions: str = option(
        MotionKind.SINE.value,
        "How the machine can move, one or more words: sine, sweep (a swept sine), random (with a "
        "spectrum). By hand there are sines alone.",
    )

    def limits(self, *, manual: bool) -> MachineLimits:
        """The limits; by hand nobody steps a current within a run, or makes more than sines.

        Raises ValueError.
        """
        return MachineLimits(
            amplitude=self.amplitude,
            peak_velocity=self.peak_velocity,
            force=self.force,
            current=self.current,
            duration=self.duration,
            heat=self.heat or math.inf,
            frequency=(self.lowest_frequency, self.highest_frequency),
            sample_rate=self.sample_rate,
            steps=not manual,
            motions=motions_of(["sine"] if manual else self.motions.split()),
        )


@dataclass(frozen=True)
class CampaignParameters(ParameterTable):
    """Parameters of the campaign node.

    A goal of the action ~/run_campaign begins, or goes on. It commands the machine
    (rig/excitation_command) and the supply (supply/current_command), waits until both do what is
    commanded, keeps the samples of the run as a bag, identifies from all runs and chooses the next,
    until the force is known as well as wanted. ~/pause lets the machine rest, ~/resume goes on,
    ~/stop ends the campaign. It may be killed at any moment: the same goal goes on with the runs
    that are kept.
    """

    folder: str = option(
        "",
        "Folder of the campaign: its runs as bags, what was found after each, the last set "
        "(set.yaml) and the report (campaign.html). One that holds an unfinished campaign of the "
        'same goal goes on. "": no goal is accepted.',
        read_only=True,
    )
    autostart: bool = option(
        False,
        "Begin, or go on, with the configured goal at the start, without waiting for a goal of "
        "the action: the machine moves.",
        read_only=True,
    )
    model: str = option(
        DEFAULT_MODEL, "Force law that is identified.", choices=tuple(MODELS), read_only=True
    )
    most_runs: int = option(
        20, "Runs that a campaign makes at most.", minimum=1, maximum=999, read_only=True
    )
    conduct: ConductSettings = group(ConductSettings, flat=True, read_only=True)
    goal: GoalOptions = group(GoalOptions, read_only=True)
    machine: MachineOptions = group(MachineOptions, read_only=True)
    samples_timeout: float = option(
        1.0,
        "Time [s] without samples, on the clock of this computer, after which the machine is to "
        "rest; the run is made anew when they come again.",
        minimum=0.05,
        maximum=60.0,
        read_only=True,
    )
    frame_id: str = option("damper", "Frame of the commands.", read_only=True)

    def objection(self) -> str:
        """Say what goal or limits cannot be meant, or what a start by itself lacks."""
        try:
            self.goal.goal()
            self.machine.limits(manual=self.conduct.manual)
        except ValueError as error:
            return str(error)
        if self.autostart and not self.folder:
            return "autostart needs a folder: set the parameter folder"
        return ""
