"""The reviewed models: formulas, integration, lag, identification of a model's own force."""

import known
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from known import EXAMPLES, PLAUSIBLE, fixed, run
from scipy.integrate import solve_ivp

from mr_damper_ros.kinematics.motion import Motion, window_motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS, force_model
from mr_damper_ros.models.first_order_lag import lagged
from mr_damper_ros.models.sigmoid import window_forces
from mr_damper_ros.models.sigmoid.law import operating_point_coefficients

PERIOD = 1e-3

ROUNDING = 1e-9
"""[N]: different order of summation of forces of a few kilonewtons."""

HALVED = 2.5
"""Smallest ratio of the errors when the step is halved; 4 in the limit, for second order."""


def motion(samples: int = 1000, period: float = PERIOD):
    """A sine that starts at zero acceleration, with its exact derivatives."""
    return run(samples=samples, period=period, phase=0.0, noise=0.0).window.motion


@pytest.mark.parametrize("name", MODELS)
def test_interface(name):
    model, w = MODELS[name], motion()
    values = EXAMPLES[name].copy()
    low, high = model.bounds
    assert len(set(model.parameter_names)) == values.size == low.size
    assert set(model.units) == set(model.parameter_names)
    assert np.all((low <= values) & (values <= high))
    assert model.source
    one = model.force(values, w, 1.0, PERIOD)
    many = model.force(np.stack([values, 1.1 * values]), w, np.full(1000, 1.0), PERIOD)
    assert one.shape == (1000,)
    assert many.shape == (2, 1000)
    np.testing.assert_allclose(many[0], one, rtol=1e-12, atol=ROUNDING)
    assert not np.allclose(many[1], one)
    with pytest.raises(ValueError, match="parameters"):
        model.force(values[:-1], w, 1.0, PERIOD)
    with pytest.raises(ValueError, match="period"):
        model.force(values, w, 1.0, 0.0)


def test_biviscous_is_the_published_six_pieces():
    w = motion(777)
    c_post, c_pre, f_y, v0, f0 = EXAMPLES["nonlinear_biviscous"][:5]
    v1 = (f_y - c_pre * v0) / (c_pre - c_post)
    v2 = (f_y + c_pre * v0) / (c_pre - c_post)
    expected = []
    for v, a in zip(w.velocity, w.acceleration, strict=True):
        rising = a > 0.0
        first, last = (-v1, v2) if rising else (-v2, v1)
        if v <= first:
            expected.append(c_post * v - f_y)
        elif v >= last:
            expected.append(c_post * v + f_y)
        else:
            expected.append(c_pre * (v - v0 if rising else v + v0))
    got = MODELS["nonlinear_biviscous"].force(EXAMPLES["nonlinear_biviscous"], w, 0.0, PERIOD)
    moving = np.abs(w.acceleration) > 1e-9
    np.testing.assert_allclose((got - f0)[moving], np.array(expected)[moving], atol=ROUNDING)


def cut(w, first, last):
    """A range of samples of a motion."""
    return Motion(
        w.displacement[first:last],
        w.velocity[first:last],
        w.acceleration[first:last],
        w.peak_velocity[first:last],
        None,
    )


