"""Contents of a window report, and the errors of records, singly and pooled."""

import math
from dataclasses import replace

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.error_sums import ErrorSums, RunningError, pooled
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.force_scale import ForceScale
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.window_assembler import RawWindow

TRUE = ParameterSet(known.PLAUSIBLE, set_id="true")


def test_a_set_that_cannot_be_bettered_is_confirmed() -> None:
    made = known.tracker(TRUE)
    reports = known.fed(made, *(known.window(number) for number in range(8)))
    refused = [report for report in reports if not report.accepted]
    assert refused
    assert {report.verdict for report in refused} == {Verdict.NO_BETTER}
    assert all(report.confirms for report in reports)


def with_misfit(raw: RawWindow) -> RawWindow:
    """The window with a periodic force added (7 Hz) that the law cannot follow."""
    time = 1e-9 * raw.start_ns + raw.period * np.arange(raw.force.size)
    return replace(raw, force=raw.force + 60.0 * np.sin(2.0 * np.pi * 7.0 * time))


@pytest.fixture(scope="module")
def misfitted() -> tuple[Report, ParameterSet]:
    made = known.tracker()
    run = known.run(samples=3000)
    windows = (with_misfit(known.raw_window(run, number=n)) for n in range(2))
    reports = known.fed(made, *windows)
    return reports[-1], made.parameters


def test_a_misfit_that_repeats_is_told_apart_from_what_scatters(
    misfitted: tuple[Report, ParameterSet],
) -> None:
    report, _ = misfitted
    assert np.all(report.coefficient_discrepancies > report.coefficient_errors)
    assert report.scale.discrepancy > report.scale.standard_error
    _, found = misfitted
    seen = found.observable
    assert np.all(found.discrepancies[seen] < found.standard_errors[seen])
    # Of the standard error: noise of 5.5 N averages out; a misfit of 42 N does not.
    assert np.all(found.discrepancies[seen] > 0.7 * found.standard_errors[seen])
    assert np.isnan(found.discrepancies[~seen]).all()


def test_nothing_is_told_of_a_window_that_was_not_fitted() -> None:
    (report,) = known.fed(known.tracker(), replace(known.window(), force=np.full(1000, 5.0)))
    assert math.isnan(report.nrmse_after)
    assert math.isnan(report.amplitude)
    assert np.isnan(report.coefficients).all()
    assert report.method == "least_squares"
    assert report.current == pytest.approx(1.0)


def test_a_line_says_what_is_in_use_and_leaves_out_what_is_not_known() -> None:
    (report,) = known.fed(known.tracker(), known.window())
    assert report.line.startswith("window-1 is in use: NRMSE ")
    assert "5 mm" in report.line
    assert "nan" not in report.line
    assert replace(report, scale=ForceScale(0.998, 1.2e-4)).line.endswith("0.9980 ± 0.00012")


# -- RMSE, NRMSE and R² of records, singly and pooled ----------------------------------------------

ROUNDING = 1e-9
"""Relative: sums for means and standard deviations of the samples."""

RNG = np.random.default_rng(7)
MEASURED = 300.0 + RNG.normal(0.0, 100.0, 1000)
PREDICTED = MEASURED + RNG.normal(3.0, 10.0, 1000)


@given(cuts=st.lists(st.integers(0, 1000), max_size=5))
def test_records_taken_together_are_one_record(cuts: list[int]) -> None:
    parts = np.split(np.arange(1000), sorted(cuts))
    together = pooled(ErrorSums.of(PREDICTED[part], MEASURED[part]) for part in parts)
    whole = ErrorSums.of(PREDICTED, MEASURED)
    assert together.count == whole.count
    assert together.nrmse == pytest.approx(whole.nrmse, rel=ROUNDING)


def test_the_running_error_is_the_nrmse_of_what_lies_within_the_memory() -> None:
    rng = np.random.default_rng(1)
    measured = 300.0 + rng.normal(0.0, 100.0, 1000)
    predicted = measured + rng.normal(3.0, 10.0, 1000)
    running = RunningError(memory=0.5)
    for block in np.split(np.arange(1000), 100):
        running.add(predicted[block], measured[block], 1e-3)
    recent = slice(500, None)
    error = predicted[recent] - measured[recent]
    expected = math.sqrt(np.mean(error**2)) / np.std(measured[recent])
    assert running.nrmse == pytest.approx(expected, rel=ROUNDING)
    assert running.duration == pytest.approx(0.5)
