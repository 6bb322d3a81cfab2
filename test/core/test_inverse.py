"""The inverse of every law for blocks, and for single samples against a scan of the currents."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from known import PLAUSIBLE, controllable, fixed

from mr_damper_ros.control.force_controller import ForceControlSettings
from mr_damper_ros.control.inverse_model import NODES, TOLERANCE, InverseModel
from mr_damper_ros.kinematics.motion import Motion, MotionSample
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import CONDITIONS, PUBLISHED_METHODS, parameters
from mr_damper_ros.models.quantities import State
from mr_damper_ros.signals.arrays import Array

PERIOD = 1e-3

LOWEST, HIGHEST = 0.0, 2.0

ROUNDING = 1e-9
"""[N] for a force of 1 N: rounding, which matters where the current hardly changes the force."""

RNG = np.random.default_rng(5)


def random_motion(count: int, rng: np.random.Generator) -> Motion:
    """Independent samples."""
    velocity = rng.uniform(-0.25, 0.25, count)
    return Motion(
        displacement=rng.normal(0.0, 0.005, count),
        velocity=velocity,
        acceleration=rng.normal(0.0, 5.0, count),
        peak_velocity=np.hypot(velocity, rng.normal(0.0, 0.05, count)),
        sine=None,
    )


def misses(
    force: Array, wanted: Array, least: Array, most: Array, tolerance: float = TOLERANCE
) -> Array:
    """Distance [N] (n,) from the nearest attainable force, less the tolerance."""
    nearest = np.clip(wanted, least, most)
    rounding = ROUNDING * np.maximum(1.0, np.maximum(np.abs(least), np.abs(most)))
    further = np.abs(force - wanted) - np.abs(nearest - wanted)
    return np.asarray(further - tolerance * (most - least) - rounding)


SETS = [parameters(condition, method) for condition in CONDITIONS for method in PUBLISHED_METHODS]


@pytest.mark.parametrize(("first", "block"), [(0, 1475), (17, 25), (34, 1475), (51, 25)], ids=str)
def test_a_hundred_thousand_forces_of_the_published_sets(first, block):
    rng = np.random.default_rng(first)
    for values in SETS[first : first + 17]:
        motion = random_motion(1475, rng)
        inverse = InverseModel(ParameterSet(values), LOWEST, HIGHEST)
        every = np.linspace(LOWEST, HIGHEST, 401)
        law = MODELS["sigmoid"]
        forces = law.current_response(values).forces(MotionSample.each(motion), every, PERIOD, None)
        least, most = forces.min(axis=1), forces.max(axis=1)
        span = most - least
        wanted = rng.uniform(least - 0.3 * span, most + 0.3 * span)
        parts = [slice(place, place + block) for place in range(0, wanted.size, block)]
        found = [inverse.currents(motion.part(part), wanted[part]) for part in parts]
        current = np.concatenate([part.current for part in found])
        assert np.isfinite(current).all()
        assert current.min() >= LOWEST
        assert current.max() <= HIGHEST
        force = law.force(values, motion, current, PERIOD)
        assert misses(force, wanted, least, most).max() <= 0.0
        # [N]; over a smaller span of the force, rounding decides whether it is attainable.
        inside = (wanted > least) & (wanted < most) & (span > 1e-3)
        assert np.concatenate([part.attainable for part in found])[inside].all()


@pytest.mark.parametrize("name", ["sigmoid", "sigmoid_lag"])
def test_the_law_without_jumps_is_inverted_along_a_motion(name):
    chosen = controllable(name)
    inverse = InverseModel(chosen, LOWEST, HIGHEST, gradual_reversal=True)
    time = np.arange(300) * PERIOD
    rate, amplitude = 2.0 * math.pi * 4.0, 5e-3
    motion = Motion(
        displacement=amplitude * np.sin(rate * time),
        velocity=amplitude * rate * np.cos(rate * time),
        acceleration=-amplitude * rate**2 * np.sin(rate * time),
        peak_velocity=np.full(time.size, amplitude * rate),
        sine=None,
    )
    found, _ = inverse.follow(motion, 4000.0 * motion.velocity, PERIOD)
    force = inverse.law.force(inverse.values, motion, found.current, PERIOD)
    np.testing.assert_allclose(force, found.force, rtol=1e-9, atol=ROUNDING)
    got = found.attainable
    assert got.mean() > 0.3
    span = found.most - found.least
    assert np.all(
        np.abs(force - 4000.0 * motion.velocity)[got] <= 2.0 * TOLERANCE * span[got] + ROUNDING
    )


@pytest.mark.parametrize("name", ["series_springs", "bouc_wen", "sigmoid_lag"])
def test_each_of_several_samples_follows_the_same_state(name):
    inverse, motion = InverseModel(controllable(name), LOWEST, HIGHEST), random_motion(3, RNG)
    before, wanted = random_motion(5, RNG), 3000.0 * motion.velocity
    _, state = inverse.law.follow(inverse.values, before, np.full(5, 0.5), PERIOD, None)
    every = [motion.part(slice(place, place + 1)) for place in range(3)]
    alone = [inverse.currents(one, f, state=state) for one, f in zip(every, wanted, strict=True)]
    together = inverse.currents(motion, wanted, state=state)
    np.testing.assert_array_equal(np.array(alone)[:, :, 0].T, together)
    alone = [inverse.force(one, 0.5, state=state) for one in every]
    np.testing.assert_array_equal(np.ravel(alone), inverse.force(motion, 0.5, state=state))


@pytest.mark.parametrize("name", MODELS)
def test_the_slope_is_the_derivative_of_the_force(name):
    rng = np.random.default_rng(5)
    chosen = controllable(name)
    inverse = InverseModel(chosen, LOWEST, HIGHEST)
    motion, current, step = random_motion(1, rng), 0.7, 1e-4
    low, high = (
        chosen.law.follow(inverse.values, motion, np.array([current + side]), PERIOD, None)[0][0]
        for side in (-step, step)
    )
    slope = inverse.slope(motion, current, period=PERIOD)[0]
    # Relative: a difference over 2 µA against the derivative, where the law is smooth.
    assert slope == pytest.approx((high - low) / (2.0 * step), rel=1e-3)


def test_of_several_currents_the_lowest_or_the_nearest_to_the_last():
    # At this motion the force of the thesis' set first rises with the current, then falls.
    values = PLAUSIBLE.copy()
    values[[2, 6, 12, 13]] = [-1.0, 6.0, 4.0, -0.3]
    velocity = np.array([0.06])
    motion = Motion(np.zeros(1), velocity, np.ones(1), np.array([0.12]), None)
    law, every = MODELS["sigmoid"], np.linspace(LOWEST, HIGHEST, 2001)
    force = law.current_response(values).forces(MotionSample.each(motion), every, PERIOD, None)[0]
    top = int(force.argmax())
    assert 0 < top < 2000
    wanted = 0.5 * (force[top] + max(force[0], force[-1]))
    rising, falling = every[top], HIGHEST
    inverse = InverseModel(ParameterSet(values), LOWEST, HIGHEST)
    for last in (None, math.nan, LOWEST):
        found = inverse.currents(motion, wanted, last=last)
        assert found.attainable[0]
        assert found.current[0] < rising
    assert inverse.currents(motion, wanted, last=falling).current[0] > rising


def test_what_saturates_is_not_paid_for_with_current():
    values = PLAUSIBLE.copy()
    values[5] = 30.0
    motion = Motion(np.zeros(1), np.array([0.2]), np.ones(1), np.array([0.2]), None)
    found = InverseModel(ParameterSet(values), LOWEST, HIGHEST).currents(motion, 1e9)
    assert not found.attainable[0]
    assert found.force[0] == pytest.approx(found.most[0], rel=1e-6)
    assert found.current[0] < HIGHEST - 0.1


def test_what_cannot_be_inverted_is_refused():
    for highest in (1.0, math.inf):
        with pytest.raises(ValueError, match="not above the lowest, 1 A: give two finite"):
            InverseModel(ParameterSet(PLAUSIBLE), 1.0, highest)
    inverse = InverseModel(ParameterSet(PLAUSIBLE), LOWEST, HIGHEST)
    motion = random_motion(2, RNG)
    assert not inverse.currents(motion, [1.0, math.nan]).attainable[1]
    nothing = inverse.currents(motion.part(slice(0)), [])
    assert nothing.current[nothing.attainable].size == 0
    assert inverse.force(motion.part(slice(0)), 0.5).size == 0


# -- the coil --------------------------------------------------------------------------------------


def test_no_more_is_commanded_than_the_supply_can():
    settings = ForceControlSettings(highest_current=2.0, slew_rate=50.0)
    assert settings.limited(1.9, 0.0, 0.001) == pytest.approx(0.05)
    assert settings.limited(9.0, 1.99, 0.001) == 2.0
    assert settings.limited(-9.0, 0.02, 0.001) == 0.0


def test_a_set_of_one_current_is_warned_of() -> None:
    with pytest.warns(UserWarning, match=r"identified at 0\.5 A only"):
        InverseModel(ParameterSet(PLAUSIBLE, current_range=(0.49, 0.51)), LOWEST, HIGHEST)


# -- the inverse of one sample against a scan of the currents, through all interfaces --------------


SAME = 1e-9
"""Relative: the same operations in another order."""

SAME_EXTREMUM = 2e-7
"""Of the span: an extremum at a kink is found to a millionth of a cell of the nodes."""


class Asked(NamedTuple):
    """A sample with its predecessor, the desired force and the last current."""

    before: MotionSample
    sample: MotionSample
    supplied: float
    wanted: float
    last: float | None


VELOCITIES = st.floats(-0.4, 0.4)


@st.composite
def samples(draw: st.DrawFn) -> MotionSample:
    """A sample of any motion that a test machine can make."""
    velocity = draw(VELOCITIES)
    return MotionSample(
        draw(st.floats(-0.02, 0.02)),
        velocity,
        draw(st.floats(-20.0, 20.0)),
        math.hypot(velocity, draw(VELOCITIES)),
    )


@st.composite
def questions(draw: st.DrawFn) -> Asked:
    """A desired force that is attainable, not attainable or NaN; a last current in or out of range.

    Half the samples follow the one before closely, so that the branch is between its ends.
    """
    before, sample = draw(samples()), draw(samples())
    if draw(st.booleans()):
        sample = before.moved_on(PERIOD)
    return Asked(
        before,
        sample,
        draw(st.floats(LOWEST, HIGHEST)),
        draw(st.floats(-4000.0, 4000.0) | st.sampled_from((math.nan, math.inf, -1e12))),
        draw(st.none() | st.floats(LOWEST - 0.5, HIGHEST + 0.5)),
    )


def motion_of(sample: MotionSample) -> Motion:
    return Motion(*map(np.atleast_1d, sample), sine=None)


def scaled(name: str, scales: list[float]) -> ParameterSet:
    """A damper of the law with other parameters, within their bounds."""
    known = controllable(name)
    values = known.values * np.resize(scales, known.values.size)
    return ParameterSet(np.clip(values, *MODELS[name].bounds), model=name)


def state_after(inverse: InverseModel, asked: Asked) -> State:
    _, state = inverse.law.follow(
        inverse.values, motion_of(asked.before), np.array([asked.supplied]), PERIOD, None
    )
    return state


SCALES = st.lists(st.floats(0.2, 3.0), min_size=5, max_size=5)

LAWS = [(name, True) for name in MODELS] + [
    (name, False) for name, law in MODELS.items() if law.continuous is not law
]
"""Each law, with and without its jumps if it has any."""


@pytest.mark.parametrize(("name", "gradual"), LAWS)
def test_the_current_gives_the_nearest_force_of_a_scan(name: str, gradual: bool) -> None:
    @fixed(10)
    @given(questions(), SCALES)
    def check(asked: Asked, scales: list[float]) -> None:
        inverse = InverseModel(scaled(name, scales), LOWEST, HIGHEST, gradual_reversal=gradual)
        state = state_after(inverse, asked)
        motion = motion_of(asked.sample)
        scan = np.linspace(LOWEST, HIGHEST, 2001)
        forces = inverse.law.current_response(inverse.values).forces(
            MotionSample.each(motion), scan, PERIOD, state
        )[0]
        found = inverse.currents(motion, asked.wanted, last=asked.last, period=PERIOD, state=state)
        least, most = float(found.least[0]), float(found.most[0])
        span, size = most - least, max(abs(least), abs(most), 1.0)
        beyond = SAME_EXTREMUM * span + ROUNDING * size
        # An extremum between two nodes matters for desired forces outside the range at the nodes.
        if asked.wanted < least:
            assert least <= forces.min() + beyond
        if asked.wanted > most:
            assert most >= forces.max() - beyond
        if math.isfinite(asked.wanted):
            nearest = min(max(asked.wanted, least), most)
            assert abs(found.force[0] - nearest) <= TOLERANCE * span + ROUNDING * size
        force_at = inverse.at(asked.sample, period=PERIOD, state=state)
        one = inverse.current(asked.sample, asked.wanted, asked.last, period=PERIOD, state=state)
        current, force, attainable = found.current[0], found.force[0], bool(found.attainable[0])
        assert one.attainable == attainable
        # Of the span: scalars and arrays round differently, and each search ends within a tenth of
        # this.
        allowed = (1e-8 if attainable else SAME_EXTREMUM) * span + ROUNDING * size
        assert one.force == pytest.approx(force, abs=allowed)
        between = [force_at(c) for c in np.linspace(one.current, current, 5).tolist()]
        # Of the span: two currents whose forces differ by less are equivalent.
        assert max(between) - min(between) <= 4e-7 * span + ROUNDING * size

    check()


@pytest.mark.parametrize("name", MODELS)
def test_the_force_of_a_sample_is_that_of_the_law(name: str) -> None:
    @fixed(10)
    @given(questions(), SCALES, st.floats(LOWEST, HIGHEST))
    def check(asked: Asked, scales: list[float], current: float) -> None:
        inverse = InverseModel(scaled(name, scales), LOWEST, HIGHEST, gradual_reversal=True)
        state = state_after(inverse, asked)
        force_at = inverse.at(asked.sample, period=PERIOD, state=state)
        force, _ = inverse.law.follow(
            inverse.values, motion_of(asked.sample), np.array([current]), PERIOD, state
        )
        assert force_at(current) == pytest.approx(float(force[0]), rel=SAME, abs=ROUNDING)
        nodes = np.linspace(LOWEST, HIGHEST, NODES)
        arrays = inverse.law.current_response(inverse.values)
        expected = arrays.forces([asked.sample], nodes, PERIOD, state)[0]
        found = list(map(force_at, nodes.tolist()))
        np.testing.assert_allclose(found, expected, rtol=SAME, atol=ROUNDING)

    check()
