"""Degenerate records: slow ramps, single strokes, forces without noise; no result is lost."""

import math
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import mr_damper_ros as mr
from mr_damper_ros.api import details
from mr_damper_ros.api.measured_runs import measured_run
from mr_damper_ros.campaign.course import planned
from mr_damper_ros.estimation.experiment_design import RunPlanner
from mr_damper_ros.models import MODELS
from mr_damper_ros.tools import identify

PERIOD = 0.02
TIME = PERIOD * np.arange(500)
HALF = TIME[-1] / 2.0
SLOW = 1.7e-4
"""Velocity [m/s] of the slow ramps: 10 mm/min."""
NOISE = np.random.default_rng(5).normal(0.0, 0.5, TIME.size)


def friction(velocity: Any) -> Any:
    return 300.0 * np.tanh(velocity / 5e-4) + 1000.0 * velocity


TRIANGLE = SLOW * (HALF - np.abs(TIME - HALF))
STROKE = 5e-3 * np.sin(np.pi * TIME / TIME[-1])
SINE, SPEED = 5e-3 * np.sin(3.0 * TIME), 15e-3 * np.cos(3.0 * TIME)

RECORDS = {
    "slow ramp": (SLOW * TIME, 400.0 * (1.0 - np.exp(-TIME / 1.5)) + NOISE),
    "one triangle": (TRIANGLE, friction(SLOW * np.sign(HALF - TIME))),
    "half a cycle": (STROKE, friction(np.gradient(STROKE, PERIOD))),
    "square loop": (SINE, 300.0 * np.sign(SPEED)),
    "dashpot": (SINE, 1000.0 * SPEED),
    "rest, then a ramp": (
        np.maximum(SLOW * (TIME - HALF), 0.0),
        np.where(TIME < HALF, 0.0, 300.0) + NOISE,
    ),
}
"""Displacement [m] and force [N] by name; most forces are exact."""


@cache
def identified(name: str, model: str) -> mr.Identification:
    displacement, force = RECORDS[name]
    return mr.identify(
        displacement=displacement,
        force=force,
        current=0.0,
        period=PERIOD,
        model=model,
        accept_doubtful=True,
    )


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(
    ("name", "model"),
    [*product(RECORDS, ("sigmoid", "bingham")), ("slow ramp", "series_springs")],
)
def test_a_degenerate_record_gives_its_result_without_a_warning(name: str, model: str) -> None:
    found = identified(name, model)
    more = found.determination(top_velocity=0.2, top_current=1.5)
    more += found.profile(found.parameter_set.law.parameter_names[0])
    assert "could not be computed" not in str(more)
    assert str(found)
    assert found.document()["parameters"]
    assert np.isfinite(found.force_error(TIME, 2.0 * SINE, 0.0)).all()


def test_a_ramp_has_its_remark() -> None:
    assert "it holds less than a cycle of the motion" in str(identified("slow ramp", "sigmoid"))


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("name", ["slow ramp", "one triangle", "square loop"])
def test_a_plan_from_a_degenerate_record_gives_an_error_of_the_force(name: str) -> None:
    record = mr.Recording(name, 0, PERIOD, *RECORDS[name], np.zeros(TIME.size))
    goal = mr.ForceGoal(0.02, (0.02, 0.2), (0.0, 1.5))
    limits = mr.MachineLimits(0.01, 0.2, 1e5, 1.5, 10.0)
    windows = list(measured_run(record, accept_doubtful=True).windows)
    _, plan = planned(RunPlanner(MODELS["sigmoid"], goal, limits), windows)
    assert not math.isnan(plan.now.worst)


# -- a failure after the search ------------------------------------------------------------------


def test_a_failure_after_the_search_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(*_: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(details, "determined", fails)
    bag, file = Path(__file__).parents[2] / "bags" / "5.0mm_1Hz_1.5A", tmp_path / "set.yaml"
    assert identify.main([str(bag), "--method", "least_squares", "--output", str(file)]) == 0
    said = capsys.readouterr().out
    assert "the determined parameters could not be computed: Singular matrix" in said
    assert "yield force" in said
    assert mr.ParameterSet.load(file).model == "sigmoid"


def test_the_result_is_saved_before_anything_else_is_computed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(details, "determined", interrupted)
    bag, file = Path(__file__).parents[2] / "bags" / "5.0mm_1Hz_1.5A", tmp_path / "set.yaml"
    assert identify.main([str(bag), "--method", "least_squares", "--output", str(file)]) == 130
    assert yaml.safe_load(file.read_text())["model"] == "sigmoid"


def test_a_wrong_name_to_profile_is_refused_before_the_search() -> None:
    displacement, force = RECORDS["dashpot"]
    heard: list[object] = []

    def report(progress: object) -> bool:
        heard.append(progress)
        return True

    with pytest.raises(ValueError, match="no parameter 'alfa'"):
        mr.identify(
            displacement=displacement,
            force=force,
            current=0.0,
            period=PERIOD,
            profile="alfa",
            report=report,
        )
    assert heard == []
