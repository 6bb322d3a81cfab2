"""Determined parameters are named correctly, and the advised runs determine the others."""

import math
from dataclasses import replace
from functools import cache

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from known import SIGMOID

from mr_damper_ros.estimation.covariance import noise_level
from mr_damper_ros.estimation.experiment_design import ExtraRun, MachineLimits, extra_runs
from mr_damper_ros.estimation.observability import (
    determination,
    operating_points_within,
    parameter_spans,
    varied_parameters,
)
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.misfit import Misfit
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES
from mr_damper_ros.signals.arrays import Array

TOP_VELOCITY = 2.0 * math.pi * 3.0 * 10e-3
TOP_CURRENT = 1.5
RIG = MachineLimits(10e-3, TOP_VELOCITY, math.inf, TOP_CURRENT, 1.0)
RANGES = SIGMOID.plausible_ranges([], TOP_VELOCITY, TOP_CURRENT)


@cache
def window(amplitude: float, frequency: float, current: float) -> Window:
    run = known.run(
        amplitude=amplitude, frequency=frequency, current=current, samples=400, period=2.5e-3
    )
    return run.window


def windows(
    currents: tuple[float, ...], amplitudes: tuple[float, ...] = (2.5e-3, 10e-3)
) -> list[Window]:
    return [window(a, f, i) for a in amplitudes for f in (1.0, 3.0) for i in currents]


def pooled(chosen: list[Window]) -> Misfit:
    return Misfit(SIGMOID, chosen, [known.NOISE] * len(chosen))


# -- rank, condition, combinations -----------------------------------------------------------


def test_one_run_determines_seven_combinations() -> None:
    misfit = pooled([window(5e-3, 1.0, 1.0)])
    jacobian = misfit.jacobian(known.PLAUSIBLE) / noise_level(misfit.residual(known.PLAUSIBLE))
    spans = parameter_spans(SIGMOID, jacobian, known.PLAUSIBLE, RANGES)
    result = determination(SIGMOID, jacobian, spans, known.PLAUSIBLE)
    assert result.rank == 7
    assert len(result.open) == 9
    assert math.isinf(result.condition)


def random_jacobian(seed: int, rank: int) -> Array:
    rng = np.random.default_rng(seed)
    return np.asarray(rng.normal(size=(60, rank)) @ rng.normal(size=(rank, 16)) * 10.0)


@known.fixed(25)
@given(st.integers(0, 10_000), st.integers(1, 16))
def test_open_combinations_are_those_that_the_samples_do_not_notice(seed: int, rank: int) -> None:
    jacobian = random_jacobian(seed, rank)
    result = determination(SIGMOID, jacobian, np.ones(16), np.ones(16))
    assert result.rank + len(result.open) == 16
    for combination in result.open:
        if math.isinf(combination.standard_error):
            move = np.array([combination.weights.get(name, 0.0) for name in PARAMETER_NAMES])
            # The text omits small weights.
            unnoticed = 0.05 * np.linalg.norm(jacobian, axis=0).sum()
            assert np.linalg.norm(jacobian @ move) <= unnoticed


@pytest.mark.parametrize(
    ("name", "as_others", "value", "words"),
    [
        ("a3", {"a2": 2.0}, 1.0, "a2 and a3 only together: as a2 grows by 10 %, a3 shrinks by 5 %"),
        (
            "a3",
            {"a2": 1.0, "k0": 1.0},
            1.0,
            "k0, a3 and a2 only together: "
            "as k0 grows by 10 %, a3 shrinks by 10 %, a2 grows by 10 %",
        ),
        ("f0", {"k2": -0.025}, -40.0, "k2 and f0 only as a product"),
        ("f0", {"k2": 0.025}, -40.0, "k2 and f0 only as a ratio"),
        ("I1", {"a2": 1.0}, 0.0, "a2 and I1 only together: as a2 grows by 10 %, I1 falls by 0.1 A"),
    ],
)
def test_an_open_combination_is_described(
    name: str, as_others: dict[str, float], value: float, words: str
) -> None:
    """One parameter changes the force as a sum of others does, and so is known only with them."""
    jacobian = 100.0 * np.random.default_rng(0).normal(size=(400, 16))
    factors = [as_others.get(other, 0.0) for other in PARAMETER_NAMES]
    values = np.ones(16)
    jacobian[:, known.index(name)], values[known.index(name)] = jacobian @ factors, value
    found = determination(SIGMOID, jacobian, np.abs(values) + (values == 0.0), values)
    (combination,) = found.open
    assert combination.words == words
    assert math.isinf(combination.standard_error)
    lead = next(iter(combination.weights))
    others = tuple(other for other in combination.weights if other != lead)
    # Only the uncertainty of the leading parameter exceeds its own standard error.
    assert found.partners({**dict.fromkeys(others, math.inf), lead: 0.1}) == {lead: others}


