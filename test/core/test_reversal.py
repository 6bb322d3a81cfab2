"""The branch of the hysteresis at a reversal, and whether the force jumps there."""

from dataclasses import replace

import known
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet, start_set
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.models.sigmoid.following import branch_along
from mr_damper_ros.models.sigmoid.law import operating_point_coefficients
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.model_bank import ModelBank
from mr_damper_ros.tracking.validity import DoubtKind

PERIOD, CURRENT = 1e-3, 1.0


def motion(amplitude: float = 5e-3, frequency: float = 1.0, cycles: float = 2.5) -> Motion:
    time = np.arange(round(cycles / frequency / PERIOD)) * PERIOD
    u, v, a = SineMotion(amplitude, frequency).at(time)
    return Motion(u, v, a, np.full(u.size, 2.0 * np.pi * frequency * amplitude), None)


def forces(model_name: str, sine: Motion) -> tuple[Array, Array]:
    """Force of the law, and of the law without its jumps."""
    model = MODELS[model_name]
    values = known.EXAMPLES[model_name]
    return (
        model.force(values, sine, CURRENT, PERIOD),
        model.continuous.force(values, sine, CURRENT, PERIOD),
    )


def test_it_is_the_law_once_the_velocity_has_come_back() -> None:
    sine = motion()
    exact, gradual = forces("sigmoid", sine)
    v_h = operating_point_coefficients(known.EXAMPLES["sigmoid"], sine.peak_velocity, CURRENT).v_h
    turned = np.abs(np.abs(sine.velocity) - sine.peak_velocity) < 2.5 * np.abs(v_h)
    assert 0.2 < np.mean(turned) < 0.8
    np.testing.assert_allclose(gradual[~turned], exact[~turned], rtol=1e-9)


@pytest.mark.parametrize("model_name", ["sigmoid", "sigmoid_lag"])
def test_there_is_no_jump(model_name: str) -> None:
    # At a slow motion with a wide loop the jump of the law is a large part of its force.
    sine = motion(frequency=0.25, cycles=1.5)
    exact, gradual = forces(model_name, sine)
    turns = np.diff(np.sign(sine.acceleration)) != 0.0
    usual = float(np.abs(np.diff(exact))[~turns].max())
    assert np.abs(np.diff(gradual)).max() < (1.0 + 1e-6) * usual


@settings(deadline=None, max_examples=50)
@given(
    velocity=st.lists(st.floats(-0.1, 0.1), min_size=2, max_size=60),
    half_width=st.floats(-0.05, 0.05),
    cut=st.integers(1, 59),
)
def test_the_branch_is_that_sample_by_sample(
    velocity: list[float], half_width: float, cut: int
) -> None:
    v = np.array(velocity)
    width = np.full(v.size, half_width)
    cut = min(cut, v.size - 1)
    first, state = branch_along(v[:cut], np.ones(cut), width[:cut], None)
    second, _ = branch_along(v[cut:], np.ones(v.size - cut), width[cut:], state)
    branch, expected = 1.0, []
    for before, now in zip([v[0], *v[:-1]], v, strict=True):
        branch = float(np.clip(branch + (now - before) / max(abs(half_width), 1e-9), -1.0, 1.0))
        expected.append(branch)
    np.testing.assert_allclose(np.concatenate((first, second)), expected, atol=1e-7)


# -- several cycles decide whether the force of a damper jumps at reversals ------------------------

CYCLE = 1000
"""Samples per cycle, at 1 kHz."""

SET = ParameterSet(THESIS_28_CELSIUS, set_id="thesis")
RUN = known.run(current=CURRENT, samples=CYCLE, seed=None)
MOTION = Motion(
    RUN.displacement, RUN.velocity, RUN.acceleration, np.full(CYCLE, RUN.top_speed), sine=None
)

SMEARED = 0.65
"""Fraction of the way from the jumping force to the gradual one: nearer to the gradual one."""


def force(*, gradual: bool) -> Array:
    """Force of one cycle of the damper [N]."""
    law = SET.law.continuous if gradual else SET.law
    return law.force(SET.values, MOTION, CURRENT, RUN.period)


JUMPING, GRADUAL = force(gradual=False), force(gradual=True)
INDISTINCT = JUMPING + SMEARED * (GRADUAL - JUMPING)


def looked_at(*cycles: Array) -> list[bool]:
    """After each of these cycles [N]: whether the force is classified as gradual."""
    sets = ModelBank(0.25, gradual=True)
    sets.add(SET, None)
    found = []
    for measured in cycles:
        sets.follow(MOTION, CURRENT, (measured, measured), RUN.period, 0.5)
        sets.with_other_branch_rule()
        found.append(sets.gradual)
    return found


NOISE = 8.0
"""Standard deviation [N]: the jump of 10 N changes the error over a whole cycle by a fifth only."""


@pytest.mark.parametrize("gradual", [False, True])
def test_noise_elsewhere_does_not_hide_whether_the_force_jumps(gradual: bool) -> None:
    noise = NOISE * np.random.default_rng(3).standard_normal((3, CYCLE))
    assert looked_at(*((GRADUAL if gradual else JUMPING) + noise))[-1] == gradual


def test_the_first_identified_set_tells_at_once_and_a_start_set_nothing() -> None:
    sets = ModelBank(0.25, gradual=True)
    sets.add(start_set("sigmoid"), None)
    sets.follow(MOTION, CURRENT, (JUMPING, JUMPING), RUN.period, 0.5)
    assert sets.choice(DoubtKind.NONE, np.inf) is None
    assert sets.gradual
    sets.add(replace(SET, source="nelder_mead"), 1)
    assert sets.choice(DoubtKind.NONE, np.inf) is not None
    assert not sets.gradual


def test_no_sample_is_compared_twice() -> None:
    sets = ModelBank(0.25, gradual=True)
    sets.add(SET, None)
    sets.follow(MOTION, CURRENT, (JUMPING, INDISTINCT), RUN.period, 0.5)
    for _ in range(10):
        assert sets.choice(DoubtKind.NONE, np.inf) is None


def test_a_cycle_tells_whether_the_force_jumps_and_two_that_it_does_so_no_more() -> None:
    # An indistinct cycle does not overrule those that jumped.
    assert looked_at(JUMPING, JUMPING, INDISTINCT, JUMPING) == [False] * 4
    assert looked_at(JUMPING, JUMPING, GRADUAL, GRADUAL)[-1]
