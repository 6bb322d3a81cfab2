"""The force over temperature as it was, and the temperature from the force, or none."""

from __future__ import annotations

import math
from collections.abc import Iterable

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.force_scale import (
    ForceScale,
    TemperatureMap,
    fit_temperature_map,
    temperature_map,
    with_temperature,
)
from mr_damper_ros.tracking.operating_point import KnownPoints

POINT = (0.0314, 1.5)


# -- the emulated damper -----------------------------------------------------------------------


def learnt(pairs: Iterable[tuple[float, ForceScale]]) -> TemperatureMap:
    points = KnownPoints()
    for celsius, scale in pairs:
        points = with_temperature(points, POINT, celsius, scale)
    found = temperature_map(points.at(POINT))
    assert found is not None
    return found


# -- known maps --------------------------------------------------------------------------------

ERROR = 2e-3
"""Relative standard error of the force scale of a window."""


def observed(
    seed: int = 0, *, rate: float = -7e-3, count: int = 60, span: float = 40.0, bend: float = 0.0
) -> tuple[Array, Array, Array]:
    """Temperatures, noisy force scales and their standard errors of an exponential law."""
    rng = np.random.default_rng(seed)
    celsius = 30.0 + span * np.sort(rng.random(count))
    true = np.exp(rate * (celsius - 30.0) + bend * (celsius - 30.0) ** 2)
    return celsius, true * (1.0 + ERROR * rng.normal(size=count)), np.full(count, ERROR)


def fitted(*data: Array) -> TemperatureMap:
    found = fit_temperature_map(POINT, *data)
    assert found is not None
    return found


@known.fixed(20)
@given(st.floats(-0.02, -0.004), st.floats(15.0, 60.0), st.integers(0, 1000))
def test_the_inverse_is_the_inverse(rate: float, span: float, seed: int) -> None:
    found = fitted(*observed(seed, rate=rate, span=span))
    for celsius in np.linspace(found.low, found.high, 7)[1:-1]:
        again = found.temperature(found.scale(celsius))
        # Kelvin: rounding, of which the root of a nearly straight parabola makes more.
        assert again.celsius == pytest.approx(celsius, abs=1e-6)


def test_the_standard_errors_are_true() -> None:
    """The temperature of a new window lies where its standard error says."""
    deviations = []
    for seed in range(200):
        found = fitted(*observed(seed))
        noise = ERROR * np.random.default_rng([seed, 1]).normal()
        value = math.exp(-7e-3 * 20.0) * (1.0 + noise)
        told = found.temperature(ForceScale(value, ERROR * value))
        deviations.append((told.celsius - 50.0) / told.standard_error)
    # Of a standard deviation of 1 that 200 draws tell: four of its standard errors of 5 %.
    assert np.std(deviations) == pytest.approx(1.0, abs=0.2)


def test_the_error_of_the_temperature_holds_the_scatter_about_the_map() -> None:
    """Though the scales of the windows claim to be ten times as good as they are."""
    celsius, scales, errors = observed()
    found = fitted(celsius, scales, 0.1 * errors)
    told = found.temperature(ForceScale(found.scale(50.0).value, 0.1 * ERROR))
    assert told.standard_error >= found.scatter / abs(found.slope(50.0))


def test_outside_of_what_was_seen_nothing_is_known() -> None:
    found = fitted(*observed())
    for celsius in (found.low - 0.1, found.high + 0.1):
        assert math.isnan(found.scale(celsius).value)
    for celsius in (found.low - 3.0, found.high + 3.0):
        scale = ForceScale(math.exp(-7e-3 * (celsius - 30.0)), ERROR)
        assert math.isnan(found.temperature(scale).celsius)
        assert math.isnan(found.temperature(scale).standard_error)


@pytest.mark.parametrize(
    "data",
    [
        observed(count=7),
        observed(span=0.5),
        observed(rate=0.0),
        observed(span=0.0),
        observed(rate=-4e-3, bend=1e-4),
    ],
    ids=["few windows", "small span", "no effect", "one temperature", "force falls and rises"],
)
def test_what_does_not_identify_a_map_gives_none(data: tuple[Array, Array, Array]) -> None:
    assert fit_temperature_map(POINT, *data) is None


def test_unknown_temperatures_and_scales_are_left_out() -> None:
    pairs = []
    for celsius, scale, error in zip(*observed(), strict=True):
        pairs += [(celsius, ForceScale(scale, error)), (math.nan, ForceScale(scale, error))]
        pairs.append((celsius, ForceScale()))
    assert learnt(pairs).windows == 60


def test_what_is_kept_of_a_long_run_is_bounded_and_says_the_same() -> None:
    data = observed(count=3000)
    pairs = zip(*data, strict=True)
    kept, whole = learnt((c, ForceScale(scale, error)) for c, scale, error in pairs), fitted(*data)
    assert kept.windows <= 400
    assert (kept.low, kept.high) == (whole.low, whole.high)
    middle = 0.5 * (whole.low + whole.high)
    expected = whole.scale(middle).value
    # Of the error of one window, by which a map of kept points may differ from one of all points.
    assert kept.scale(middle).value == pytest.approx(expected, abs=0.2 * ERROR)
