"""A campaign on disk: its task, every run as a bag, and the result of each step.

Bags and steps are written atomically, so finished steps are not repeated even after a crash.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mr_damper_ros.estimation.experiment_design import (
    ForceGoal,
    MachineLimits,
    Plan,
    PlannedRun,
    PlanState,
    PointErrors,
)
from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.io.bag_writer import write_bag
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.files import FolderLock, json_ready, write_text
from mr_damper_ros.signals.recording import Recording

_RUN = "planned_run"
"""Metadata key of a bag for the planned run."""

MadeRun = tuple[PlannedRun, Recording]
"""A run and its recording."""


@dataclass(frozen=True, eq=False)
class CampaignStep:
    """A finished run, the set identified from all runs up to it, and the next plan."""

    run: PlannedRun
    parameter_set: ParameterSet
    plan: Plan


@dataclass(frozen=True)
class CampaignTask:
    """Goal, limits and law of a campaign."""

    goal: ForceGoal
    limits: MachineLimits
    model: str


def claim_folder(path: Path, task: CampaignTask) -> FolderLock:
    """Lock the folder of a campaign for one program; a new folder receives the task.

    ``campaign.json`` contains the task, ``runs/`` the bags of all runs (also of rejected ones),
    ``steps/`` the result after each run, and ``set.yaml`` the last set.

    Raises ValueError if another program uses the folder or it holds another campaign, and OSError.
    """
    lock = FolderLock(path / ".lock")
    try:
        _check_task(path, task)
    except BaseException:
        lock.release()
        raise
    return lock


def _check_task(folder: Path, task: CampaignTask) -> None:
    path = folder / "campaign.json"
    if not path.exists():
        write_text(path, json.dumps(json_ready(asdict(task)), indent=2) + "\n")
        return
    before = read_task(folder)
    # Finished runs stay valid if the permitted motions change.
    before = replace(before, limits=replace(before.limits, motions=task.limits.motions))
    for part in ("goal", "limits", "model"):
        if getattr(before, part) != getattr(task, part):
            raise ValueError(
                f"{folder} holds a campaign with another {part}: choose another folder, or give "
                f"the same {part} as before"
            )


def keep_step(folder: Path, number: int, step: CampaignStep) -> None:
    """Write the result after a run atomically. Raises OSError."""
    write_text(_step_path(folder, number), json.dumps(_document(step), allow_nan=False) + "\n")
    step.parameter_set.save(folder / "set.yaml")


def keep_run(
    folder: Path, number: int, run: PlannedRun, recording: Recording, refusal: str
) -> None:
    """Write a run as a bag, once; a rejected run has another name, and contains the reason."""
    name = f"refused_{number:03d}_{recording.start_ns}" if refusal else f"run_{number:03d}"
    path = folder / "runs" / name
    if path.exists():
        return
    what = f"run {number} of a campaign" + (f", rejected: {refusal}" if refusal else "")
    source = recording.details.get("provenance", "")
    details = {
        **recording.details,
        "provenance": f"{what}: {run.sentence}" + (f"; {source}" if source else ""),
        _RUN: json.dumps(json_ready(asdict(run))),
    }
    write_bag(path, replace(recording, name=name, details=details))


def read_task(folder: Path) -> CampaignTask:
    """The task of the campaign in a folder. Raises ValueError."""
    path = folder / "campaign.json"
    if not path.is_file():
        raise ValueError(f"{folder} holds no campaign: there is no campaign.json")
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        goal, limits = found["goal"], found["limits"]
        for name in ("peak_velocity", "current"):
            goal[name] = tuple(goal[name])
        limits["frequency"] = tuple(limits["frequency"])
        limits["heat"] = math.inf if limits["heat"] is None else limits["heat"]
        return CampaignTask(ForceGoal(**goal), MachineLimits(**limits), found["model"])
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{path} is damaged: choose another folder ({error})") from error


def read_campaign_runs(folder: Path) -> list[MadeRun]:
    """The runs of a campaign in order. Raises ValueError if one is damaged."""
    numbers = sorted(
        int(found[1])
        for path in (folder / "runs").glob("run_*")
        if (found := re.fullmatch(r"run_(\d{3,})", path.name))
    )
    if numbers != list(range(1, len(numbers) + 1)):
        raise ValueError(f"a run is missing in {folder / 'runs'}: it contains the runs {numbers}")
    return [_read_run(folder / "runs" / f"run_{number:03d}") for number in numbers]


def _read_run(path: Path) -> MadeRun:
    recordings = read_bag(path)
    try:
        (recording,) = recordings
        return PlannedRun.from_document(json.loads(recording.details[_RUN])), recording
    except (KeyError, ValueError, TypeError) as error:
        raise ValueError(f"{path} is not a run of a campaign: move it elsewhere") from error


def read_steps(folder: Path) -> list[CampaignStep]:
    """Results after each run in order, up to the first missing one."""
    steps: list[CampaignStep] = []
    task = read_task(folder)
    while (path := _step_path(folder, len(steps) + 1)).is_file():
        try:
            steps.append(_step(json.loads(path.read_text(encoding="utf-8")), task.goal))
        except (ValueError, TypeError, KeyError) as error:
            raise ValueError(
                f"{path} is damaged: remove it, and it is computed again ({error})"
            ) from error
    return steps


def _step_path(folder: Path, number: int) -> Path:
    return folder / "steps" / f"step_{number:03d}.json"


def _document(step: CampaignStep) -> dict[str, Any]:
    plan = step.plan
    return {
        "run": asdict(step.run),
        "parameter_set": step.parameter_set.to_yaml(),
        "plan": {
            "state": plan.state.value,
            "errors": json_ready(plan.now.errors.tolist()),
            "worst": json_ready(plan.now.worst),
            "bound": json_ready(plan.now.bound),
            "run": None if plan.run is None else asdict(plan.run),
            "expected": json_ready(plan.expected),
            "runs_left": plan.runs_left,
            "reason": plan.reason,
        },
    }


def _step(document: dict[str, Any], goal: ForceGoal) -> CampaignStep:
    found = document["plan"]
    errors = np.array([math.nan if e is None else e for e in found["errors"]], dtype=float)
    points = goal.points
    if errors.shape != (len(points),):
        raise ValueError("its errors belong to another goal")
    plan = Plan(
        PlanState(found["state"]),
        PointErrors(points, errors, _read(found["worst"]), _read(found.get("bound"))),
        None if found["run"] is None else PlannedRun.from_document(found["run"]),
        _read(found["expected"]),
        found["runs_left"],
        found["reason"],
    )
    return CampaignStep(
        PlannedRun.from_document(document["run"]),
        ParameterSet.from_yaml(document["parameter_set"]),
        plan,
    )


def _read(value: float | None) -> float:
    return math.nan if value is None else value
