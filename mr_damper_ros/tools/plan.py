"""Recommend the run of the test machine that makes the force of the damper most accurate.

The goal is a range of peak velocity and current. Without bags, the first run is recommended.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict

from mr_damper_ros.campaign.course import (
    CampaignCourse,
    CampaignOutcome,
    advise_run,
    fault_of_run,
    find_step,
)
from mr_damper_ros.campaign.folder import CampaignTask, read_task
from mr_damper_ros.campaign.goal_options import GoalOptions, MachineOptions
from mr_damper_ros.campaign.report import write_campaign_report
from mr_damper_ros.campaign.runs import RunNotFoundError, cut_run, run_as_made, write_signal
from mr_damper_ros.estimation.experiment_design import (
    ForceGoal,
    MachineLimits,
    Plan,
    PlannedRun,
    PlanState,
    first_run,
)
from mr_damper_ros.io.bag_list import find_bags
from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.kinematics.periodic_motion import MotionKind
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL
from mr_damper_ros.processes.exits import FAILED
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tools.console import (
    add_arguments,
    add_json_option,
    add_path,
    program,
    write_json,
)

OUT_OF_REACH = 3
"""Exit code if the goal cannot be reached within the limits of the machine."""

_NEEDED = {
    "peak_velocity": "--velocity",
    "current": "--current",
    "amplitude": "--amplitude",
    "force": "--force",
}
"""Options of the tables that a plan needs; a campaign has them in its folder."""

_MACHINE = ("amplitude", "force", "duration", "heat", "frequency", "sample_rate")

_EPILOG = f"""\
With --keep, the folder holds a campaign. The first call needs the goal and the limits of the
machine, and recommends the first run. Each further call needs only the bags of the new runs, and
recommends the next run. Bags of other runs, steady sines at one current, are also used. The folder
contains campaign.html (the report), set.yaml (the last set), signals/ (the runs as CSV), runs/ and
steps/.

examples:
  mr-damper plan --velocity 0.02 0.2 --current 0 1.5 --amplitude 0.01 --force 5000 bags/today
  mr-damper plan --keep damper_7 --velocity 0.02 0.2 --current 0 1.5 --amplitude 0.01 --force 5000
  mr-damper plan --keep damper_7 bags/today

