"""A report says in fields what became of a window, and whether it confirms the set in use."""

from __future__ import annotations

import math
from dataclasses import replace

import known
import numpy as np
import pytest

from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.tracking.acceptance import Verdict
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
    """A force in which something repeats with every cycle of 1 Hz that the law does not follow."""
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
    # Of the error; noise of 5.5 N would average out, a misfit of 42 N does not.
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
