"""Runs of the thesis are made from the right rows, and say what they are."""

from __future__ import annotations

import numpy as np
import pytest

from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.models.published import CONDITIONS, find, parameters
from mr_damper_ros.models.sigmoid.law import sine_force
from studies.thesis.published_runs import PHASE, synthesise


def test_a_run_is_the_published_force_with_the_published_noise() -> None:
    condition = find("5.0mm_1Hz_0.5A")
    run = synthesise(condition)
    assert run.sample_count == 7001
    assert run.period == 1e-3
    motion = SineMotion(0.005, 1.0, phase=PHASE).at(run.time)
    residual = run.force - sine_force(parameters(condition), *motion, 0.5)
    # The standard error of a standard deviation from 7001 values is 0.85 %.
    assert np.std(residual) == pytest.approx(5.53, rel=0.03)
    assert np.mean(residual) == pytest.approx(0.0, abs=0.25)
    assert np.std(run.displacement - motion.displacement) == pytest.approx(1e-6, rel=0.03)
    assert set(run.current) == {0.5}


def test_a_run_can_be_made_again_and_every_condition_has_noise_of_its_own() -> None:
    one, same, other_seed = (synthesise(CONDITIONS[0], seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.force, same.force)
    assert not np.array_equal(one.force, other_seed.force)
    noises = []
    for condition in CONDITIONS[:2]:
        run = synthesise(condition)
        motion = SineMotion(condition.amplitude, condition.frequency, phase=PHASE).at(run.time)
        noises.append(run.force - sine_force(parameters(condition), *motion, condition.current))
    assert abs(np.corrcoef(noises)[0, 1]) < 0.1
