"""What the work of a window's task brings home."""

from __future__ import annotations

import pickle
from dataclasses import replace

import known
import numpy as np
import pytest
from random_motion import BandLimitedRandom

from benchmarks.other_dampers import DAMPERS
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.sigmoid.law import sine_force
from mr_damper_ros.tracking import jobs
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.jobs import run
from mr_damper_ros.tracking.tracker import TrackerSettings, WindowTracker
from mr_damper_ros.tracking.window_assembler import RawWindow

SAMPLES = 2000
START = ParameterSet(known.weaker(0.9))


def random_window() -> RawWindow:
    motion = BandLimitedRandom(3e-3, 0.5, 3.0).at(np.arange(SAMPLES) * known.PERIOD)
    current = np.full(SAMPLES, 1.0)
    clean = sine_force(
        known.PLAUSIBLE, motion.displacement, motion.velocity, motion.acceleration, current
    )
    noise = np.random.default_rng(3).normal(0.0, known.NOISE, SAMPLES)
    return RawWindow(known.T0, known.PERIOD, motion.displacement, clean + noise, current)


WINDOWS = {"sine": known.raw_window(known.run(samples=SAMPLES)), "random": random_window()}


@pytest.mark.parametrize("motion", WINDOWS)
def test_an_answer_does_not_bring_the_samples_home_again(motion: str) -> None:
    window = WINDOWS[motion]
    result = run(WindowTracker(TrackerSettings(), START).job_of(window))
    assert result.fit is not None
    samples = window.displacement.nbytes + window.force.nbytes + window.current.nbytes
    # Of every fourth sample the force, the current and the motion: three quarters of this.
    assert len(pickle.dumps(result)) < samples


@pytest.mark.parametrize("model", ["sigmoid", "hyperbolic_tangent"])
def test_what_was_first_found_here_does_not_undo_what_is_known_of_other_currents(
    model: str,
) -> None:
    """The force then is a start to search from; the law over the current is that of now."""
    law, current = MODELS[model], 1.0
    truth = {"sigmoid": known.PLAUSIBLE, "hyperbolic_tangent": DAMPERS["viscous_tanh"].values}[
        model
    ]
    motion = SineMotion(5e-3, 1.0).at(np.arange(SAMPLES) * known.PERIOD)
    noise = np.random.default_rng(3).normal(0.0, known.NOISE, SAMPLES)
    window = Window.from_samples(motion.displacement, np.zeros(SAMPLES), current, known.PERIOD)
    force = law.window_force(window, truth) + noise
    raw = RawWindow(known.T0, known.PERIOD, motion.displacement, force, np.full(SAMPLES, current))
    knows_nothing_else = law.without_dependence(truth, 1.5)
    baseline = fit_window(law, replace(window, force=force), knows_nothing_else)
    weaker = truth.copy()
    weaker[list(law.strength_indices)] *= 0.3
    task = replace(
        WindowTracker(TrackerSettings(model=model), ParameterSet(weaker, model=model)).job_of(raw),
        baselines=(baseline,),
    )
    fit = run(task).fit
    assert fit is not None
    shape = law.places(law.shape_names)
    np.testing.assert_array_equal(fit.parameters[shape], weaker[shape])
    assert fit.rmse < 1.1 * known.NOISE


def failing(*_: object, **__: object) -> None:
    raise np.linalg.LinAlgError("SVD did not converge")


def test_a_failure_of_ours_is_no_fault_of_the_data(monkeypatch: pytest.MonkeyPatch) -> None:
    tracked = WindowTracker(TrackerSettings(), START)
    monkeypatch.setattr(jobs, "fit_window", failing)
    report = tracked.follow(WINDOWS["sine"])
    assert report is not None
    assert report.verdict is Verdict.FAILED
    assert "SVD did not converge" in report.reason


def test_a_search_that_fails_is_no_fault_of_the_data(monkeypatch: pytest.MonkeyPatch) -> None:
    tracked = WindowTracker(TrackerSettings(), START)
    tracked.follow(WINDOWS["sine"])
    monkeypatch.setattr(jobs, "identify_global", failing)
    assert tracked.identify().verdict is Verdict.FAILED
