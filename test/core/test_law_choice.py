"""A law is chosen by its predictions for data outside the fit."""

import math
import re
from collections.abc import Sequence

import numpy as np
import pytest

from mr_damper_ros.estimation.differential_evolution import GlobalProgress
from mr_damper_ros.estimation.law_choice import LawChoice, LawTrial, cross_validate, folds
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.quantities import LoopReading
from mr_damper_ros.signals.arrays import Array

PERIOD = 2e-3

CHEAP = ("bingham", "hyperbolic_tangent")


def run(values: Array, model: str, amplitude: float, seed: int = 0, samples: int = 1000) -> Window:
    """Two cycles at 1 Hz and 1 A of a damper that follows a law."""
    time = PERIOD * np.arange(samples)
    displacement = amplitude * np.sin(2.0 * np.pi * time)
    still = Window.from_samples(displacement, displacement, np.ones(samples), PERIOD)
    force = MODELS[model].window_force(still, values)
    # Standard deviation of the force noise [N].
    force = force + np.random.default_rng(seed).normal(0.0, 5.0, samples)
    return Window.from_samples(displacement, force, np.ones(samples), PERIOD)


def damper(model: str) -> Array:
    """Normal parameter values of a law at one current."""
    return MODELS[model].starts(LoopReading(800.0, 300.0, 0.06, 0.01))[0]


def chosen(choice: LawChoice) -> str:
    """The name of the chosen law."""
    assert choice.chosen is not None
    return choice.chosen.model


def trial(model: str, errors: Sequence[float]) -> LawTrial:
    return LawTrial(model, np.array(errors))


def test_motions_are_left_out_with_all_their_runs() -> None:
    values = damper("bingham")
    runs = [[run(values, "bingham", a, seed)] for a in (2e-3, 5e-3, 9e-3) for seed in (0, 1)]
    left_out, parts = folds(runs)
    assert left_out == "motions"
    assert [len(part.training) for part in parts] == [4, 4, 4]
    for part in parts:
        speeds = {round(window.operating_point[0], 3) for window, _ in part.judged}
        assert len(speeds) == 1


def test_nothing_is_judged_on_what_it_was_fitted_to() -> None:
    values = damper("bingham")
    left_out, parts = folds([[run(values, "bingham", 5e-3)]])
    assert left_out == "segments"
    for part in parts:
        ((whole, places),) = part.judged
        trained = np.concatenate([window.force for window in part.training])
        assert not np.isin(whole.force[places], trained).any()
        assert len(trained) + len(whole.force[places]) == whole.sample_count


def test_too_little_to_leave_out_is_refused() -> None:
    short = run(damper("bingham"), "bingham", 5e-3, samples=500)
    with pytest.raises(ValueError, match="needs 5 runs, or at least 600 samples without a gap"):
        folds([[short]])


@pytest.mark.parametrize("truth", ["bingham", "hyperbolic_tangent"])
def test_the_law_of_the_damper_is_chosen(truth: str) -> None:
    values = damper(truth)
    runs = [[run(values, truth, amplitude, samples=500)] for amplitude in (2e-3, 5e-3, 9e-3)]
    choice = cross_validate(runs, CHEAP)
    assert chosen(choice) == truth
    assert "do not show how well a law predicts other motions" in str(choice), "all are sinusoids"


def test_the_simpler_law_is_taken_within_one_standard_error() -> None:
    choice = LawChoice(
        (trial("sigmoid", [0.10, 0.14, 0.12]), trial("bingham", [0.12, 0.13, 0.125])), "motions"
    )
    assert choice.best.model == "sigmoid"
    assert chosen(choice) == "bingham"


def test_a_law_that_cannot_be_fitted_is_told_and_not_taken() -> None:
    choice = LawChoice(
        (trial("sigmoid", [0.1, 0.1, 0.1]), trial("bingham", [math.inf, 0.1, 0.1])), "motions"
    )
    assert chosen(choice) == "sigmoid"
    assert "no fit" in str(choice)


def test_a_comparison_that_is_stopped_during_a_law_chooses_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # A law that is compared within the pause between two reports could not be stopped.
    monkeypatch.setattr("mr_damper_ros.estimation.differential_evolution.LONGEST_PAUSE", 0.0)
    runs = [[run(damper("bingham"), "bingham", amplitude)] for amplitude in (2e-3, 5e-3, 9e-3)]
    laws = ("bingham", "hyperbolic_tangent", "sigmoid")
    choice = cross_validate(runs, laws, report=lambda news: "hyperbolic" not in news.stage)
    assert [trial.model for trial in choice.trials] == ["bingham"]
    assert choice.untried == ("hyperbolic_tangent", "sigmoid")
    assert choice.chosen is None
    said = str(choice)
    assert re.search(r"^sigmoid +not compared$", said, re.MULTILINE)
    assert "NO LAW IS CHOSEN" in said
    assert "The data support" not in said


def test_a_stopped_comparison_says_so() -> None:
    runs = [[run(damper("bingham"), "bingham", amplitude)] for amplitude in (2e-3, 5e-3, 9e-3)]
    heard: list[str] = []

    def report(progress: GlobalProgress) -> bool:
        heard.append(progress.stage)
        return len(heard) < 20

    with pytest.raises(ValueError, match="stopped before the first was finished"):
        cross_validate(runs, ("sigmoid",), report=report)
    assert all(re.fullmatch(r"comparing laws, sigmoid, \d?\d% done", stage) for stage in heard)
