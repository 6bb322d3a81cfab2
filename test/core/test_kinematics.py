"""Motion from displacement: sines, any other motion, and streams."""

import functools
import math

import known
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from random_motion import ROUNDED_TRIANGLE, BandLimitedRandom
from scipy.signal import savgol_filter, sawtooth

from mr_damper_ros.kinematics.motion import fit_sine, window_motion
from mr_damper_ros.kinematics.observer import CausalDifferentiator
from mr_damper_ros.signals.arrays import Array

EXACT = 1e-10
"""Relative, or phase in rad: rounding over half a cycle at an offset of a thousand amplitudes."""

PERIOD = 1e-3
TIME = np.arange(2000) * PERIOD


def relative(estimate: Array, truth: Array) -> float:
    return known.rms(estimate - truth) / known.rms(truth)


# -- sine ------------------------------------------------------------------------------------


@pytest.mark.parametrize("cycles", [0.7, 3.3, 1000.37])
def test_a_sine_of_more_samples_than_are_solved_at_once_is_fitted_as_exactly(cycles: float) -> None:
    count = 150_000
    phase = 2.0 * np.pi * cycles * np.arange(count) / count
    fit = fit_sine(0.02 + 5e-3 * np.sin(phase + 1.0), PERIOD)
    assert fit is not None
    assert fit.amplitude == pytest.approx(5e-3, rel=EXACT)
    assert fit.frequency == pytest.approx(cycles / (count * PERIOD), rel=EXACT)
    assert fit.phase == pytest.approx(1.0, abs=1e-8)
    assert fit.residual_rms < 1e-12


@known.fixed(60)
@given(
    cycles=st.floats(0.6, 20.0),
    samples=st.integers(200, 3000),
    log_amplitude=st.floats(-4.0, -1.0),
    phase=st.floats(0.0, 6.283),
    offset=st.floats(-0.1, 0.1),
    log_period=st.floats(-4.0, -2.0),
)
def test_a_sine_is_recovered(
    cycles: float,
    samples: int,
    log_amplitude: float,
    phase: float,
    offset: float,
    log_period: float,
) -> None:
    amplitude, period = 10.0**log_amplitude, 10.0**log_period
    frequency = cycles / (samples * period)
    t = np.arange(samples) * period
    fit = fit_sine(offset + amplitude * np.sin(2.0 * np.pi * frequency * t + phase), period)
    assert fit.amplitude == pytest.approx(amplitude, rel=EXACT, abs=0.0)
    assert fit.frequency == pytest.approx(frequency, rel=EXACT, abs=0.0)
    assert fit.offset == pytest.approx(offset, abs=EXACT * amplitude)
    assert math.remainder(fit.phase - phase, 2.0 * math.pi) == pytest.approx(0.0, abs=EXACT)
    assert fit.residual_rms <= EXACT * amplitude


@pytest.mark.parametrize("frequency", [0.0021, 0.37, 1.2345, 125.0, 480.0])
def test_a_long_sine_is_recovered(frequency: float) -> None:
    count = 400_000
    noise = 5e-6 * np.random.default_rng(0).standard_normal(count)
    u = 1e-3 + 5e-3 * np.sin(2.0 * np.pi * frequency * 1e-3 * np.arange(count) + 1.0)
    fit = fit_sine(u + noise, 1e-3)
    assert fit is not None
    # The phase after the whole record.
    assert abs(fit.frequency - frequency) * 0.4 * count * 2e-3 * np.pi < 1e-4
    assert fit.amplitude == pytest.approx(5e-3, rel=1e-4)
    assert fit.offset == pytest.approx(1e-3, abs=1e-6)
    assert fit.residual_rms == pytest.approx(5e-6, rel=0.05)


def test_the_sine_fit_is_at_the_cramer_rao_bound() -> None:
    amplitude, frequency, noise, n, seeds = 5e-3, 1.3, 5e-5, 1000, 200
    t = np.arange(n) * PERIOD
    errors = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        u = amplitude * np.sin(2.0 * np.pi * frequency * t + 0.4) + rng.normal(0.0, noise, n)
        fit = fit_sine(u, PERIOD)
        errors.append((fit.amplitude - amplitude, fit.frequency - frequency))
    angle = 2.0 * np.pi * frequency * t + 0.4
    columns = np.column_stack(
        (
            np.sin(angle),
            2.0 * np.pi * t * amplitude * np.cos(angle),
            amplitude * np.cos(angle),
            np.ones(n),
        )
    )
    bound = noise**2 * np.diag(np.linalg.inv(columns.T @ columns))[:2]
    # Variance relative to the bound: four standard errors of a variance from 200 draws.
    np.testing.assert_array_less(np.mean(np.square(errors), axis=0) / bound, 1.4)


