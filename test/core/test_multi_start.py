"""Searches from several seeds, and from a lower minimum found by a profile."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import known
import numpy as np
import pytest
from known import SIGMOID

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings, GlobalProgress
from mr_damper_ros.estimation.global_fit import GlobalFit, identify_global
from mr_damper_ros.estimation.multi_start import (
    MultiStart,
    SearchRecord,
    SearchRecordError,
    identify_from_seeds,
)
from mr_damper_ros.estimation.observability import parameter_ranges
from mr_damper_ros.estimation.profile_likelihood import profiled, profiles_of
from mr_damper_ros.estimation.record_levels import LevelPrior
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.published import LITERATURE
from mr_damper_ros.processes.process_pool import ProcessPool

FEW = EvolutionSettings(generations=20, population=6, seed=3)
CURRENTS = (0.0, 0.5, 1.0, 1.5)


@cache
def windows() -> tuple[Window, ...]:
    return tuple(
        known.run(frequency=2.0, current=i, seed=seed, samples=250, period=2e-3).window
        for seed, i in enumerate(CURRENTS)
    )


def searched(
    count: int,
    report: Callable[[GlobalProgress], bool] | None = None,
    record: SearchRecord | None = None,
) -> MultiStart:
    return identify_from_seeds(record or empty(), count, report)


def empty(
    method: str = "global", settings: EvolutionSettings = FEW, levels: LevelPrior | None = None
) -> SearchRecord:
    return SearchRecord(SIGMOID, windows(), LITERATURE, settings, method, levels)


def stopping(
    after: float, heard: list[GlobalProgress] | None = None
) -> Callable[[GlobalProgress], bool]:
    heard = [] if heard is None else heard

    def report(progress: GlobalProgress) -> bool:
        heard.append(progress)
        return len(heard) < after

    return report


# -- records -----------------------------------------------------------------------------------


def test_a_record_survives_json() -> None:
    record = empty()
    first = searched(1, record=record).best
    again = empty()
    again.take(json.loads(json.dumps(record.document())))
    second = again.fits[3]
    np.testing.assert_array_equal(first.parameter_set.values, second.parameter_set.values)
    np.testing.assert_array_equal(first.covariance, second.covariance)
    assert (first.cost, first.evaluations) == (second.cost, second.evaluations)
    assert second.candidates[0].origin == first.candidates[0].origin


@pytest.mark.parametrize(
    ("method", "after", "levels"),
    [
        ("global", 1, None),
        ("global", 35, None),
        ("differential_evolution", 10, None),
        ("global", 1, LevelPrior((0, 1, 2, 3))),
    ],
)
def test_a_resumed_search_ends_no_worse(method: str, after: int, levels: LevelPrior | None) -> None:
    before, record = empty(method, levels=levels), empty(method, levels=levels)
    stopped = searched(1, stopping(after), before).best
    record.take(json.loads(json.dumps(before.document())))
    resumed = searched(1, None, record).best
    assert not stopped.success
    assert resumed.cost <= stopped.cost
    assert stopped.levels is None or math.isfinite(stopped.levels.counted_samples)
    assert record.is_finished(3)


def test_a_cost_that_is_not_finite_is_no_best_one() -> None:
    record, again = empty(), empty()
    best = searched(1, record=record).best
    record.fits |= {2: replace(best, cost=math.nan), 4: replace(best, cost=math.inf)}
    again.take(json.loads(json.dumps(record.document())))
    assert [math.isnan(again.fits[seed].cost) for seed in (2, 3, 4)] == [True, False, True]
    assert MultiStart(dict(sorted(again.fits.items()))).best is again.fits[3]


def test_what_was_found_is_kept_as_soon_as_it_is_there() -> None:
    kept: list[int] = []
    heard: list[GlobalProgress] = []
    report = stopping(math.inf, heard)
    identify_from_seeds(empty(), 2, report, keep=lambda record: kept.append(len(record.fits)))
    assert kept == [1, 2]
    assert {progress.stage[:13] for progress in heard} == {"search 1 of 2", "search 2 of 2"}
    assert not any(progress.time_left < 0.0 for progress in heard)


OTHER = {
    "other settings": empty(settings=EvolutionSettings(generations=21, population=6)),
    "another method": empty("least_squares"),
    "another start": SearchRecord(SIGMOID, windows(), known.PLAUSIBLE, FEW, "global"),
    "other windows": SearchRecord(SIGMOID, windows()[:2], LITERATURE, FEW, "global"),
}


@pytest.mark.parametrize("name", OTHER)
def test_a_record_of_another_search_is_refused(name: str) -> None:
    with pytest.raises(SearchRecordError, match="it belongs to a search with other bags"):
        empty().take(OTHER[name].document())


# -- a fit restarts if its own profile finds a lower minimum ---------------------------------------

QUICK = EvolutionSettings(generations=20, population=6)


@pytest.fixture(scope="module")
def strokes() -> list[Window]:
    return [
        known.run(amplitude=a, frequency=2.0, seed=seed, samples=250, period=4e-3).window
        for seed, a in enumerate((2.5e-3, 10e-3))
    ]


@pytest.fixture(scope="module")
def good(strokes: list[Window]) -> GlobalFit:
    return identify_global(SIGMOID, strokes, LITERATURE, QUICK)


def off(fit: GlobalFit) -> GlobalFit:
    """The fit, moved away from its minimum."""
    values = fit.parameter_set.values.copy()
    values[known.index("a0")] *= 1.2
    return replace(fit, parameter_set=replace(fit.parameter_set, values=values))


def test_a_profile_reaches_as_far_as_the_whole_windows_say(good: GlobalFit) -> None:
    # The largest current is in a single sample, which the misfit of thinned windows omits.
    whole = known.run(samples=20_001).window
    current = whole.current.copy()
    current[1] = 2.0
    windows = [replace(whole, current=current)]
    _, highest = parameter_ranges(SIGMOID, windows)["a2"]
    with ProcessPool() as processes:
        (profile,) = profiles_of(good, windows, ["a2"], processes)
    assert profile.values[-1] == highest
    with pytest.raises(ValueError, match="no parameter 'b9' to profile: use f0"):
        profiles_of(good, windows, ["b9"], processes)


def test_a_fit_at_its_minimum_stays(strokes: list[Window], good: GlobalFit) -> None:
    with ProcessPool() as processes:
        fit, (profile,) = profiled(good, strokes, ["a0"], QUICK, processes)
    assert fit is good
    assert profile.contains(good.parameter_set.as_dict()["a0"])


def test_a_profile_that_finds_a_lower_minimum_starts_the_fit_again(
    strokes: list[Window], good: GlobalFit
) -> None:
    with ProcessPool() as processes:
        (before,) = profiles_of(off(good), strokes, ["a0"], processes)
        fit, (profile,) = profiled(off(good), strokes, ["a0"], QUICK, processes)
    assert not before.contains(off(good).parameter_set.as_dict()["a0"])
    # Relative difference of costs at one minimum, due to the tolerance of the search.
    assert fit.cost == pytest.approx(good.cost, rel=1e-3)
    assert profile.contains(fit.parameter_set.as_dict()["a0"])
    assert np.isfinite(profile.lowest).all()
