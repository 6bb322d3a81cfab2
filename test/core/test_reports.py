"""A report says in fields what became of a window, and whether it confirms the set in use."""

from __future__ import annotations

import math
from dataclasses import replace

import known
import numpy as np
import pytest

from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.tracking.acceptance import AcceptanceSettings, Verdict
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.tracker import WindowTracker
from mr_damper_ros.tracking.tracker_settings import TrackerSettings
from mr_damper_ros.tracking.window_assembler import RawWindow

TRUE = ParameterSet(known.PLAUSIBLE, set_id="true")
WEAK = ParameterSet(
    known.PLAUSIBLE * np.where(np.arange(16) == known.index("f0"), 0.8, 1.0), set_id="weak"
)


def window(number: int = 0, strength: float = 1.0, noise: float = known.NOISE) -> RawWindow:
    parameters = known.PLAUSIBLE * np.where(np.arange(16) == known.index("f0"), strength, 1.0)
    run = known.run(parameters, samples=1000, seed=number, noise=noise)
    return known.raw_window(run, number=number)


def followed(tracker: WindowTracker, raw: RawWindow) -> Report:
    report = tracker.follow(raw)
    assert report is not None
    return report


def tracker(start: ParameterSet, **settings: float) -> WindowTracker:
    acceptance = AcceptanceSettings(**settings)
    return WindowTracker(TrackerSettings(method="least_squares", acceptance=acceptance), start)


def test_a_better_set_is_accepted_and_confirmed() -> None:
    report = followed(tracker(WEAK), window())
    assert (report.verdict, report.accepted, report.confirms) == (Verdict.ACCEPTED, True, True)
    assert report.set_id == "window-1"


def test_a_set_that_cannot_be_bettered_is_confirmed() -> None:
    made = tracker(TRUE)
    reports = [followed(made, window(number)) for number in range(8)]
    refused = [report for report in reports if not report.accepted]
    assert refused
    assert {report.verdict for report in refused} == {Verdict.NO_BETTER}
    assert all(report.confirms for report in reports)


@pytest.mark.parametrize(
    ("spoilt", "verdict"),
    [
        (replace(window(9), force=np.zeros(1000)), Verdict.FAULT_OF_DATA),
        (window(9, noise=20.0 * known.NOISE), Verdict.DISTURBED),
        (window(9, strength=3.0), Verdict.UNCONFIRMED),
    ],
    ids=lambda item: item.name if isinstance(item, Verdict) else "",
)
def test_a_window_that_is_no_good_confirms_nothing(spoilt: RawWindow, verdict: Verdict) -> None:
    made = tracker(WEAK)
    followed(made, window(0))
    report = followed(made, spoilt)
    assert report.verdict is verdict
    assert not report.accepted
    assert not report.confirms
    assert report.reason
    assert report.set_id == "window-1"


def test_a_fit_that_explains_too_little_confirms_nothing() -> None:
    report = followed(tracker(WEAK, maximum_nrmse=1e-3), window())
    assert (report.verdict, report.confirms) == (Verdict.POOR_FIT, False)


def test_nothing_is_told_of_a_window_that_was_not_fitted() -> None:
    report = followed(tracker(WEAK), replace(window(), force=np.full(1000, 5.0)))
    assert math.isnan(report.nrmse_after)
    assert math.isnan(report.amplitude)
    assert np.isnan(report.coefficients).all()
    assert report.method == "least_squares"
    assert report.current == pytest.approx(1.0)
