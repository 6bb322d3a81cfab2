"""The force law equals the thesis' routine, never overflows, and has correct derivatives."""

import math
import warnings

import known
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from mr_damper_ros.models import published as thesis
from mr_damper_ros.models.published import (
    LITERATURE,
    THESIS_28_CELSIUS,
    THESIS_71_CELSIUS,
    Condition,
)
from mr_damper_ros.models.sigmoid.law import (
    COEFFICIENT_NAMES,
    PARAMETER_NAMES,
    SCALE_PARAMETER_NAMES,
    operating_point_coefficients,
    sine_force,
)
from mr_damper_ros.signals.arrays import Array

ROUNDING = 1e-9
"""Relative: rounding of the routine against the law."""

ROWS = [(c, m) for c in thesis.CONDITIONS for m in thesis.PUBLISHED_METHODS]
ROW_IDS = [f"{c.name}-{m}" for c, m in ROWS]


def cycle(condition: Condition, samples: int = 240) -> tuple[Array, Array, Array]:
    """One cycle of a condition: displacement, velocity, acceleration."""
    angle = 2.0 * np.pi * (np.arange(samples) + 0.25) / samples
    omega = 2.0 * np.pi * condition.frequency
    u = condition.amplitude * np.sin(angle)
    return u, omega * condition.amplitude * np.cos(angle), -(omega**2) * u


def routine(x: Array, d: Array, v: Array, a: Array, i_ref: float) -> Array:
    """``mrf_sigmoid`` of appendix D, line by line; overflow gives the results of MATLAB."""

    def exp(exponent: float) -> float:
        try:
            return math.exp(exponent)
        except OverflowError:
            return math.inf

    def ratio(numerator: float, denominator: float) -> float:
        return math.nan if math.isinf(denominator) else numerator / denominator

    f0, i0, i1, a0, a1, a2, a3, a4, k0, k1c, k1e, k2, k3, k4, k5, k6 = (float(p) for p in x)
    fd = np.zeros(d.size)
    for i in range(d.size):
        vm = math.sqrt(max(v[i] * v[i] - a[i] * d[i], 0.0))
        alph = a0 / (1.0 + k0 * vm)
        kve = k1e * exp(-a4 * vm)
        kvc = k1c * exp(-a4 * vm)
        const21 = k2 / (1.0 + exp(-a2 * (i_ref + i0)))
        const22 = k2 / (1.0 + exp(-a2 * i0))
        const31 = k3 / (1.0 + exp(-a3 * (i_ref + i1)))
        const32 = k3 / (1.0 + exp(-a3 * i1))
        vd = k6 * vm
        vh = float(np.sign(a[i])) * k4 * vm * (1.0 + const31 - const32)
        ft = f0 * (1.0 + exp(a1 * vm)) * (1.0 + const21 - const22)
        offset = k5 * ft
        z = alph * (v[i] + vh + vd)
        aux = ft * ratio(1.0 - exp(-z), 1.0 + exp(-z)) - offset
        if v[i] >= 0.0:
            fd[i] = aux * (1.0 + kvc * abs(v[i]))
        else:
            fd[i] = aux * (1.0 + kve * abs(v[i]))
    return fd


@pytest.mark.parametrize(("condition", "method"), ROWS, ids=ROW_IDS)
def test_the_law_is_the_routine(condition: Condition, method: str) -> None:
    x = thesis.parameters(condition, method)
    kinematics = cycle(condition)
    expected = routine(x, *kinematics, condition.current)
    assert np.all(np.isfinite(expected)), "the routine itself overflows: no reference"
    difference = sine_force(x, *kinematics, condition.current) - expected
    assert np.max(np.abs(difference)) <= ROUNDING * np.max(np.abs(expected))


@pytest.mark.parametrize("current", [0.0, 0.7, -0.3])
@pytest.mark.parametrize("values", [LITERATURE, THESIS_28_CELSIUS, THESIS_71_CELSIUS])
def test_the_law_is_the_routine_for_the_other_sets_and_any_motion(
    values: Array, current: float
) -> None:
    rng = np.random.default_rng(3)
    u, v, a = rng.normal(0.0, (5e-3, 0.05, 1.0), (200, 3)).T
    # Points without velocity, without acceleration, and without either.
    v[:3], a[2:5], u[2] = 0.0, 0.0, 0.0
    expected = routine(values, u, v, a, current)
    # With the literature's set the routine overflows at small peak velocities.
    valid = np.isfinite(expected)
    assert valid.sum() > 150
    np.testing.assert_allclose(
        sine_force(values, u, v, a, current)[valid], expected[valid], rtol=ROUNDING, atol=ROUNDING
    )


def test_where_the_routine_overflows_the_law_saturates() -> None:
    x = LITERATURE.copy()
    x[known.index("a0")] = 1e9
    u, v, a = np.array([0.0]), np.array([-0.1]), np.array([0.0])
    assert np.isnan(routine(x, u, v, a, 0.0)).all(), "the routine no longer shows the fault"
    c = operating_point_coefficients(x, 0.1, 0.0)
    expected = (-c.f_t - c.f_d) * (1.0 + 0.1 * c.k_e)
    np.testing.assert_allclose(sine_force(x, u, v, a, 0.0), expected, rtol=ROUNDING)