@pytest.mark.parametrize("u", [np.zeros(100), np.full(100, 3.3e-3)], ids=["zero", "constant"])
def test_without_motion_there_is_no_sine(u: Array) -> None:
    assert fit_sine(u, PERIOD) is None


# -- detection of a sine ---------------------------------------------------------------------

WIDTHS = [0.6, 1.0, 2.5, 7.0]


@pytest.mark.parametrize("cycles", WIDTHS)
@pytest.mark.parametrize("noise", [0.0, 1e-6, 5e-5, 2e-4])
def test_a_noisy_sine_is_a_sine(cycles: float, noise: float) -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        phase = 2.0 * np.pi * rng.random()
        u = 5e-3 * np.sin(np.pi * cycles * TIME + phase) + rng.normal(0.0, noise, TIME.size)
        assert window_motion(u, PERIOD).sine is not None, f"seed {seed}"


def triangle(cycles: float, phase: float) -> Array:
    return 5e-3 * sawtooth(np.pi * cycles * TIME + phase, 0.5)


def chirp(cycles: float, phase: float) -> Array:
    return 5e-3 * np.sin(np.pi * cycles * (TIME + 0.25 * TIME**2) + phase)


def ramped(cycles: float, phase: float) -> Array:
    return np.minimum(TIME / 0.5, 1.0) * 5e-3 * np.sin(np.pi * cycles * TIME + phase)


@pytest.mark.parametrize("cycles", WIDTHS)
@pytest.mark.parametrize("noise", [0.0, 1e-6, 5e-5])
@pytest.mark.parametrize("motion", [triangle, chirp, ramped], ids=lambda f: f.__name__)
def test_another_motion_is_no_sine(motion: object, noise: float, cycles: float) -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        u = motion(cycles, 2.0 * np.pi * rng.random())  # type: ignore[operator]
        found = window_motion(u + rng.normal(0.0, noise, TIME.size), PERIOD)
        assert found.sine is None, f"seed {seed}"


@pytest.mark.parametrize(
    ("u", "period", "sentence"),
    [
        (np.arange(15.0), PERIOD, "at least 16 samples of displacement, but has 15"),
        (np.zeros((4, 8)), PERIOD, "at least 16 samples"),
        (np.arange(20.0), 0.0, "the sample period is 0.0 s: it must be positive"),
        (np.arange(20.0), math.nan, "the sample period is nan s: it must be positive"),
        (np.where(np.arange(20) == 3, np.nan, 0.1), PERIOD, "holds NaN, infinite or huge"),
        (np.full(20, 1e-3), PERIOD, "the displacement does not change"),
    ],
)
def test_a_window_that_cannot_be_used_is_refused(u: Array, period: float, sentence: str) -> None:
    with pytest.raises(ValueError) as caught:
        window_motion(u, period)
    assert sentence in str(caught.value)


# -- smoothing differentiator ----------------------------------------------------------------


RANDOM = BandLimitedRandom(rms=3e-3, low=0.2, high=4.0, seed=4)

MOTIONS = {"triangle": ROUNDED_TRIANGLE, "random": RANDOM}

NEAR_THE_BEST = 4.0
"""Allowed error relative to the best filter length, because the length is chosen from the data."""


@functools.cache
def smoothed(name: str, noise: float) -> tuple[Array, Array]:
    """Worst errors of velocity and acceleration over 10 seeds, and those of the best length."""
    truth = MOTIONS[name].at(TIME)
    found, best = [], []
    for seed in range(10):
        error = np.random.default_rng(seed).normal(0.0, noise, TIME.size)
        u = truth.displacement + error
        estimate = window_motion(u, PERIOD)
        assert estimate.sine is None
        found.append(
            (
                relative(estimate.velocity, truth.velocity),
                relative(estimate.acceleration, truth.acceleration),
            )
        )
        candidates = [
            [
                relative(savgol_filter(u, length, 4, deriv=1, delta=PERIOD), truth.velocity),
                relative(savgol_filter(u, length, 4, deriv=2, delta=PERIOD), truth.acceleration),
            ]
            for length in (7, 13, 25, 49, 97, 193, 385)
        ]
        best.append(np.min(candidates, axis=0))
    return np.max(found, axis=0), np.max(best, axis=0)


