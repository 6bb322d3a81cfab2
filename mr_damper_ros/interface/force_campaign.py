"""From no knowledge to a force that is known well enough: runs are chosen, made and checked."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.force_knowledge import ForceGoal
from mr_damper_ros.estimation.planned_run import MachineLimits, PlannedRun
from mr_damper_ros.estimation.run_planner import RunPlanner
from mr_damper_ros.interface.campaign_course import CampaignCourse, CampaignOutcome, planner_of
from mr_damper_ros.interface.campaign_folder import CampaignFolder, CampaignStep, CampaignTask
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL, ParameterSet
from mr_damper_ros.signals.recording import Recording

Perform = Callable[[PlannedRun], Recording]
"""Makes a run on a machine; the recording begins when the motion is steady, with the first current.
"""


@dataclass(frozen=True, eq=False)
class ForceCampaign:
    """Outcome of :func:`run_campaign`: its steps, and why it ended, in words.

    ``reached``: whether the goal is met.
    """

    steps: tuple[CampaignStep, ...]
    reached: bool
    reason: str

    @property
    def parameter_set(self) -> ParameterSet:
        """What is known of the damper at the end."""
        return self.steps[-1].parameter_set


def run_campaign(
    goal: ForceGoal,
    limits: MachineLimits,
    perform: Perform,
    *,
    model: str = DEFAULT_MODEL,
    most_runs: int = 20,
    evolution: EvolutionSettings | None = None,
    report: Callable[[CampaignStep], bool] | None = None,
    folder: str | os.PathLike[str] | None = None,
) -> ForceCampaign:
    """Choose, make and identify runs until the force is known to the goal, or cannot be.

    ``perform`` makes a run; ``report`` hears of each step, and ends the campaign with False. A run
    whose samples make no sense is made once more. In a ``folder`` every run is kept as a bag, and
    what was found from it; called again with the same goal, it goes on where it was, however it
    ended. Raises ValueError where a run still makes no sense, the goal cannot be meant, the machine
    cannot make the first run, or the folder holds another campaign.
    """
    task = CampaignTask(goal, limits, model)
    planner: RunPlanner | None = None
    kept = None if folder is None else CampaignFolder(Path(folder), task)
    try:
        course = CampaignCourse(task, folder=kept, most_runs=most_runs, evolution=evolution)
        while course.outcome is None:
            if course.work is not None:
                planner = planner or planner_of(task)
                course.conclude(course.work.carry_out(planner))
                if report is not None and not report(course.steps[-1]):
                    course.end("it was ended")
            elif course.next_run is not None:
                course.take(perform(course.next_run))
    finally:
        if kept is not None:
            kept.close()
    if course.outcome is CampaignOutcome.FAILED:
        raise ValueError(course.reason)
    return ForceCampaign(tuple(course.steps), course.outcome is CampaignOutcome.MET, course.reason)
