"""Long records: thinned windows represent the whole, and results are checked on other samples."""

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import mr_damper_ros as mr
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.sigmoid.law import sine_force

CURRENT = 0.8

UNLIKELY = 5.0
"""Standard errors that a mean over random phases does not deviate by."""

AS_GOOD = 1.02
"""Largest error on the whole record over that of the noise."""

ALIKE = 1.5
"""Largest ratio of two estimates of the same standard error, from one window each."""

FOLLOWED = 0.02
"""Largest error of a law integrated in steps of 1 ms, relative to the force."""


def record(
    frequency: float, count: int, rate: float = 1000.0, noise: float = 5.0
) -> dict[str, object]:
    """Own law in a sine of 0.2 m/s, with noise of the force [N]."""
    angle = 2.0 * np.pi * frequency / rate * np.arange(count)
    speed = 0.2
    amplitude = speed / (2.0 * np.pi * frequency)
    u, v = amplitude * np.sin(angle), speed * np.cos(angle)
    force = sine_force(known.PLAUSIBLE, u, v, -((2.0 * np.pi * frequency) ** 2) * u, CURRENT)
    force += noise * np.random.default_rng(count).standard_normal(count)
    return {"displacement": u, "force": force, "current": CURRENT, "period": 1.0 / rate}


def numbered(count: int) -> Window:
    """A window whose forces number its samples."""
    displacement = np.sin(0.1 * np.arange(count))
    return Window.from_samples(displacement, np.arange(count, dtype=float), 1.0, 1e-3)


@known.fixed(30)
@given(cycle=st.integers(2, 3000), most=st.integers(100, 2000), size=st.integers(2, 500))
def test_a_thinned_window_has_all_phases_of_any_cycle(cycle: int, most: int, size: int) -> None:
    few = numbered(most * size).thinned(most)
    for harmonic in (1, 2, 3):
        angles = 2.0 * np.pi * harmonic * few.force / cycle
        # Whole cycles have a mean of zero; a part of one is compared with the whole.
        whole = np.exp(2j * np.pi * harmonic * np.arange(most * size) / cycle).mean()
        error = abs(np.exp(1j * angles).mean() - whole)
        assert error < UNLIKELY / np.sqrt(few.sample_count)


def test_samples_left_out_are_other_samples_of_the_same_parts() -> None:
    whole = numbered(10_007)
    few, others = whole.thinned(1000), whole.left_out(1000)
    assert others is not None
    assert not np.intersect1d(few.force, others.force).size
    np.testing.assert_array_equal(few.force // 10, others.force // 10)
    assert whole.thinned(6000) is whole
    assert whole.left_out(6000) is None


@pytest.mark.parametrize(
    ("frequency", "count"), [(10.0, 200_000), (1.0, 400_000), (5.0, 320_000), (25.0, 80_000)]
)
def test_a_long_sine_is_fitted_to_the_noise(frequency: float, count: int) -> None:
    result = mr.identify(**record(frequency, count))
    assert result.success
    assert result.runs[0].error.rmse < AS_GOOD * 5.0


def test_a_fit_to_samples_that_do_not_represent_the_record_is_no_success(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn = Window._drawn

    def strided(self: Window, size: int, *, other: bool = False) -> Window:
        return drawn(self, size, other=True) if other else self.part(slice(None, None, size))

    monkeypatch.setattr(Window, "_drawn", strided)
    result = mr.identify(**record(10.0, 200_000))
    assert not result.success
    assert "on samples that the fit has not used" in result.message


@pytest.mark.parametrize("law", ["sigmoid", "bingham", "bouc_wen"])
def test_a_law_that_does_not_fit_is_not_taken_for_unrepresentative_samples(law: str) -> None:
    found = record(2.0, 50_000)
    velocity = np.gradient(np.asarray(found["displacement"]), 1e-3)
    found["force"] = 300.0 * np.sign(velocity) * np.abs(velocity) ** 0.3 + 50.0 * np.sin(
        0.01 * np.arange(50_000)
    )
    result = mr.identify(**found, model=law)
    assert result.searches.best.success, result.searches.best.message


def test_errors_of_a_thinned_window_separate_noise_and_model_error() -> None:
    made = record(2.0, 40_000)
    angle = np.arange(40_000) * (2.0 * np.pi * 2.0 / 1000.0)
    force = np.asarray(made["force"]) + 40.0 * np.sin(3.0 * angle)  # a misfit of every cycle
    whole = Window.from_samples(np.asarray(made["displacement"]), force, CURRENT, 1e-3)
    law = known.SIGMOID
    few = [
        fit_window(law, window, known.PLAUSIBLE, method="least_squares")
        for window in (whole.thinned(2000), whole.part(slice(2000)))
    ]
    for fit in few:
        assert fit.discrepancy is not None
    for name in ("discrepancy", "covariance"):
        drawn, uniform = (np.sqrt(np.diag(getattr(fit, name))) for fit in few)
        assert 1.0 / ALIKE < np.median(drawn / uniform) < ALIKE, name


@pytest.mark.parametrize("law", ["bouc_wen", "series_springs"])
def test_a_law_with_memory_follows_a_current_that_switches_in_a_slow_motion(law: str) -> None:
    count, period = 30_000, 1e-3
    angle = 2.0 * np.pi * 0.1 * period * np.arange(count)
    u, v = 0.01 * np.sin(angle), 0.01 * 2.0 * np.pi * 0.1 * np.cos(angle)
    current = np.where(np.arange(count) // 200 % 2, 1.2, 0.2)
    model = known.MODELS[law]
    values = known.controllable(law).values
    motion = Motion(u, v, -((0.2 * np.pi) ** 2) * u, np.full(count, 0.002 * np.pi), None)
    force, _ = model.follow(values, motion, current, period, None)
    window = Window(motion, force, current, period)
    error = model.window_force(window, values) - force
    assert known.rms(error) < FOLLOWED * np.std(force)
