"""A campaign of three fixed runs, planned independently of the results, for tests."""

import known
import numpy as np
import pytest

from mr_damper_ros.campaign import course
from mr_damper_ros.campaign.folder import CampaignTask
from mr_damper_ros.campaign.runs import signal
from mr_damper_ros.emulation.emulator import (
    CurrentSchedule,
    EmulatedDamper,
    EmulatedRig,
    RigSettings,
)
from mr_damper_ros.emulation.motions import SampledMotion
from mr_damper_ros.estimation.experiment_design import (
    ForceGoal,
    MachineLimits,
    Plan,
    PlannedRun,
    PlanState,
    PointErrors,
)
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.recording import Recording

GOAL = ForceGoal(0.06, (0.02, 0.2), (0.0, 1.5), speeds=3, currents=4)
LIMITS = MachineLimits(0.01, 0.2, 5000.0, 1.5, 2.0, sample_rate=500.0)
TASK = CampaignTask(GOAL, LIMITS, "sigmoid")
RUNS = [
    PlannedRun(0.01, 1.0, (0.0, 0.75), 2.0),
    PlannedRun(0.01, 2.0, (1.5,), 2.0),
    PlannedRun(0.005, 3.0, (0.5,), 2.0),
]
"""Runs that the plan of these tests requests, independently of the results."""


def perform(
    run: PlannedRun, seed: int = 0, *, noise: float = 25.0, rate: float = 500.0
) -> Recording:
    """Recording of a run on an emulated rig."""
    times = [place * run.stretch for place in range(len(run.currents))]
    rig = EmulatedRig(
        EmulatedDamper(known.PLAUSIBLE),
        run.motion,
        CurrentSchedule(times, run.currents),
        settings=RigSettings(sample_rate=rate, force_noise=noise, seed=seed),
    )
    return rig.record(run.duration)


def _plan_of(count: int, goal: ForceGoal) -> Plan:
    now = PointErrors(goal.points, np.full(len(goal.points), 0.1 / count), 0.2 / count)
    if count == len(RUNS):
        return Plan(PlanState.MET, now, reason="the goal is met")
    return Plan(PlanState.RUN, now, RUNS[count], 0.1, 2)


def played(run: PlannedRun) -> Recording:
    """Recording of the signal file of a run, with rest before and after it."""
    _, displacement, current = signal(run, 500.0)
    rest = np.zeros(700)
    motion = SampledMotion(np.concatenate([rest, displacement, rest]), 2e-3)
    amperes = np.concatenate([rest + current[0], current, rest])
    times = np.flatnonzero(np.diff(amperes, prepend=np.nan) != 0.0)
    rig = EmulatedRig(
        EmulatedDamper(known.PLAUSIBLE),
        motion,
        CurrentSchedule((times * 2e-3).tolist(), amperes[times].tolist()),
        settings=RigSettings(sample_rate=500.0, force_noise=5.0),
    )
    return rig.record(amperes.size * 2e-3)


def plan_quickly(patch: pytest.MonkeyPatch, goal: ForceGoal = GOAL) -> list[int]:
    """Planner that identifies nothing; it keeps the numbers of windows it was called with."""
    asked: list[int] = []

    def planned(_: object, windows: list[object], *__: object) -> tuple[ParameterSet, Plan]:
        asked.append(len(windows))
        # The first run has two windows.
        made = max(len(windows) - 1, 1)
        return ParameterSet(known.PLAUSIBLE, set_id="quick"), _plan_of(made, goal)

    patch.setattr(course, "planned", planned)
    patch.setattr(course, "planner_of", lambda _: object())
    patch.setattr(course, "first_run", lambda *_: RUNS[0])
    return asked