@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize("noise", [1e-6, 1e-5])
def test_velocity_and_acceleration_of_any_motion_are_near_the_best_there_is(
    name: str, noise: float
) -> None:
    found, best = smoothed(name, noise)
    assert found[1] < NEAR_THE_BEST * best[1]
    assert found[0] < NEAR_THE_BEST * best[0]


@pytest.mark.parametrize("kind", ["white", "bursts", "heavy-tailed", "digital", "filtered"])
def test_the_noise_of_a_long_random_record_may_be_of_any_kind(kind: str) -> None:
    count, size = 20_000, 1e-4
    truth = BandLimitedRandom(rms=5e-3, low=0.4, high=3.0, seed=2).at(0.01 * np.arange(count))
    rng = np.random.default_rng(3)
    noise = size * rng.standard_normal(count)
    u = (
        truth.displacement
        + {
            "white": noise,
            "bursts": noise * np.where(np.sin(np.arange(count) / 500.0) > 0.9, 4.0, 1.0),
            "heavy-tailed": size / math.sqrt(3.0) * rng.standard_t(3, count),
            "digital": np.zeros(count),
            "filtered": np.convolve(noise, np.ones(3) / math.sqrt(3.0), "same"),
        }[kind]
    )
    if kind == "digital":
        u = 3.0 * size * np.round(u / (3.0 * size))
    lengths = (7, 11, 17, 25, 37, 55)
    best = min(
        relative(savgol_filter(u, each, 4, deriv=1, delta=0.01), truth.velocity) for each in lengths
    )
    assert relative(window_motion(u, 0.01).velocity, truth.velocity) < 1.3 * best


# -- causal differentiator -------------------------------------------------------------------


def followed(u: Array, bandwidth: float = 40.0, period: float = PERIOD) -> tuple[Array, ...]:
    return CausalDifferentiator(period, bandwidth).follow(u)


@known.fixed(60)
@given(
    coefficients=st.tuples(*[st.floats(-1.0, 1.0)] * 4),
    bandwidth=st.floats(5.0, 200.0),
    log_period=st.floats(-4.0, -3.0),
)
def test_a_cubic_motion_is_followed_without_error(
    coefficients: tuple[float, ...], bandwidth: float, log_period: float
) -> None:
    period = 10.0**log_period
    assume(bandwidth <= 0.25 / period)
    tau = 1.0 / (2.0 * math.pi * bandwidth)
    n = math.ceil(60.0 * tau / period) + 50
    t = np.arange(n) * period
    # Units in which every coefficient matters within the memory of the observer.
    sizes = np.array([1e-2, 1e-2 / tau, 1e-2 / tau**2, 1e-2 / tau**3]) / 60.0 ** np.arange(4)
    c = np.array(coefficients) * sizes
    u = c[0] + c[1] * t + c[2] * t**2 + c[3] * t**3
    v = c[1] + 2.0 * c[2] * t + 3.0 * c[3] * t**2
    a = 2.0 * c[2] + 6.0 * c[3] * t
    late = t > 55.0 * tau
    found = followed(u, bandwidth, period)
    for k, (estimate, truth) in enumerate(zip(found, (u, v, a), strict=True)):
        # After 55 time constants only rounding remains, because every coefficient matters.
        assert np.max(np.abs(estimate - truth)[late]) < 1e-11 * 1e-2 / tau**k


@known.fixed(25)
@given(sizes=st.lists(st.integers(1, 97), min_size=1, max_size=8))
def test_the_stream_does_not_depend_on_the_size_of_its_blocks(sizes: list[int]) -> None:
    u = RANDOM.at(np.arange(600) * PERIOD).displacement + 0.01
    whole = followed(u)
    observer, parts, first, place = CausalDifferentiator(PERIOD, 40.0), [], 0, 0
    while first < u.size:
        last = first + sizes[place % len(sizes)]
        parts.append(observer.follow(u[first:last]))
        first, place = last, place + 1
    for name, complete, pieces in zip("uva", whole, zip(*parts, strict=True), strict=True):
        # Relative to the largest value: the order of summation changes the last digits.
        allowed = 1e-11 * np.max(np.abs(complete))
        np.testing.assert_allclose(np.concatenate(pieces), complete, 0.0, allowed, err_msg=name)
