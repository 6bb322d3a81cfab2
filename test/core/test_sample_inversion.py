"""The inverse of one sample against a scan of the currents, by all ways to ask for it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from known import controllable, fixed

from mr_damper_ros.control.inverse_model import NODES, TOLERANCE, InverseModel
from mr_damper_ros.kinematics.motion import MotionSample
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.quantities import State

PERIOD = 1e-3

LOWEST, HIGHEST = 0.0, 2.0

SAME = 1e-9
"""Relative: the same operations, in another order."""

SAME_EXTREMUM = 2e-7
"""Of the span: an extremum that is a kink is found to a millionth of a cell of the nodes."""

ROUNDING = 1e-9
"""[N] for a force of one newton."""


class Asked(NamedTuple):
    """A sample that follows another, and what is wanted of it."""

    before: MotionSample
    sample: MotionSample
    supplied: float
    wanted: float
    last: float | None


VELOCITIES = st.floats(-0.4, 0.4)


@st.composite
def samples(draw: st.DrawFn) -> MotionSample:
    """A sample of any motion that a press can make."""
    velocity = draw(VELOCITIES)
    return MotionSample(
        draw(st.floats(-0.02, 0.02)),
        velocity,
        draw(st.floats(-20.0, 20.0)),
        math.hypot(velocity, draw(VELOCITIES)),
    )


@st.composite
def questions(draw: st.DrawFn) -> Asked:
    """A wanted force that can be had or not, or is no number; a last current within limits or not.

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


def scaled(name: str, scales: list[float]) -> ParameterSet:
    """A damper of the law with other parameters, within their bounds."""
    known = controllable(name)
    values = known.values * np.resize(scales, known.values.size)
    return ParameterSet(np.clip(values, *MODELS[name].bounds), model=name)


def state_after(inverse: InverseModel, asked: Asked) -> State:
    _, state = inverse.law.follow(
        inverse.values, asked.before.motion, np.array([asked.supplied]), PERIOD, None
    )
    return state


SCALES = st.lists(st.floats(0.2, 3.0), min_size=5, max_size=5)

LAWS = [(name, True) for name in MODELS] + [
    (name, False) for name, law in MODELS.items() if law.continuous is not law
]
"""Each law, and whether without its jumps, if it has any."""


@pytest.mark.parametrize(("name", "gradual"), LAWS)
def test_the_current_gives_the_nearest_force_of_a_scan(name: str, gradual: bool) -> None:
    @fixed(10)
    @given(questions(), SCALES)
    def check(asked: Asked, scales: list[float]) -> None:
        inverse = InverseModel(scaled(name, scales), LOWEST, HIGHEST, gradual_reversal=gradual)
        state = state_after(inverse, asked)
        motion = asked.sample.motion
        scan = np.linspace(LOWEST, HIGHEST, 2001)
        forces = inverse.law.current_response(inverse.values).forces(
            MotionSample.each(motion), scan, PERIOD, state
        )[0]
        found = inverse.currents(motion, asked.wanted, last=asked.last, period=PERIOD, state=state)
        least, most = float(found.least[0]), float(found.most[0])
        span, size = most - least, max(abs(least), abs(most), 1.0)
        beyond = SAME_EXTREMUM * span + ROUNDING * size
        # An extremum between two nodes counts where a force beyond those of the nodes is wanted.
        if asked.wanted < least:
            assert least <= forces.min() + beyond
        if asked.wanted > most:
            assert most >= forces.max() - beyond
        if math.isfinite(asked.wanted):
            nearest = min(max(asked.wanted, least), most)
            assert abs(found.force[0] - nearest) <= TOLERANCE * span + ROUNDING * size
        response = inverse.at(asked.sample, period=PERIOD, state=state)
        one = inverse.current(response, asked.wanted, asked.last)
        current, force, attainable = found.current[0], found.force[0], bool(found.attainable[0])
        assert one.attainable == attainable
        # Of the span: scalars and arrays round differently, and each search ends a tenth of that
        # off.
        allowed = (1e-8 if attainable else SAME_EXTREMUM) * span + ROUNDING * size
        assert one.force == pytest.approx(force, abs=allowed)
        between = [response.force(c) for c in np.linspace(one.current, current, 5).tolist()]
        # Of the span: by less a force does not tell two currents apart.
        assert max(between) - min(between) <= 4e-7 * span + ROUNDING * size

    check()


@pytest.mark.parametrize("name", MODELS)
def test_the_force_of_a_sample_is_that_of_the_law(name: str) -> None:
    @fixed(10)
    @given(questions(), SCALES, st.floats(LOWEST, HIGHEST))
    def check(asked: Asked, scales: list[float], current: float) -> None:
        inverse = InverseModel(scaled(name, scales), LOWEST, HIGHEST, gradual_reversal=True)
        state = state_after(inverse, asked)
        response = inverse.at(asked.sample, period=PERIOD, state=state)
        force, _ = inverse.law.follow(
            inverse.values, asked.sample.motion, np.array([current]), PERIOD, state
        )
        assert response.force(current) == pytest.approx(float(force[0]), rel=SAME, abs=ROUNDING)
        nodes = np.linspace(LOWEST, HIGHEST, NODES)
        arrays = inverse.law.current_response(inverse.values)
        np.testing.assert_allclose(
            response.at_nodes(),
            arrays.forces([asked.sample], nodes, PERIOD, state)[0],
            rtol=SAME,
            atol=ROUNDING,
        )

    check()
