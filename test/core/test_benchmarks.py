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
    drift,
    exports,
    faults,
    following,
    force_step,
    foreign_dampers,
    healthy,
    honest_errors,
    inverse,
    jitter,
    kinematics,
    load_cell_spikes,
    many_recordings,
    noise_limit,
    planned_runs,
    repeated_evolution,
    rig_troubles,
    step_current,
    switched_current,
    thread_load,
    topic_pairing,
    utfsm_left_out,
    utfsm_sixteen,
    whole_damper,
    window_refit,
)
from benchmarks.dampers import clean_windows, steady_window
from benchmarks.fault_scenarios import SCENARIOS
from benchmarks.figure import Figure, Pair, table
from benchmarks.timing import interleaved_medians
from mr_damper_ros.emulation.emulator import scaled
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.models.published import find, parameters
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES
from mr_damper_ros.rig_check.record import Trouble
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tracking.tracker import TrackerSettings
from studies import recordings

CONDITION = "5.0mm_1Hz_1.5A"

KEYS = [
    *("pairing_error_ms", "pairing_invented", "pairing_miscounted", "pairing_joined"),
    *("check_rig_named", "check_rig_invented"),
    *("window_nm_speedup", "window_nm_ms", "window_ls_speedup", "global_speedup", "global_s"),
    *("de100_s", "crlb_ratio", "coverage_percent"),
    *("drift_scale_error_p95_percent", "drift_nrmse_ratio", "step_windows"),
    *("ukf_drift_scale_error_p95_percent", "ukf_step_windows"),
    *("utfsm_sixteen_nrmse", "utfsm_extended_nrmse", "utfsm_one_set"),
    "utfsm_series_springs_nrmse",
    *("utfsm_bingham_nrmse", "utfsm_hyperbolic_tangent_nrmse", "utfsm_nonlinear_biviscous_nrmse"),
    *("utfsm_bouc_wen_nrmse", "utfsm_modified_bouc_wen_nrmse"),
    *("utfsm_left_out_sixteen_nrmse", "utfsm_left_out_extended_nrmse"),
    *("utfsm_left_out_springs_nrmse", "utfsm_left_out"),
    *("earthquake_online_fit", "earthquake_online_sixteen_fit", "earthquake_online_springs_fit"),
    "earthquake_static_springs_fit",
    *("earthquake_static_fit", "earthquake_static_mean", "earthquake_static_sixteen_fit"),
    *("stream_nrmse_ratio", "jitter_valid", "jitter_valid_of_clean", "jitter_nrmse_ratio"),
    *("fault_cases", "wrong_valid_s", "wrong_valid_longest_s", "recovery_windows"),
    *("misfit_error_ratio", "scale_chi2", "ar1_error_ratio", "needless_exchanges"),
    *("switched_accepted", "switched_nrmse", "switched_nrmse_ratio"),
    *("switched_drift_scale_error_p95_percent", "cold_start_windows", "cold_start_largest_force"),
    *("step_current_nrmse_ratio", "step_current_paired_ratio", "step_current_nrmse"),
    *("reversal_jump", "reversal_jump_smoothed"),
    *("many_overhead_percent", "many_dask_overhead_percent", "threads_cpu_ratio"),
    *("starts_agreeing", "profile_contains_estimate"),
    *("planned_runs", "planned_runs_saved", "planned_runs_inside", "planned_runs_claim"),
    "planned_runs_bound",
    *("export_c_error", "export_c_warnings", "export_c_us_per_step", "export_fmu_problems"),
    *("inverse_miss_of_span", "inverse_us_per_sample"),
    *("bad_set_taken", "healthy_valid_percent", "healthy_wrong_valid_s"),
    *("foreign_wrong_valid_s", "foreign_right_refused_percent", "foreign_worse_sets"),
    "spike_wrong_valid_s",
]
FEW_FAULTS = {"force_hum:20": Trouble.HUM, "force_gain:-1": Trouble.INVERTED}
FAST = TrackerSettings(method="least_squares", global_period=0)

NOISE_OF_300 = 0.15
"""Relative: 300 samples tell the noise to 4.1 %, of which a fit takes 1.2 %."""

VARIANCE_OF_60 = 0.4
"""Of a ratio of 1: two standard errors of a variance from 60 draws."""

COVERAGE_OF_60 = 0.88
"""Least share of 95 % intervals: 60 fits tell it to 2.8 %, as their coefficients are correlated."""

