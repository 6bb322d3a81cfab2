"""``plan_run``: which run to make next, so that the force is soon known well enough."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from mr_damper_ros.campaign.course import advise_run
from mr_damper_ros.campaign.runs import write_signal
from mr_damper_ros.estimation.force_knowledge import ForceGoal
from mr_damper_ros.estimation.planned_run import first_run
from mr_damper_ros.estimation.run_planner import Plan, PlanState
from mr_damper_ros.processes.files import write_text
from mr_damper_ros.tools.campaign_options import (
    OUT_OF_REACH,
    add_campaign_options,
    goal_of,
    limits_of,
)
from mr_damper_ros.tools.console import FAILED, run_tool


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    return run_tool(_parser(), _plan_run, arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="plan_run",
        description="Say which run of the test machine comes next, so that the force of a damper "
        "is soon known to a given error over a range of peak velocity and current; without bags, "
        "the first one.",
        epilog=f"Exit code: 0, also where the goal is met; {OUT_OF_REACH} where it cannot be met "
        f"within the limits; {FAILED} where a bag or an option cannot be used.",
    )
    parser.add_argument("bags", nargs="*", type=Path, metavar="BAG", help="runs made so far")
    add_campaign_options(parser, required=True)
    parser.add_argument(
        "--signal", type=Path, metavar="FILE", help="write the run as CSV, to be played"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the plan as JSON")
    return parser


def _plan_run(options: argparse.Namespace) -> int:
    goal, limits = goal_of(options), limits_of(options)
    plan = advise_run(options.bags, goal, limits, options.model) if options.bags else None
    run = first_run(goal, limits) if plan is None else plan.run
    document: dict[str, object] = {"state": "run" if plan is None else plan.state.value}
    if plan is not None:
        _tell(plan, goal)
        document |= {"worst_error": plan.now.worst, "worst_point": plan.now.worst_point}
    if run is not None:
        print(f"run {run.sentence}")
        document |= {"run": asdict(run)}
        if options.signal is not None:
            write_signal(run, options.signal, limits.sample_rate)
            print(f"signal: {options.signal}")
    if options.json is not None:
        write_text(options.json, json.dumps(document, indent=2, allow_nan=False) + "\n")
    return OUT_OF_REACH if plan is not None and plan.state is PlanState.OUT_OF_REACH else 0


def _tell(plan: Plan, goal: ForceGoal) -> None:
    speed, current = plan.now.worst_point
    print(
        f"the force is known to {plan.now.sentence}, where {goal.error:.2%} is wanted; "
        f"least at {speed:.3g} m/s and {current:.3g} A"
    )
    if plan.reason:
        print(plan.reason)
    elif plan.runs_left is not None:
        print(f"about {plan.runs_left} more runs will do")
