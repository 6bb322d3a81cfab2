"""Springs in series with yield and damper: theory, periods, block sizes, derivatives, memory."""

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_motion import BandLimitedRandom
from test_current_dependence import truth

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.misfit import Misfit, WindowProblem

LAW = MODELS["series_springs"]
PLACE = {name: place for place, name in enumerate(LAW.parameter_names)}
EXAMPLE = known.EXAMPLES["series_springs"]

EXAMPLE_AT_REST = np.zeros(len(LAW.parameters))
"""Without the gas force, and independent of the current."""
EXAMPLE_AT_REST[:6] = EXAMPLE[:6]


@known.fixed(40)
@given(
    period=st.floats(1e-5, 1.0),
    stiffness=st.floats(4.0, 10.0),
    width=st.floats(-5.0, -1.0),
    seed=st.integers(0, 100),
)
def test_no_period_makes_it_ring(period: float, stiffness: float, width: float, seed: int) -> None:
    values = EXAMPLE.copy()
    values[PLACE["k1"]], values[PLACE["w_y"]] = 10.0**stiffness, 10.0**width
    velocity = np.random.default_rng(seed).uniform(-0.2, 0.2, 200)
    motion = Motion(np.zeros(200), velocity, np.zeros(200), np.abs(velocity), None)
    force = LAW.force(values, motion, 0.0, period) - values[PLACE["f0"]]
    # At most the steady force at the largest velocity, plus the overshoot of the second order.
    most = values[PLACE["f_y"]] + values[PLACE["c"]] * 0.2
    assert np.all(np.abs(force) < 1.5 * most)


@pytest.mark.parametrize("current", ["constant", "switched"])
@pytest.mark.parametrize("coil", [0.0, 0.02])
@pytest.mark.parametrize("name", ["series_springs", "bouc_wen"])
def test_the_derivatives_are_those_of_differences(name: str, current: str, coil: float) -> None:
    law = MODELS[name]
    time = np.arange(1500) * 1e-3
    amperes = np.where(time // 0.3 % 2, 1.2, 0.2) if current == "switched" else np.ones(1500)
    displacement = BandLimitedRandom(5e-3, 0.5, 3.0, seed=3).at(time).displacement
    window = Window.from_samples(displacement, np.ones(1500), amperes, 1e-3)
    values = truth(name)
    values[-1] = coil
    pooled = Misfit(law, [window], [1.0])
    every = pooled.jacobian(values)
    problem = WindowProblem(law, window, values)
    settled = problem.settled
    own = problem.jacobian(problem.start)[settled]
    np.testing.assert_allclose(own, every[settled][:, law.places(law.free_in_one_run)])
    for place, parameter in enumerate(law.parameters):
        if parameter.name == law.parameter_names[-1] and coil == 0.0:
            continue  # a lag cannot be less than none
        size = max(abs(float(values[place])), 1e-3 if "A" in parameter.unit else 1e-12)
        step = 1e-5 * size * np.eye(values.size)[place]
        expected = (pooled.residual(values + step) - pooled.residual(values - step)) / (
            2.0 * step[place]
        )
        # Relative to the largest: differences with steps of 1e-5 of a nonlinear law.
        np.testing.assert_allclose(
            every[:, place], expected, atol=1e-4 * max(float(np.abs(expected).max()), 1e-9)
        )


@pytest.mark.parametrize("stiffening", [0.0, 5.0])
def test_only_samples_that_have_forgotten_the_past_count(stiffening: float) -> None:
    values = EXAMPLE.copy()
    for name in ("k1_1", "k2_1"):
        values[PLACE[name]] = stiffening
    time = np.arange(3000) * 1e-3
    current = np.where(time < 0.95, 0.2, 1.2)
    displacement = BandLimitedRandom(5e-3, 0.5, 3.0, seed=5).at(time).displacement
    whole = Window.from_samples(displacement, np.ones(3000), current, 1e-3)
    force = LAW.window_force(whole, values)
    late = Window.from_samples(displacement[1000:], force[1000:], current[1000:], 1e-3)
    settled = LAW.settled(late, values)
    error = LAW.window_force(late, values) - late.force
    assert not settled.all()
    # Relative to the span of the force: the start has decayed to 1 %, at either end.
    assert np.max(np.abs(error[settled])) < 0.02 * np.ptp(late.force)