@pytest.mark.parametrize(
    "model", {id(m): m for law in MODELS.values() for m in (law, law.continuous)}.values()
)
@fixed(10)
@given(st.lists(st.integers(1, 90), min_size=1, max_size=5), st.sampled_from([0.0, 0.02]))
@example([1], 0.02)
def test_the_force_does_not_depend_on_how_the_motion_is_cut_into_blocks(model, sizes, coil):
    w, values = motion(400, 5e-3), EXAMPLES[model.name].copy()
    if model.parameter_names[-1] == "coil_time_constant":
        values[-1] = coil
    # If the current changes within blocks, the lag changes too.
    current = np.where(np.arange(400) // 37 % 2, 0.5, 1.5)
    state, parts, first, place = None, [], 0, 0
    while first < 400:
        last = first + sizes[place % len(sizes)]
        part = cut(w, first, last)
        force, state = model.follow(values, part, current[first:last], 5e-3, state)
        parts.append(force)
        first, place = last, place + 1
    whole = model.force(values, w, current, 5e-3)
    np.testing.assert_allclose(np.concatenate(parts), whole, rtol=0.0, atol=ROUNDING)


AMPLITUDE, OMEGA = 5e-3, 2.0 * np.pi


def u_v(t):
    return AMPLITUDE * np.sin(OMEGA * t), AMPLITUDE * OMEGA * np.cos(OMEGA * t)


def hysteresis_rate(z, w, length, share, power):
    bent = np.abs(z) ** power
    return (w - bent * (share * w + (1.0 - share) * np.abs(w) * np.sign(z))) / length


def reference_bouc_wen(times):
    c0, k0, f0, alpha, *shape = EXAMPLES["bouc_wen"][:7]
    solved = solve_ivp(
        lambda t, z: hysteresis_rate(z, u_v(t)[1], *shape),
        (0.0, times[-1]),
        [0.0],
        t_eval=times,
        rtol=1e-9,
        atol=1e-11,
        max_step=2e-3,
    )
    u, v = u_v(times)
    return c0 * v + k0 * u + f0 + alpha * solved.y[0]


def reference_modified(times):
    c0, k0, c1, k1, f0, alpha, *shape = EXAMPLES["modified_bouc_wen"][:9]

    def inner(t, z, y):
        u, v = u_v(t)
        return (alpha * z + c0 * v + k0 * (u - y)) / (c0 + c1)

    def rates(t, state):
        z, y = state
        dy = inner(t, z, y)
        return [hysteresis_rate(z, u_v(t)[1] - dy, *shape), dy]

    solved = solve_ivp(
        rates,
        (0.0, times[-1]),
        [0.0, 0.0],
        method="LSODA",
        t_eval=times,
        rtol=1e-9,
        atol=1e-12,
        max_step=2e-3,
    )
    return c1 * inner(times, *solved.y) + k1 * u_v(times)[0] + f0


@pytest.mark.parametrize(
    ("name", "reference"),
    [("bouc_wen", reference_bouc_wen), ("modified_bouc_wen", reference_modified)],
)
def test_integration_converges_to_solve_ivp(name, reference):
    model = MODELS[name]
    errors = []
    for period in (2e-3, 1e-3, 5e-4):
        count = round(1.0 / period)
        times = np.arange(count) * period
        w = motion(count, period)
        expected = reference(times)
        got = model.force(EXAMPLES[name], w, 0.0, period)
        errors.append(np.sqrt(np.mean((got - expected) ** 2)) / np.std(expected))
    # RMSE of the integration with steps of 1 ms, relative to the spread of the force.
    assert errors[1] < 2e-3
    assert errors[2] < errors[1] / HALVED < errors[0] / (2.0 * HALVED)


@pytest.mark.parametrize("name", ["bouc_wen", "modified_bouc_wen"])
@pytest.mark.parametrize("length", [1e-6, 1e-5, 1e-3])
def test_integration_is_stable_at_coarse_steps(name, length):
    model = MODELS[name]
    values = EXAMPLES[name].copy()
    values[model.parameter_names.index("yield_length")] = length
    coarse = motion(100, 0.02)
    got = model.force(values, coarse, 0.0, 0.02)
    alpha = values[model.parameter_names.index("alpha")]
    speed = np.max(np.abs(coarse.velocity))
    most = 1.2 * alpha + values[0] * speed + 5e3 * AMPLITUDE + 100.0
    assert np.all(np.abs(got) < most)


def test_the_time_constant_of_the_lag_is_the_compliance_times_the_damping_of_the_sigmoid():
    w = motion(2000)
    compliance, stiffness, offset = EXAMPLES["sigmoid_lag"][16:19]
    plain = MODELS["sigmoid"].force(PLAUSIBLE, w, 1.5, PERIOD)
    got = MODELS["sigmoid_lag"].force(EXAMPLES["sigmoid_lag"], w, 1.5, PERIOD)
    c = operating_point_coefficients(PLAUSIBLE, w.peak_velocity, 1.5)
    velocity = w.velocity + np.sign(w.acceleration) * c.v_h + c.v_d
    damping = c.f_t * np.tanh(0.5 * c.alpha * velocity) / velocity
    expected = lagged(plain, compliance * damping, PERIOD) + stiffness * w.displacement + offset
    np.testing.assert_allclose(got, expected)


@pytest.mark.parametrize("law", known.MODELS)
def test_long_motions_are_followed_in_parts(law: str, monkeypatch: pytest.MonkeyPatch) -> None:
    model, values = known.MODELS[law], known.controllable(law).values
    time = 1e-3 * np.arange(3000)
    motion = window_motion(5e-3 * np.sin(2.0 * np.pi * time * (1.0 + 0.1 * time)), 1e-3)
    current = np.where(time < 1.3, 0.5, 1.0)
    for each in (model, model.continuous):
        whole, _ = each.follow(values, motion, current, 1e-3, None)
        of_window = each.window_force(Window(motion, whole, current, 1e-3), values)
        with monkeypatch.context() as patch:
            for module in (force_model, window_forces):
                patch.setattr(module, "AT_ONCE", 700)
            parts, _ = each.follow(values, motion, current, 1e-3, None)
            of_parts = each.window_force(Window(motion, whole, current, 1e-3), values)
        scale = np.std(whole)
        np.testing.assert_allclose(parts, whole, rtol=0.0, atol=1e-12 * scale)
        np.testing.assert_allclose(of_parts, of_window, rtol=0.0, atol=1e-12 * scale)