END_OF_THE_DRIFT = 0.3
"""[degC]: a cycle of this short drift heats by 0.7 K, and not evenly."""

FOLLOWED = 0.01
"""Relative error of the scale: the force falls by 0.4 % a second, and a window is 2 s long."""

FITTED = 0.01
"""NRMSE: the noise is 0.6 to 0.7 % of the force."""

PREDICTED = (1.0, 3.0)
"""NRMSE over that of fresh fits, which are the best there is; the force drifts in between."""

SOON = 0.5
"""Windows: four of the looks between two windows."""

SAMPLED_PEAKS = 1e-5
"""Relative: the peaks lie up to half a sample, pi/1000 of phase, from the samples next to them."""

AT_THE_NOISE = 1.6
"""Median NRMSE [%]: the noise is 2.0 % and 0.8 % of the forces."""


thirty_windows = cache(clean_windows)


@cache
def heated() -> Recording:
    """A minute in which the damper heats from 28 to 71 degrees."""
    return drift.bag(60.0)


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
    monkeypatch.setattr(bench, "FULL", {"some": lambda: figures})
    output = tmp_path / "build" / "bench.json"
    assert bench.main(["--output", str(output)]) == 0
    assert json.loads(output.read_text()) == {"a": 1.0, "b": None, "c": [1.0]}
    assert "not the figures" not in capsys.readouterr().out


def test_a_quick_run_says_that_it_is_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "FULL", {"some": lambda: [Figure("a", 1.0, "x")]})
    monkeypatch.setattr(bench, "QUICK", {"some": lambda: [Figure("a", 2.0, "x")]})
    bench.main(["--quick", "--output", str(tmp_path / "bench.json")])
    assert "these are not the figures" in capsys.readouterr().out


def test_every_key_is_measured_once(monkeypatch: pytest.MonkeyPatch) -> None:
    # Without recordings, and with the long measurements replaced by short ones.
    monkeypatch.delenv("MR_DAMPER_DATA", raising=False)
    for module in (exports, inverse):
        monkeypatch.setattr(module, "CONDITIONS", module.CONDITIONS[:1])
        monkeypatch.setattr(module, "POINTS", 100)
    monkeypatch.setattr(switched_current, "SETTLED", 3.0)
    monkeypatch.setattr(jitter, "SETTLED", 2.0)
    monkeypatch.setattr(jitter, "_SETS", {"thesis": jitter._SETS["thesis"]})
    short = {
        **bench.FULL,
        "window_refit": lambda: window_refit.figures(1, (CONDITION,), 1000),
        "whole_damper": lambda: whole_damper.figures(1, 1, thirty_windows()[:2]),
        "repeated_evolution": lambda: repeated_evolution.figures(1, 1, 1),
        "noise_limit": lambda: noise_limit.figures(2, 1000),
        "honest_errors": lambda: honest_errors.figures(6, 2, 8),
        "switched_current": lambda: switched_current.figures(5.0, switched_current.CASES[:1]),
        "step_current": lambda: step_current.figures(step_current.CASES[:1], (0.2, 1.0), (0.2,)),
        "drift": lambda: drift.figures(8.0),
        # It identifies for minutes: test_series_springs.py.
        "state_law": list,
        # They drive and shake for minutes: test_plants.py, test_control_report.py.
        "car_on_roads": list,
        # It drives, too: test_whole_loop.py.
        "whole_loop": list,
        "building_cases": list,
        # It takes what a damper needs to be known: test_force_controller.py.
        "force_tracking": list,
        "force_step": lambda: force_step.figures((0.5,)),
        "kinematics": lambda: kinematics.figures(1),
        "faults": lambda: faults.figures_of(
            faults.measure(SCENARIOS[:1], ("viscous_tanh",), processes=1)
        ),
        "healthy": lambda: healthy.figures_of(
            healthy.measure(healthy.PROGRAMMES[4:5], ("viscous_tanh",), ("sigmoid",), 1)
        ),
        "foreign_dampers": lambda: foreign_dampers.figures_of(
            foreign_dampers.measure(foreign_dampers.COMBINATIONS[41:42], processes=1)
        ),
        "load_cell_spikes": lambda: load_cell_spikes.figures(
            load_cell_spikes.STREAMS[2:3], (8000,)
        ),
        # It identifies three times: test_validity.py.
        "block_sizes": list,
        # These need ROS: test/ros/test_node_benchmarks.py.
        "streaming_load": list,
        "command_latency": list,
        "single_sample": list,
        "live_page": list,
        "lossy_link": list,
        "eight_rigs": list,
        "hostile_messages": list,
        "supply_safety": list,
        "topic_samples": list,
        "rig_troubles": lambda: rig_troubles.figures(FEW_FAULTS, (0,), ("steps",)),
        "topic_pairing": lambda: topic_pairing.figures(4.0),
        "jitter": lambda: jitter.figures(4.0, (10,), (200.0,)),
        "many_recordings": lambda: many_recordings.figures(4, 4),
        "thread_load": lambda: thread_load.figures(1, 1),
        "planned_runs": lambda: planned_runs.figures_of(
            [planned_runs.PlannedTrial("some", 4.0, 0.01, 0.01, 0.02, inside=True, random=12.0)]
        ),
    }
    found = [figure for name in bench.FULL for figure in short[name]()]
    assert sorted(figure.key for figure in found) == sorted(KEYS)
    assert all(figure.definition for figure in found)
    assert all(figure.note for figure in found if figure.value is None)


