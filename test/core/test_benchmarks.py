"""The figures' own functions, on inputs so small that nothing is timed."""

from __future__ import annotations

import json
import math
from functools import cache
from pathlib import Path

import known
import numpy as np
import pytest

from benchmarks import (
    bench,
    fit_times,
    following,
    noise_limit,
    rig_troubles,
)
from benchmarks.dampers import clean_windows, steady_window
from benchmarks.figure import Figure, Pair, table
from mr_damper_ros.emulation.emulator import scaled
from mr_damper_ros.models.published import find, parameters
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES
from mr_damper_ros.rig_check.record import Trouble
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tracking.tracker import TrackerSettings
from studies import recordings

CONDITION = "5.0mm_1Hz_1.5A"

FEW_FAULTS = {"force_hum:20": Trouble.HUM, "force_gain:-1": Trouble.INVERTED}
FAST = TrackerSettings(method="least_squares", global_period=0)


PREDICTED = (1.0, 3.0)
"""NRMSE over that of fresh fits, which are the best there is; the force drifts in between."""


thirty_windows = cache(clean_windows)


@cache
def heated() -> Recording:
    """A minute in which the damper heats from 28 to 71 degrees."""
    return following.heated_run(60.0)


# -- figures and the program -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "bar", "reached"),
    [
        (1.0, (0.0, 1.1), "yes"),
        (1.2, (0.0, 1.1), "no"),
        (95.0, (93.0, 97.0), "yes"),
        (25.0, (20.0, math.inf), "yes"),
        (math.inf, (0.0, 2.0), "no"),
        ([81.0, 79.0], (80.0, 100.0), "no"),
        ([0.0, 2.0], [(0.0, 0.0), (0.0, 2.0)], "yes"),
        ([1.0, 1.0], [(0.0, 0.0), (0.0, 2.0)], "no"),
        (None, (0.0, 1.0), "-"),
        (3.0, None, "-"),
    ],
)
def test_a_figure_knows_whether_it_reaches_its_bar(
    value: float | list[float] | None, bar: Pair | list[Pair] | None, reached: str
) -> None:
    assert Figure("key", value, "what", bar).reached == reached


def test_the_table_shows_every_figure_with_its_definition() -> None:
    figures = [
        Figure("one", 1.5, "first thing", (0.0, 2.0)),
        Figure("two", None, "second thing", note="no data"),
        Figure("three", [1.0, 2.0], "third thing", (1.0, math.inf)),
    ]
    lines = table(figures).splitlines()
    assert lines[1].split()[:5] == ["one", "1.5", "<=", "2", "yes"]
    assert "not measured" in lines[2]
    assert lines[2].endswith("second thing no data")
    assert "1, 2" in lines[3]


def test_the_program_writes_one_flat_object_and_prints_the_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = [Figure("a", 1.0, "x"), Figure("b", math.inf, "y"), Figure("c", [1.0], "z")]
    monkeypatch.setattr(bench, "PARTS", {"some": "x.y"})
    monkeypatch.setattr(bench, "measure", lambda function, arguments: figures)
    output = tmp_path / "build" / "bench.json"
    assert bench.main(["--output", str(output)]) == 0
    assert json.loads(output.read_text()) == {"a": 1.0, "b": None, "c": [1.0]}
    assert "not the figures" not in capsys.readouterr().out


def test_the_faults_of_a_rig_are_named_and_none_invented() -> None:
    assert [f.reached for f in rig_troubles.figures(FEW_FAULTS, (0,), ("steps",))] == ["yes"] * 2


def test_a_fault_that_is_not_named_and_one_that_is_invented_are_counted() -> None:
    wrong = {"force_hum:20": Trouble.SWAPPED}
    named, invented = rig_troubles.figures(wrong, (0,), ())
    assert (named.value, invented.value) == (0.0, 1.0)
    assert "force_hum:20 (seed 0)" in named.note


# -- what is measured ------------------------------------------------------------------------


def test_the_reference_reaches_the_noise_from_a_near_start() -> None:
    truth = parameters(find(CONDITION))
    window = steady_window(scaled(truth, 0.99), find(CONDITION), samples=300, seed=2)
    found, norm = fit_times.reference_fit(window, np.array(truth))
    assert found.shape == (16,)
    # Relative: 300 samples tell the noise to 4.1 %, of which a fit takes 1.2 %.
    assert norm / math.sqrt(300) == pytest.approx(known.NOISE, rel=0.15)


