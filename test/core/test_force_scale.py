"""The force scale against the baseline is right, with a right standard error."""

from __future__ import annotations

import dataclasses
import math

import known
import numpy as np
import pytest
from known import SIGMOID

from mr_damper_ros.estimation.window_fit import WindowFit, fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.tracking import force_scale as tracking
from mr_damper_ros.tracking.force_scale import ForceScale, force_scale
from mr_damper_ros.tracking.operating_point import KnownPoints

WEAKER = known.weaker(0.9)

NOISELESS = 1e-12
"""Relative: what rounding leaves of the fit to a force without noise."""


def fit_of(run: known.Run) -> WindowFit:
    return fit_window(SIGMOID, run.window, known.PLAUSIBLE, method="least_squares")


def scale_of(known_points: KnownPoints, run: known.Run) -> ForceScale:
    return force_scale(SIGMOID, run.window, fit_of(run), known_points.baselines)


def scale_between(before: known.Run, after: known.Run) -> tuple[float, float]:
    known_points = KnownPoints()
    known_points = known_points.with_baseline(fit_of(before))
    scale = scale_of(known_points, after)
    return scale.value, scale.standard_error


def test_a_weaker_damper_has_a_smaller_scale() -> None:
    value, _ = scale_between(known.run(seed=None), known.run(WEAKER, seed=None))
    assert value == pytest.approx(0.9, rel=NOISELESS)


def test_the_standard_error_is_the_scatter() -> None:
    baseline = known.run(seed=None)
    scales = [scale_between(baseline, known.run(seed=seed)) for seed in range(60)]
    values, errors = np.array(scales).T
    # Relative: a standard deviation from 60 draws is good for 9 %.
    assert np.std(values) / np.mean(errors) == pytest.approx(1.0, rel=0.3)


def test_without_a_baseline_there_is_no_scale() -> None:
    scale = scale_of(KnownPoints(), known.run())
    assert math.isnan(scale.value)
    assert math.isnan(scale.standard_error)


@pytest.mark.parametrize(
    "elsewhere", [{"current": 1.2}, {"amplitude": 7.5e-3}, {"frequency": 2.0}], ids=str
)
def test_another_operating_point_has_another_baseline(elsewhere: dict[str, float]) -> None:
    known_points = KnownPoints()
    known_points = known_points.with_baseline(fit_of(known.run()))
    assert math.isnan(scale_of(known_points, known.run(**elsewhere)).value)


EDGE = 0.001
"""Relative change of the amplitude or current that no controller of a test machine holds."""

ACROSS_THE_EDGE = 2.5 * EDGE
"""Relative: the two runs are two such changes apart, and so are their forces at most."""


@pytest.mark.parametrize("what", ["peak velocity", "current"])
def test_an_operating_point_at_the_edge_of_a_cell_has_one_baseline(what: str) -> None:
    speed, current = 1.1**-33.5, 0.5
    if what == "current":
        speed, current = 1.1**-33.0, 0.525
    known_points = KnownPoints()
    for factor, parameters in ((1.0 - EDGE, known.PLAUSIBLE), (1.0 + EDGE, WEAKER)):
        amplitude = speed / (2.0 * math.pi) * (factor if what == "peak velocity" else 1.0)
        i = current * (factor if what == "current" else 1.0)
        run = known.run(parameters, amplitude=amplitude, current=i, seed=None)
        scale = scale_of(known_points, run)
        known_points = known_points.with_baseline(fit_of(run))
    assert scale.value == pytest.approx(0.9, rel=ACROSS_THE_EDGE)


@pytest.mark.parametrize("factor", [-4e-4, 0.0])
def test_a_force_against_that_of_the_baseline_tells_no_scale(factor: float) -> None:
    reference = known.run(seed=None).force
    known_to = np.ones((reference.size, 1)), np.ones((1, 1))
    assert math.isnan(tracking.scale_between(reference, factor * reference, *known_to).value)


def test_a_baseline_beyond_all_measure_tells_no_scale() -> None:
    run = known.run(frequency=2.0)
    displacement = run.displacement + 2e-3 * np.sin(9.1 * np.arange(2000) * run.period)
    window = Window.from_samples(displacement, run.force, run.current, run.period)
    fit = fit_window(SIGMOID, window, known.PLAUSIBLE, method="least_squares")
    absurd = fit.parameters.copy()
    absurd[SIGMOID.strength_indices] *= 1e100
    known_points = KnownPoints()
    known_points = known_points.with_baseline(dataclasses.replace(fit, parameters=absurd))
    assert window.motion.sine is None
    assert math.isnan(force_scale(SIGMOID, window, fit, known_points.baselines).value)