Exit code: 0: success; {OUT_OF_REACH}: the goal cannot be met within the limits;
{FAILED}: a bag or an option cannot be used.
"""


def _options(parser: argparse.ArgumentParser) -> None:
    known = "bags of the runs so far, or folders of bags; with --keep only the new runs"
    add_path(parser, "bags", "BAG", known, nargs="*")
    add_path(parser, "--signal", "FILE", "write the run as CSV for the machine")
    add_json_option(parser, "the plan")
    add_path(parser, "--keep", "FOLDER", "folder of a campaign to begin or continue")
    parser.add_argument(
        "--runs",
        type=int,
        default=20,
        metavar="N",
        help="largest number of runs of a campaign (default %(default)s)",
    )
    goal, machine = parser.add_argument_group("goal"), parser.add_argument_group("machine")
    flags, needed = {**_NEEDED, "sample_rate": "--rate"}, tuple(_NEEDED)
    aims = ("error", "peak_velocity", "current")
    add_arguments(goal, GoalOptions, aims, flags=flags, without_default=needed)
    add_arguments(machine, MachineOptions, _MACHINE, flags=flags, without_default=needed)
    speed = "Largest peak velocity [m/s] of the machine. Default: that of the goal."
    machine.add_argument("--top-velocity", type=float, metavar="m/s", help=speed)
    current = "Largest current [A] of the machine. Default: that of the goal."
    machine.add_argument("--top-current", type=float, metavar="A", help=current)
    machine.add_argument(
        "--motions",
        nargs="+",
        choices=[kind.value for kind in MotionKind],
        default=[MotionKind.SINE.value],
        help="motions of the machine (default: sine): a sine, a swept sine, random motion",
    )
    machine.add_argument(
        "--manual",
        action="store_true",
        help="an operator sets machine and supply: only sines at a constant current",
    )
    parser.add_argument("--model", choices=tuple(MODELS), default=DEFAULT_MODEL, help="force law")


def _task(options: argparse.Namespace) -> CampaignTask:
    """The goal, the limits of the machine and the law given by the options. Raises ValueError."""
    goal = ForceGoal(options.error, tuple(options.peak_velocity), tuple(options.current))
    top_velocity, top_current = options.top_velocity, options.top_current
    limits = MachineLimits(
        amplitude=options.amplitude,
        peak_velocity=goal.peak_velocity[1] if top_velocity is None else top_velocity,
        force=options.force,
        current=goal.current[1] if top_current is None else top_current,
        duration=options.duration,
        heat=options.heat or math.inf,
        frequency=tuple(options.frequency),
        sample_rate=options.sample_rate,
        steps=not options.manual,
        motions=(MotionKind.SINE,) if options.manual else tuple(options.motions),
    )
    return CampaignTask(goal, limits, options.model)


def _plan(options: argparse.Namespace) -> int:
    missing = [flag for name, flag in _NEEDED.items() if getattr(options, name) is None]
    if options.keep is not None:
        if options.signal is not None or options.json is not None:
            raise ValueError("--signal and --json are for a single plan: omit them with --keep")
        return _continue_campaign(options, missing)
    if missing:
        raise ValueError(f"a plan needs {', '.join(missing)} too")
    task = _task(options)
    plan = advise_run(options.bags, task) if options.bags else None
    run = first_run(task.goal, task.limits) if plan is None else plan.run
    document: dict[str, object] = {"state": "run" if plan is None else plan.state.value}
    if plan is not None:
        _print_accuracy(plan, task.goal)
        if plan.reason:
            print(plan.reason)
        elif plan.runs_left is not None:
            print(f"about {plan.runs_left} more runs are needed")
        document |= {"worst_error": plan.now.worst, "worst_point": plan.now.worst_point}
    if run is not None:
        print(f"run {run.sentence}")
        document |= {"run": asdict(run)}
        if options.signal is not None:
            write_signal(run, options.signal, task.limits.sample_rate)
            print(f"signal: {options.signal}")
    write_json(options, document)
    return OUT_OF_REACH if plan is not None and plan.state is PlanState.OUT_OF_REACH else 0


def _print_accuracy(plan: Plan, goal: ForceGoal) -> None:
    speed, current = plan.now.worst_point
    print(
        f"the force is known to {plan.now.sentence}; the goal is {goal.error:.2%}; the force is "
        f"least accurate at {speed:.3g} m/s and {current:.3g} A"
    )


def _continue_campaign(options: argparse.Namespace, missing: Sequence[str]) -> int:
    if len(missing) == len(_NEEDED) and (options.keep / "campaign.json").exists():
        task = read_task(options.keep)
    elif missing:
        raise ValueError(f"a new campaign needs {', '.join(missing)} too")
    else:
        task = _task(options)
    # All recordings of the bags, the oldest first.
    waiting = [recording for path in find_bags(options.bags) for recording in read_bag(path)]
    waiting.sort(key=lambda recording: recording.start_ns)
    with closing(CampaignCourse(task, folder=options.keep, most_runs=options.runs)) as course:
        _process_recordings(course, waiting)
    if course.steps:
        _print_accuracy(course.steps[-1].plan, task.goal)
        print(f"report: {write_campaign_report(options.keep, course.reason)}")
    run = course.next_run
    if run is not None:
        if course.steps and course.steps[-1].plan.reason:
            print(course.steps[-1].plan.reason)
        print(f"run {course.number}: {run.sentence}")
        signal = options.keep / "signals" / f"run_{course.number:03d}.csv"
        write_signal(run, signal, task.limits.sample_rate)
        print(f"signal: {signal}")
        return 0
    print(course.reason)
    if course.outcome is CampaignOutcome.FAILED:
        return FAILED
    return OUT_OF_REACH if course.outcome is CampaignOutcome.OUT_OF_REACH else 0


def _process_recordings(course: CampaignCourse, waiting: Sequence[Recording]) -> None:
    """Identify from the runs so far, and add waiting recordings that are new to the campaign."""
    remaining = [
        one
        for one in waiting
        if not any(
            one.start_ns <= kept.start_ns < one.stamp_ns(one.sample_count)
            for _, kept in course.runs
        )
    ]
    while course.outcome is None:
        if course.work is not None:
            course.add_step(find_step(*course.work))
        elif course.next_run is None or not remaining:
            return
        else:
            _add_recording(course, course.next_run, remaining.pop(0))


def _add_recording(course: CampaignCourse, run: PlannedRun, recording: Recording) -> None:
    try:
        refusal = course.add_recording(cut_run(run, recording))
    except RunNotFoundError as missing:
        try:
            made = run_as_made(recording)
        except RunNotFoundError as unsteady:
            refusal = f"{missing}, and {unsteady}"
        else:
            print(f"{missing}; it is added as an unplanned run: {made.sentence}")
            refusal = fault_of_run(made, recording) or course.add_recording(recording, made)
    if refusal:
        print(f"run {course.number} is rejected: {refusal}")


main = program("mr-damper plan", __doc__, _options, _plan, _EPILOG)
