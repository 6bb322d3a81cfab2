"""A set is replaced only if the new one is significantly better."""

import math
from dataclasses import replace

import known
import numpy as np
import pytest

from mr_damper_ros.emulation.emulator import scaled
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.quantities import GOOD_NRMSE
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.acceptance import evidence_of, lead_of, rival_wins, validation_mask

N = 1000

CHANCE = 0.15
"""Three standard errors of the mean lead, plus two of its standard deviation."""


def lead(memory: float, seed: int, ahead: float) -> float:
    """Lead of a new force over an old one 0.1 away; the truth lies ``ahead`` of the middle."""
    loop = np.sin(np.arange(N) / 80.0)
    old, new = 100.0 * loop, 100.1 * loop
    measured = 0.5 * (old + new) + ahead * (new - old) + known.correlated_noise(N, memory, seed)
    judges = validation_mask(N)
    return lead_of([(old, new, measured, judges)])


@pytest.mark.parametrize("memory", [0.0, 0.8, 0.95])
def test_a_lead_by_chance_is_a_normal_number(memory: float) -> None:
    leads = [lead(memory, seed, 0.0) for seed in range(400)]
    assert np.mean(leads) == pytest.approx(0.0, abs=CHANCE)
    assert np.std(leads) == pytest.approx(1.0, abs=CHANCE)


def test_without_noise_the_better_force_is_infinitely_ahead() -> None:
    every = np.ones(N, dtype=bool)
    force = np.sin(np.arange(N) / 80.0)
    assert lead_of([(1.1 * force, force, force, every)]) == math.inf
    assert lead_of([(force, force, force, every)]) == 0.0


@pytest.mark.parametrize("seen", [0, 300, 960])
def test_nothing_is_held_back_of_what_was_seen(seen: int) -> None:
    validation = validation_mask(N, N - seen)
    assert not validation[:seen].any()
    # Every fourth chunk is for validation; the lengths of the chunks differ by one sample.
    assert validation.sum() == pytest.approx((N - seen) / 4, abs=10)


def test_the_running_set_is_judged_by_the_force_that_it_predicts() -> None:
    run = known.run()
    narrow = ParameterSet(known.PLAUSIBLE, peak_velocity_range=(0.0, 0.5 * run.top_speed))
    validation = validation_mask(run.force.size)
    found = ParameterSet(known.PLAUSIBLE)
    evidence = evidence_of(narrow, found, run.window, validation, fresh=run.force.size)
    left = known.rms((narrow.window_force(run.window) - run.force)[validation]) / np.std(run.force)
    assert evidence.nrmse_before == pytest.approx(left)
    assert left > 2.0 * evidence.nrmse_after


def test_a_force_that_does_not_jump_is_judged_as_it_is_predicted() -> None:
    # Where the acceleration reverses within a stroke, the law that jumps changes its branch.
    time = np.arange(N) * known.PERIOD
    displacement = 5e-3 * np.sin(9.0 * time) + 4e-4 * np.sin(60.0 * time)
    found = ParameterSet(known.PLAUSIBLE)
    window = Window.from_samples(displacement, time, 1.0, known.PERIOD)
    forces = [found.window_force(window, gradual=gradual) for gradual in (False, True)]
    for force in forces:
        measured = replace(window, force=force)
        assert found.turns_gradually(measured) == (force is forces[1])
        evidence = evidence_of(found, found, measured, validation_mask(N), fresh=N)
        assert evidence.nrmse_before == pytest.approx(0.0, abs=1e-9)


def loss_of(values: Array, truth: Array = known.PLAUSIBLE) -> float:
    """Loss of a set (16,) fitted at 1 A; at 1.4 A the running set is right if ``truth`` is."""
    run = known.run(scaled(values, 1.0))
    running = ParameterSet(known.PLAUSIBLE, observable=np.ones(16, dtype=bool))
    elsewhere = (known.run(truth, current=1.4, seed=1).window,)
    found, count = ParameterSet(values), run.force.size
    validation = validation_mask(count)
    return evidence_of(
        running, found, run.window, validation, fresh=count, elsewhere=elsewhere
    ).loss


@pytest.mark.parametrize(("current", "counts"), [(1.0, False), (1.4, True)])
def test_the_loss_in_other_motions_counts_for_nothing_once_the_set_is_wrong_here(
    current: float, counts: bool
) -> None:
    other = known.PLAUSIBLE.copy()
    other[known.index("k4")] *= 5.0
    run, elsewhere = known.run(), known.run(other, current=current, seed=1)
    running = ParameterSet(other, observable=np.ones(16, dtype=bool))
    count = run.force.size
    evidence = evidence_of(
        running,
        ParameterSet(known.PLAUSIBLE),
        run.window,
        validation_mask(count),
        fresh=count,
        elsewhere=(elsewhere.window,),
    )
    assert evidence.nrmse_before > GOOD_NRMSE
    assert evidence.loses_elsewhere is counts


def test_a_set_that_is_right_here_alone_loses_elsewhere() -> None:
    blunt = known.PLAUSIBLE.copy()
    blunt[known.index("a0")] *= 0.3
    assert loss_of(blunt) > 0.5
    late = known.PLAUSIBLE.copy()
    late[known.index("k4")] *= 5.0
    assert loss_of(blunt, late) == 0.0, "the running set is not good there"


@pytest.mark.parametrize(("strength", "confirmed"), [(1.9, False), (1.3, True)])
def test_a_window_confirms_no_set_that_predicts_it_poorly(strength: float, confirmed: bool) -> None:
    # The running set is worse in both cases.
    run = known.run()
    rival, running = (ParameterSet(scaled(known.PLAUSIBLE, each)) for each in (strength, 3.0))
    wins = rival_wins(rival, running, run.window, fresh=run.force.size, maximum_nrmse=0.5)
    assert wins is confirmed