ANY = st.floats(allow_nan=False, allow_infinity=False)
HUGE = float(np.finfo(float).max)
TINY = float(np.finfo(float).tiny)
HARD = st.one_of(ANY, st.sampled_from([0.0, -0.0, 1.0, -1.0, HUGE, -HUGE, TINY, -TINY, 5e-324]))


@known.fixed(200)
@given(st.lists(HARD, min_size=16, max_size=16), st.lists(HARD, min_size=4, max_size=4))
@example([HUGE] * 16, [HUGE] * 4)
@example([-HUGE] * 16, [HUGE] * 4)
@example([0.0, HUGE, HUGE, *[0.0] * 13], [0.0, 0.1, 0.0, HUGE])
def test_finite_inputs_give_a_finite_force_without_a_warning(
    values: list[float], inputs: list[float]
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = sine_force(np.array(values), *inputs)
    assert np.all(np.isfinite(result)), "not finite"


def test_a_set_of_another_length_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"length 16 \(the shape is \(15,\)\).*f0, I0, I1"):
        sine_force(np.zeros(15), 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("scale", SCALE_PARAMETER_NAMES)
def test_each_scale_parameter_scales_its_coefficient_alone(scale: str) -> None:
    values = known.PLAUSIBLE.copy()
    before = np.concatenate(operating_point_coefficients(values, 0.1, 1.0))
    values[known.index(scale)] *= 2.0
    ratio = np.concatenate(operating_point_coefficients(values, 0.1, 1.0)) / before
    expected = np.ones(7)
    expected[SCALE_PARAMETER_NAMES.index(scale)] = 2.0
    if scale == "f0":
        expected[COEFFICIENT_NAMES.index("f_d")] = 2.0
    np.testing.assert_allclose(ratio, expected, rtol=ROUNDING)


# -- derivatives -----------------------------------------------------------------------------


def assert_columns_agree(analytic: Array, numeric: Array, names: tuple[str, ...]) -> None:
    assert analytic.shape == numeric.shape
    for column, name in enumerate(names):
        exact, found = analytic[..., column], numeric[..., column]
        size = max(float(np.max(np.abs(exact))), float(np.max(np.abs(found))))
        error = float(np.max(np.abs(exact - found)))
        # Agreement of analytic and numeric derivatives, relative to the largest of a column.
        assert error <= 1e-5 * size + 1e-5, f"derivative by {name}: off by {error:g}"


def numeric_derivatives(function: object, x: Array) -> Array:
    """Central differences with one step of Richardson extrapolation, last axis by x."""
    columns = []
    for place in range(x.size):
        estimates = []
        for step in (4e-6, 2e-6):
            h = step * max(abs(float(x[place])), 1e-2)
            ahead, behind = x.copy(), x.copy()
            ahead[place] += h
            behind[place] -= h
            estimates.append((function(ahead) - function(behind)) / (2.0 * h))  # type: ignore[operator]
        columns.append((4.0 * estimates[1] - estimates[0]) / 3.0)
    return np.stack(columns, axis=-1)


@known.fixed(25)
@given(
    st.tuples(*[st.floats(0.3, 3.0)] * 16),
    st.lists(st.booleans(), min_size=16, max_size=16),
    st.integers(0, 2**31),
)
def test_derivatives_around_a_plausible_damper(
    factors: tuple[float, ...], flips: list[bool], seed: int
) -> None:
    signs = np.where(flips, -1.0, 1.0)
    # 1 + k0 v must stay away from its pole, which no damper reaches.
    signs[known.index("k0")] = 1.0
    values = known.PLAUSIBLE * np.array(factors) * signs
    rng = np.random.default_rng(seed)
    u, v, a = rng.normal(0.0, (5e-3, 0.05, 1.0), (40, 3)).T
    current = rng.uniform(0.0, 1.5, 40)
    numeric = numeric_derivatives(lambda p: sine_force(p, u, v, a, current), values)
    assert_columns_agree(
        known.parameter_jacobian(values, u, v, a, current), numeric, PARAMETER_NAMES
    )


@pytest.mark.parametrize(
    ("values", "top", "bottom", "published"),
    [(THESIS_28_CELSIUS, 1352, -1235, 1332), (THESIS_71_CELSIUS, 994, -970, 989)],
    ids=["28C", "71C"],
)
def test_peaks_of_the_temperature_sets(
    values: Array, top: int, bottom: int, published: int
) -> None:
    run = known.run(values, amplitude=5e-3, frequency=1.0, current=1.5, seed=None)
    assert round(run.clean.max()) == top
    assert round(run.clean.min()) == bottom
    # The sets of the temperature tables have two decimals, which limits the peaks to 2 %.
    assert run.clean.max() == pytest.approx(published, rel=0.02)