@pytest.mark.parametrize(
    ("levels", "most"),
    [((1.0,), 1), ((0.2, 1.2), 2), ((0.0, 0.4, 1.1), 3), ((0.1, 0.5, 0.9, 1.3, 0.3, 0.7), 5)],
)
def test_every_current_that_a_window_passes_through_counts(
    levels: tuple[float, ...], most: int
) -> None:
    whole = window(5e-3, 1.0, 1.0)
    held = np.repeat(levels, -(-whole.sample_count // len(levels)))[: whole.sample_count]
    springs = MODELS["series_springs"]
    names = varied_parameters(springs, *operating_points_within([replace(whole, current=held)]))
    # The yield force is a cubic polynomial: each further coefficient needs one more current.
    terms = [name for name in ("f_y", "f_y_1", "f_y_2", "f_y_3") if name in names]
    assert len(terms) == min(most, 4)


# -- advice ----------------------------------------------------------------------------------


def flags(chosen: list[Window]) -> np.ndarray:
    """Observable flags of the identification."""
    names = varied_parameters(SIGMOID, *operating_points_within(chosen))
    return np.array([name in names for name in PARAMETER_NAMES])


def advised(chosen: list[Window], rig: MachineLimits = RIG) -> tuple[ExtraRun, ...]:
    return extra_runs(pooled(chosen), known.NOISE, known.PLAUSIBLE, flags(chosen), rig)


OPEN = {
    "one current": windows((1.0,)),
    "two currents": windows((0.0, 1.0)),
    "three currents": windows((0.0, 0.5, 1.5)),
    "one peak velocity": [window(5e-3, 1.0, i) for i in (0.0, 0.5, 1.0, 1.5)],
}


@pytest.mark.parametrize("name", OPEN)
def test_the_advised_runs_determine_what_they_promise(name: str) -> None:
    chosen = OPEN[name]
    runs = advised(chosen)
    made = [window(run.amplitude, run.frequency, run.current) for run in runs]
    open_before = {n for n, seen in zip(PARAMETER_NAMES, flags(chosen), strict=True) if not seen}
    open_after = {
        n for n, seen in zip(PARAMETER_NAMES, flags(chosen + made), strict=True) if not seen
    }
    assert {n for run in runs for n in run.determines} == open_before
    assert open_after == set()


def test_no_advice_where_all_is_known() -> None:
    assert advised(windows((0.0, 0.5, 1.0, 1.5))) == ()


def test_advice_stays_within_the_rig() -> None:
    rig = replace(RIG, amplitude=4e-3, peak_velocity=0.05, current=0.8)
    runs = advised(OPEN["one current"], rig)
    assert runs
    for run in runs:
        assert run.amplitude <= rig.amplitude
        assert 2.0 * math.pi * run.frequency * run.amplitude <= 1.05 * rig.peak_velocity
        assert 0.0 <= run.current <= rig.current


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"peak_velocity": 0.0}, "largest peak velocity is 0.0: it must be positive"),
        ({"peak_velocity": math.nan}, "largest peak velocity is nan"),
        ({"peak_velocity": math.inf}, "largest peak velocity is inf"),
        ({"amplitude": -1.0}, "largest amplitude is -1.0"),
        ({"current": -0.5}, "largest current is -0.5: give it in ampere"),
    ],
    ids=str,
)
def test_a_rig_that_cannot_be_is_refused(changes: dict[str, float], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        replace(RIG, **changes)  # type: ignore[arg-type]
