"""The options of programs that plan runs: the goal, and what the machine may do."""

from __future__ import annotations

import argparse
import math

from mr_damper_ros.estimation.force_knowledge import ForceGoal
from mr_damper_ros.estimation.planned_run import MachineLimits, motions_of
from mr_damper_ros.kinematics.periodic_motion import MotionKind
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL

OUT_OF_REACH = 3
"""Exit code where the goal cannot be met within the limits of the machine."""

_NEEDED = ("velocity", "current", "amplitude", "force")


def add_campaign_options(parser: argparse.ArgumentParser, *, required: bool) -> None:
    """Add the goal and the limits; ``required``: those without a default must be given."""
    goal = parser.add_argument_group("goal")
    goal.add_argument(
        "--error",
        type=float,
        default=0.01,
        help="worst error, relative to the largest force of a cycle (default %(default)s)",
    )
    for name, text in (("velocity", "peak velocities [m/s]"), ("current", "currents [A]")):
        goal.add_argument(
            f"--{name}", nargs=2, type=float, required=required, metavar=("LOW", "HIGH"), help=text
        )
    machine = parser.add_argument_group("machine")
    for name, unit, text in (
        ("amplitude", "M", "largest amplitude [m] about the centre"),
        ("force", "N", "largest force [N]"),
    ):
        machine.add_argument(f"--{name}", type=float, required=required, metavar=unit, help=text)
    machine.add_argument(
        "--top-velocity", type=float, metavar="M/S", help="largest (default: that of the goal)"
    )
    machine.add_argument(
        "--top-current", type=float, metavar="A", help="largest (default: that of the goal)"
    )
    machine.add_argument(
        "--duration", type=float, default=4.0, metavar="S", help="of a run (default %(default)s)"
    )
    machine.add_argument(
        "--heat", type=float, default=math.inf, metavar="J", help="that a run may bring in"
    )
    machine.add_argument(
        "--frequency",
        nargs=2,
        type=float,
        default=(0.1, 20.0),
        metavar=("LOW", "HIGH"),
        help="[Hz] (default 0.1 20)",
    )
    machine.add_argument(
        "--rate", type=float, default=1000.0, metavar="HZ", help="samples (default %(default)s)"
    )
    machine.add_argument(
        "--motions",
        nargs="+",
        choices=[kind.value for kind in MotionKind],
        default=[MotionKind.SINE.value],
        help="how it can move (default: sine): a sine, a swept sine, random motion",
    )
    machine.add_argument(
        "--manual",
        action="store_true",
        help="a person sets the press and the supply: sines alone, the current stays the same "
        "within a run",
    )
    parser.add_argument("--model", choices=tuple(MODELS), default=DEFAULT_MODEL)


def missing_options(options: argparse.Namespace) -> list[str]:
    """Options without a default that were not given."""
    return [f"--{name}" for name in _NEEDED if getattr(options, name) is None]


def goal_of(options: argparse.Namespace) -> ForceGoal:
    """The goal that is meant. Raises ValueError."""
    return ForceGoal(options.error, tuple(options.velocity), tuple(options.current))


def limits_of(options: argparse.Namespace) -> MachineLimits:
    """The limits of the machine. Raises ValueError."""
    return MachineLimits(
        amplitude=options.amplitude,
        peak_velocity=options.top_velocity or options.velocity[1],
        force=options.force,
        current=options.current[1] if options.top_current is None else options.top_current,
        duration=options.duration,
        heat=options.heat,
        frequency=tuple(options.frequency),
        sample_rate=options.rate,
        steps=not options.manual,
        motions=motions_of(["sine"] if options.manual else options.motions),
    )