def test_the_faults_of_a_rig_are_named_and_none_invented() -> None:
    assert [f.reached for f in rig_troubles.figures(FEW_FAULTS, (0,), ("steps",))] == ["yes"] * 2


def test_a_fault_that_is_not_named_and_one_that_is_invented_are_counted() -> None:
    wrong = {"force_hum:20": Trouble.SWAPPED}
    named, invented = rig_troubles.figures(wrong, (0,), ())
    assert (named.value, invented.value) == (0.0, 1.0)
    assert "force_hum:20 (seed 0)" in named.note


def test_topics_are_paired_and_their_losses_counted() -> None:
    figures = {figure.key: figure for figure in topic_pairing.figures(4.0)}
    assert figures["pairing_error_ms"].reached == "yes"
    assert figures["pairing_invented"].reached == "yes"
    assert figures["pairing_miscounted"].reached == "yes"
    assert figures["pairing_joined"].value == pytest.approx(0.97, abs=0.02)


def test_medians_are_taken_of_works_that_ran_in_turn() -> None:
    calls: list[str] = []
    medians = interleaved_medians((lambda: calls.append("a"), lambda: calls.append("b")), (2, 6))
    assert "".join(calls) == "abbbabbb"
    assert len(medians) == 2


# -- what is measured ------------------------------------------------------------------------


def test_the_reference_reaches_the_noise_from_a_near_start() -> None:
    truth = parameters(find(CONDITION))
    window = steady_window(scaled(truth, 0.99), find(CONDITION), samples=300, seed=2)
    found, norm = window_refit.reference_fit(window, np.array(truth))
    assert found.shape == (16,)
    assert norm / math.sqrt(300) == pytest.approx(known.NOISE, rel=NOISE_OF_300)


def test_a_refit_is_compared_at_the_same_residual() -> None:
    refit = window_refit.measure(CONDITION, repetitions=1, samples=1000)
    assert max(refit.residual_ratios) < window_refit.RESIDUAL_LIMIT


def test_the_reference_search_stays_within_the_bounds_it_is_given() -> None:
    windows = thirty_windows()[:2]
    found = known.PLAUSIBLE
    bounds = dict(zip(PARAMETER_NAMES, whole_damper.search_bounds(windows, found), strict=True))
    assert bounds["f0"] == (-120.0, 120.0)
    assert bounds["k2"] == (-100.0, 100.0)
    assert all(low < high for low, high in bounds.values())


def test_the_thirty_clean_conditions_are_whole() -> None:
    windows = thirty_windows()
    assert [window.sample_count for window in windows] == [7001] * 30


def test_repeated_searches_do_not_depend_on_the_number_of_workers() -> None:
    alone, shared = (
        [cost for cost, _ in repeated_evolution.all_runs(3, 2, workers)] for workers in (1, 2)
    )
    assert alone == shared


@pytest.fixture(scope="module")
def scatter() -> noise_limit.Scatter:
    return noise_limit.scatter(60, 500)


def test_the_scatter_is_that_of_the_bound(scatter: noise_limit.Scatter) -> None:
    assert scatter.errors.shape == (60, 7)
    assert np.mean(scatter.ratios) == pytest.approx(1.0, abs=VARIANCE_OF_60)


