"""``plan_campaign``: a campaign on a machine that a person runs; no ROS is needed."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from mr_damper_ros.campaign.course import (
    CampaignCourse,
    CampaignOutcome,
    fault_of_run,
)
from mr_damper_ros.campaign.folder import CampaignFolder, CampaignTask, read_task
from mr_damper_ros.campaign.report import write_campaign_report
from mr_damper_ros.campaign.runs import RunNotFoundError, cut_run, run_as_made, write_signal
from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.io.recording_list import find_recordings
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tools.campaign_options import (
    OUT_OF_REACH,
    add_campaign_options,
    goal_of,
    limits_of,
    missing_options,
)
from mr_damper_ros.tools.console import FAILED, run_tool

_EPILOG = f"""\
The first call names the goal and the limits of the machine, and says which run to make; each
further call takes the bags of the runs made since, whatever else they hold, and says what comes
next. A bag that does not hold the wanted run, but is a steady sine at one current, counts as well,
also in the first call. Below the folder: campaign.html (the report), set.yaml (the last set),
signals/ (the runs as CSV, for machines that play files), runs/ and steps/.

examples:
  plan_campaign damper_7 --velocity 0.02 0.2 --current 0 1.5 --amplitude 0.01 --force 5000 --manual
  plan_campaign damper_7 bags/today

Exit code: 0, also where the goal is met; {OUT_OF_REACH} where it cannot be met within the limits;
{FAILED} where a bag or an option cannot be used.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    return run_tool(_parser(), _plan_campaign, arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="plan_campaign",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Say run by run what to set on a test machine until the force of a damper is "
        "known\nwell enough, from the bags of the runs made so far.",
        epilog=_EPILOG,
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="where the campaign is kept")
    parser.add_argument(
        "bags", nargs="*", type=Path, metavar="BAG", help="bags, or folders with bags, made since"
    )
    add_campaign_options(parser, required=False)
    parser.add_argument(
        "--runs", type=int, default=20, metavar="N", help="at most (default %(default)s)"
    )
    return parser


def _plan_campaign(options: argparse.Namespace) -> int:
    task = _task(options)
    waiting = _recordings(options.bags)
    folder = CampaignFolder(options.folder, task)
    try:
        course = CampaignCourse(task, folder=folder, most_runs=options.runs)
        _go_on(course, waiting)
    finally:
        folder.close()
    if course.steps:
        plan = course.steps[-1].plan
        speed, current = plan.now.worst_point
        print(
            f"the force is known to {plan.now.sentence}, where {task.goal.error:.2%} is "
            f"wanted; least at {speed:.3g} m/s and {current:.3g} A"
        )
        print(f"report: {write_campaign_report(options.folder, course.reason)}")
    run = course.next_run
    if run is not None:
        print(f"run {course.number}: {run.sentence}")
        signal = options.folder / "signals" / f"run_{course.number:03d}.csv"
        write_signal(run, signal, task.limits.sample_rate)
        print(f"signal: {signal}")
        return 0
    print(course.reason)
    if course.outcome is CampaignOutcome.FAILED:
        return FAILED
    return OUT_OF_REACH if course.outcome is CampaignOutcome.OUT_OF_REACH else 0


def _task(options: argparse.Namespace) -> CampaignTask:
    missing = missing_options(options)
    if len(missing) < 4 or not (options.folder / "campaign.json").exists():
        if missing:
            raise ValueError(f"a new campaign needs {', '.join(missing)} too")
        return CampaignTask(goal_of(options), limits_of(options), options.model)
    return read_task(options.folder)


def _recordings(sources: Sequence[Path]) -> list[Recording]:
    """All recordings of the bags, the oldest first."""
    if not sources:
        return []
    listed, _ = find_recordings(sources)
    found = [recording for entry in listed for recording in read_bag(entry.path)]
    return sorted(found, key=lambda recording: recording.start_ns)


def _go_on(course: CampaignCourse, waiting: Sequence[Recording]) -> None:
    """Find what is to be found, and take the runs that wait; those taken before are left out."""
    waiting = [one for one in waiting if not _taken(course, one)]
    while course.outcome is None:
        if course.work is not None:
            course.conclude(course.work.carry_out())
        elif course.next_run is None or not waiting:
            return
        else:
            recording, waiting = waiting[0], waiting[1:]
            _take(course, recording)


def _take(course: CampaignCourse, recording: Recording) -> None:
    run = course.next_run
    assert run is not None
    refusal = ""
    try:
        refusal = course.take(cut_run(run, recording))
    except RunNotFoundError as missing:
        try:
            made = run_as_made(recording)
        except RunNotFoundError as unsteady:
            refusal = f"{missing}, and {unsteady}"
        else:
            print(f"{missing}; it is taken as a run of its own: {made.sentence}")
            refusal = fault_of_run(made, recording) or course.take(recording, made)
    if refusal:
        print(f"run {course.number} is not taken: {refusal}")


def _taken(course: CampaignCourse, recording: Recording) -> bool:
    """Whether a run was cut out of this recording before."""
    end_ns = recording.stamp_ns(recording.sample_count)
    return any(recording.start_ns <= kept.start_ns < end_ns for _, kept in course.runs)
