"""The recursive filter agrees with the window fit, follows drift, and estimates its error."""

import dataclasses

import known
import numpy as np
import pytest
from known import SIGMOID

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.window_fit import WindowFit, fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.misfit import WindowProblem
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import LITERATURE, THESIS_28_CELSIUS
from mr_damper_ros.tracking.recursive_tracker import METHOD, FilterState, RecursiveFilter
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.tracker import TrackerSettings, WindowTracker

SAMPLES = 1000
STILL = 1e-9
"""Negligible drift rate [1/sqrt(s)]: the filter only averages."""


def second(stamp: int) -> int:
    return known.T0 + stamp * known.NANOSECONDS


def fitted(window: Window, stamp: int = 0) -> FilterState:
    fit = fit_window(SIGMOID, window, known.PLAUSIBLE, method="least_squares")
    return FilterState.of(fit, second(stamp))


def filtered(
    state: FilterState, window: Window, stamp: int = 1, rate: float = STILL, **changes: bool
) -> WindowFit:
    problem = WindowProblem(SIGMOID, window, known.PLAUSIBLE)
    follower = RecursiveFilter(state, problem, second(stamp), drift_rate=rate, **changes)
    follower.take_in(np.ones(window.sample_count, dtype=bool))
    return follower.as_fit(problem)


# -- the filter ------------------------------------------------------------------------------


def test_without_drift_two_halves_give_what_the_fit_of_the_whole_gives() -> None:
    whole = known.run(samples=4000).window
    first, last = whole.part(slice(0, 2000)), whole.part(slice(2000, None))
    at_once = fit_window(SIGMOID, whole, known.PLAUSIBLE, method="least_squares")
    in_turn = filtered(fitted(first), last)
    errors = np.sqrt(np.diag(at_once.covariance))
    # Standard errors: in a nearly linear problem the order of the samples hardly matters.
    assert np.max(np.abs(in_turn.scales - at_once.scales) / errors) < 0.05
    # Relative: half of the samples determine the noise, and so all errors, to 1.6 %.
    assert np.sqrt(np.diag(in_turn.covariance)) == pytest.approx(errors, rel=0.05)


def test_the_errors_are_as_large_as_it_says() -> None:
    scores = []
    for seed in range(40):
        first = known.run(samples=SAMPLES, seed=seed)
        last = known.run(samples=SAMPLES, seed=1000 + seed)
        found = filtered(fitted(first.window), last.window)
        errors = np.sqrt(np.diag(found.coefficient_covariance))
        scores.append((found.coefficients - last.coefficients) / errors)
    # Of a mean square of 1: three standard errors of 40 runs with seven correlated scores each.
    assert np.mean(np.square(scores)) == pytest.approx(1.0, abs=0.35)


# -- the filter as a tracker -----------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class Drifted:
    """Later windows of a drifting force (n,): reports and true scales [1]."""

    reports: list[Report]
    truth: np.ndarray

    @property
    def scales(self) -> np.ndarray:
        return np.array([report.scale.value for report in self.reports])


@pytest.fixture(scope="module")
def drifted() -> Drifted:
    """A damper that heats from 28 to 71 °C in forty windows."""
    tracked = known.tracker(ParameterSet(LITERATURE), tracker=METHOD)
    windows, truth = [], []
    for number in range(40):
        run = known.run(THESIS_28_CELSIUS, current=1.5, samples=SAMPLES, start=number, seed=None)
        clean = known.drifting_force(run, number / 39)
        noise = np.random.default_rng(number).normal(0.0, known.NOISE, SAMPLES)
        windows.append(
            known.raw_window(dataclasses.replace(run, force=clean + noise), number=number)
        )
        truth.append(float(clean @ run.clean) / float(run.clean @ run.clean))
    return Drifted(known.fed(tracked, *windows)[1:], np.array(truth[1:]))


def test_it_follows_a_drift_and_knows_its_error(drifted: Drifted) -> None:
    assert all(report.accepted for report in drifted.reports)
    # Relative: six standard errors of a report, 1.6e-4, because the filter also lags a little.
    np.testing.assert_allclose(drifted.scales, drifted.truth, rtol=1e-3)
    errors = np.array([report.scale.standard_error for report in drifted.reports])
    # Largest error of a scale in standard errors; chance exceeds it once in 16 000.
    assert np.max(np.abs(drifted.scales - drifted.truth) / errors) < 4.0


@pytest.mark.parametrize("change", ["point", "past", "reset", "replace", "search"])
def test_it_starts_again_from_a_fit_where_its_state_does_not_hold(change: str) -> None:
    tracked = known.tracker(tracker=METHOD)
    known.fed(tracked, *(known.window(number, strength=1.0 - 0.02 * number) for number in range(3)))
    following = known.window(3, strength=0.9)
    if change == "point":
        following = known.window(3, strength=0.9, current=0.3)
    elif change == "past":
        following = dataclasses.replace(following, start_ns=known.T0 - 10**12)
    elif change == "reset":
        tracked.reset()
    elif change == "replace":
        tracked.replace(ParameterSet(known.weaker(0.8), set_id="loaded"))
    else:
        known.fed(tracked, known.window(3, current=0.2, frequency=3.0))
        assert tracked.identify(EvolutionSettings(generations=20, population=8)).accepted
    assert known.fed(tracked, following)[0].method == "least_squares"


@pytest.mark.parametrize("model", ["hyperbolic_tangent", "bouc_wen"])
def test_every_law_is_followed(model: str) -> None:
    law, values = MODELS[model], known.EXAMPLES[model]
    runs = []
    for number, strength in enumerate((1.0, 1.0, 0.98)):
        motion = known.run(samples=2000, seed=number)
        weaker = values.copy()
        weaker[list(law.strength_indices)] *= strength
        force = law.window_force(motion.window, weaker) + motion.force - motion.clean
        raw = known.raw_window(motion, number=number)
        runs.append(dataclasses.replace(raw, force=force, start_ns=known.T0 + number * 2 * 10**9))
    tracked = WindowTracker(
        TrackerSettings(model=model, tracker="unscented", global_period=0),
        ParameterSet(values, model=model),
    )
    reports = known.fed(tracked, *runs)
    assert [report.method for report in reports[1:]] == [METHOD] * 2
    # Of the force scale: a quarter of the change.
    assert reports[-1].scale.value == pytest.approx(0.98, abs=0.005)


def test_outliers_hardly_move_a_robust_filter() -> None:
    run = known.run(samples=SAMPLES, seed=3)
    hit = np.random.default_rng(0).random(SAMPLES) < 0.03
    spoilt = dataclasses.replace(run, force=run.force + 400.0 * hit)
    before = fitted(known.run(seed=1).window)
    clean = filtered(before, run.window, rate=1e-2)
    plain, robust = (
        known.rms(filtered(before, spoilt.window, rate=1e-2, robust=r).scales / clean.scales - 1.0)
        for r in (False, True)
    )
    # Relative to the plain filter: outliers keep the weight of normal errors.
    assert robust < 0.25 * plain