def test_a_refit_is_compared_at_the_same_residual() -> None:
    refit = fit_times.measured_refit(CONDITION, repetitions=1, samples=1000)
    assert max(refit.residual_ratios) < fit_times.RESIDUAL_LIMIT


def test_the_reference_search_stays_within_the_bounds_it_is_given() -> None:
    windows = thirty_windows()[:2]
    found = known.PLAUSIBLE
    bounds = dict(zip(PARAMETER_NAMES, fit_times.search_bounds(windows, found), strict=True))
    assert bounds["f0"] == (-120.0, 120.0)
    assert bounds["k2"] == (-100.0, 100.0)
    assert all(low < high for low, high in bounds.values())


@pytest.fixture(scope="module")
def scatter() -> noise_limit.Scatter:
    return noise_limit.scatter(60, 500)


def test_the_scatter_is_that_of_the_bound(scatter: noise_limit.Scatter) -> None:
    assert scatter.errors.shape == (60, 7)
    # Of a ratio of 1: two standard errors of a variance from 60 draws.
    assert np.mean(scatter.ratios) == pytest.approx(1.0, abs=0.4)


def test_most_intervals_and_not_all_hold_the_truth(scatter: noise_limit.Scatter) -> None:
    # Least share of 95 % intervals: 60 fits tell it to 2.8 %, as their coefficients are correlated.
    assert 0.88 < scatter.coverage < 1.0


def test_the_thermal_model_reaches_71_degrees_in_the_time_given() -> None:
    run = heated()
    assert run.temperature is not None
    assert run.temperature[0] == pytest.approx(28.0)
    # [degC]: a cycle of this short drift heats by 0.7 K, and not evenly.
    assert run.temperature[-1] == pytest.approx(71.0, abs=0.3)


@pytest.mark.parametrize("tracker", ["window", "recursive"])
def test_a_drift_is_followed_and_compared_with_the_truth(tracker: str) -> None:
    settings = TrackerSettings(tracker=tracker, method="least_squares", global_period=0)
    found = following.drift_of(heated(), settings)
    assert found.scale_errors.size > 40
    # Relative error of the scale: the force falls by 0.4 % a second, and a window is 2 s long.
    assert found.scale_error_p95 < 0.01
    assert found.predicted.shape == found.fitted.shape
    # NRMSE: the noise is 0.6 to 0.7 % of the force.
    assert np.all(found.fitted < 0.01)
    assert PREDICTED[0] < found.nrmse_ratio < PREDICTED[1]


def test_a_step_is_counted_in_windows_from_when_it_comes() -> None:
    # Windows: four of the looks between two windows.
    assert 0.0 < following.windows_until_right(0.5, FAST) < 0.5


def test_a_step_that_is_never_followed_counts_as_infinite(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = following.follow(following.recording(following.DAMPER, 4.0, seed=0), FAST)[:1]
    monkeypatch.setattr(following, "follow", lambda run, settings: wrong)
    assert following.windows_until_right(0.0, FAST) == math.inf


def test_scale_of_a_loop_against_another() -> None:
    loop = np.sin(np.arange(50.0))
    assert following.scale_of(0.8 * loop, loop) == pytest.approx(0.8)
    assert math.isnan(following.scale_of(loop, np.zeros(50)))


# -- recordings ------------------------------------------------------------------------------


def write_record(folder: Path, name: str, run: known.Run) -> None:
    """A text file as the recordings are, of a run of 1000 samples."""
    folder.mkdir(exist_ok=True)
    columns = (np.arange(1000) * 1e-3, 1e3 * run.displacement, 1e3 * run.velocity, run.force)
    np.savetxt(folder / f"{name}.txt", np.column_stack(columns))


def test_records_are_read_with_the_current_in_their_name(tmp_path: Path) -> None:
    folder = tmp_path / "processed"
    write_record(folder, "5mm1Hz0x25A", known.run(samples=1000))
    (window,) = recordings.processed_windows(tmp_path)
    assert set(window.current) == {0.25}
    # Relative: the peaks lie up to half a sample, pi/1000 of phase, from the samples next to them.
    assert np.ptp(window.motion.displacement) == pytest.approx(0.01, rel=1e-5)
    (folder / "unknown.txt").write_text("1 2 3 4\n")
    with pytest.raises(ValueError, match="does not end with a current"):
        recordings.processed_windows(tmp_path)
