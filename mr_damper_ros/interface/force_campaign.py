"""From no knowledge to a force that is known well enough: runs are chosen, made and checked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.force_knowledge import ForceGoal
from mr_damper_ros.estimation.planned_run import MachineLimits, PlannedRun, first_run
from mr_damper_ros.estimation.run_planner import Plan, PlanState, RunPlanner
from mr_damper_ros.interface.measured_runs import measured_run
from mr_damper_ros.interface.run_advice import planned
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL, ParameterSet, known_model
from mr_damper_ros.signals.recording import Recording

Perform = Callable[[PlannedRun], Recording]
"""Makes a run on a machine; the recording begins when the motion is steady, with the first current.
"""

_TRIES = 2
"""A run that cannot be used is made once more."""


@dataclass(frozen=True, eq=False)
class CampaignStep:
    """A run that was made, the set identified from it and all before, and what follows."""

    run: PlannedRun
    parameter_set: ParameterSet
    plan: Plan


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
) -> ForceCampaign:
    """Choose, make and identify runs until the force is known to the goal, or cannot be.

    ``perform`` makes a run; ``report`` hears of each step, and ends the campaign with False. A run
    whose samples make no sense is made once more. Raises ValueError where they still do not, where
    the goal cannot be meant, or the machine cannot make the first run.
    """
    planner = RunPlanner(known_model(model), goal, limits)
    windows: list[Window] = []
    steps: list[CampaignStep] = []
    found: ParameterSet | None = None
    run: PlannedRun | None = first_run(goal, limits)
    reason = f"{most_runs} runs were made, and more were not allowed"
    while run is not None and len(steps) < most_runs:
        windows += _checked(run, perform)
        before = None if found is None else found.values
        found, plan = planned(planner, windows, before, evolution)
        steps.append(CampaignStep(run, found, plan))
        if report is not None and not report(steps[-1]):
            reason = "it was ended"
            break
        run = plan.run if plan.state is PlanState.RUN else None
        reason = plan.reason or reason
    reached = steps[-1].plan.state is PlanState.MET
    return ForceCampaign(tuple(steps), reached, reason)


def _checked(run: PlannedRun, perform: Perform) -> list[Window]:
    for attempt in range(_TRIES):
        recording = perform(run)
        try:
            measured_run(recording)
        except ValueError:
            if attempt == _TRIES - 1:
                raise
        else:
            break
    return run.windows(recording)