def test_most_intervals_and_not_all_hold_the_truth(scatter: noise_limit.Scatter) -> None:
    assert COVERAGE_OF_60 < scatter.coverage < 1.0


def test_the_thermal_model_reaches_71_degrees_in_the_time_given() -> None:
    run = heated()
    assert run.temperature is not None
    assert run.temperature[0] == pytest.approx(28.0)
    assert run.temperature[-1] == pytest.approx(71.0, abs=END_OF_THE_DRIFT)


@pytest.mark.parametrize("tracker", ["window", "recursive"])
def test_a_drift_is_followed_and_compared_with_the_truth(tracker: str) -> None:
    settings = TrackerSettings(tracker=tracker, method="least_squares", global_period=0)
    found = drift.measure(heated(), settings)
    assert found.scale_errors.size > 40
    assert found.scale_error_p95 < FOLLOWED
    assert found.predicted.shape == found.fitted.shape
    assert np.all(found.fitted < FITTED)
    assert PREDICTED[0] < found.nrmse_ratio < PREDICTED[1]


def test_a_step_is_counted_in_windows_from_when_it_comes() -> None:
    assert 0.0 < force_step.windows_until_right(0.5, FAST) < SOON


def test_a_step_that_is_never_followed_counts_as_infinite(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = following.follow(following.recording(drift.DAMPER, 4.0, seed=0), FAST)[:1]
    monkeypatch.setattr(following, "follow", lambda run, settings: wrong)
    assert force_step.windows_until_right(0.0, FAST) == math.inf


def test_scale_of_a_loop_against_another() -> None:
    loop = np.sin(np.arange(50.0))
    assert following.scale_of(0.8 * loop, loop) == pytest.approx(0.8)
    assert math.isnan(following.scale_of(loop, np.zeros(50)))


# -- recordings ------------------------------------------------------------------------------


def test_without_recordings_the_figure_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MR_DAMPER_DATA", raising=False)
    (figure,) = utfsm_sixteen.figures()
    assert figure.value is None
    assert "MR_DAMPER_DATA is not set" in figure.note


def write_record(folder: Path, name: str, run: known.Run) -> None:
    """A text file as the recordings are, of a run of 1000 samples."""
    folder.mkdir(exist_ok=True)
    columns = (np.arange(1000) * 1e-3, 1e3 * run.displacement, 1e3 * run.velocity, run.force)
    np.savetxt(folder / f"{name}.txt", np.column_stack(columns))


def test_a_motion_is_predicted_by_the_set_of_the_others(tmp_path: Path) -> None:
    # The same peak velocity: what is seen of one motion holds for the other.
    for name, amplitude, frequency in (("5mm2Hz", 5e-3, 2.0), ("2x5mm4Hz", 2.5e-3, 4.0)):
        for ampere, current in (("0x5", 0.5), ("1", 1.0)):
            run = known.run(amplitude=amplitude, frequency=frequency, current=current, samples=1000)
            write_record(tmp_path / "processed", f"{name}{ampere}A", run)
    median, mean = utfsm_left_out.left_out_nrmse(tmp_path, "sigmoid")
    alone = [
        100.0 * known.NOISE / np.std(window.force)
        for window in recordings.processed_windows(tmp_path)
    ]
    assert median == pytest.approx(np.median(alone), rel=NOISE_OF_300)
    assert mean == pytest.approx(np.mean(alone), rel=NOISE_OF_300)


def test_records_are_read_with_the_current_in_their_name(tmp_path: Path) -> None:
    folder = tmp_path / "processed"
    write_record(folder, "5mm1Hz0x25A", known.run(samples=1000))
    (window,) = recordings.processed_windows(tmp_path)
    assert set(window.current) == {0.25}
    assert np.ptp(window.motion.displacement) == pytest.approx(0.01, rel=SAMPLED_PEAKS)
    (folder / "unknown.txt").write_text("1 2 3 4\n")
    with pytest.raises(ValueError, match="does not end with a current"):
        recordings.processed_windows(tmp_path)


def test_the_median_error_of_one_set_for_all_windows() -> None:
    windows = [known.run(current=i, samples=500).window for i in (0.3, 1.2)]
    quick = EvolutionSettings(generations=20, population=8)
    assert utfsm_sixteen.median_nrmse_percent(windows, quick) < AT_THE_NOISE
