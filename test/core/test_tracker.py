"""The tracker follows a damper that drifts, and ignores all other influences."""

import dataclasses
import itertools
import math
from typing import Any

import known
import numpy as np
import pytest

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import GlobalFit, identify_global
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import LITERATURE, THESIS_28_CELSIUS
from mr_damper_ros.models.sigmoid.law import SCALE_INDICES, sine_force
from mr_damper_ros.tracking import tracker as tracking
from mr_damper_ros.tracking.acceptance import Evidence, Verdict
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.tracker import TrackerSettings, WindowTracker
from mr_damper_ros.tracking.window_assembler import RawWindow

SAMPLES = 1000
WINDOWS = 30

SCALE_ERROR = 0.01
"""Largest error of the reported force scale."""

FITTED = 2.0
"""RMSE [N] of a set fitted to one window; the noise in 1000 samples causes 0.5 N."""

SINE_ERROR = 1e-3
"""Relative error of amplitude, frequency and peak velocity of a sine without noise."""


def experienced(**settings: object) -> WindowTracker:
    """A tracker after five normal windows."""
    tracked = known.tracker(**settings)
    known.fed(tracked, *(known.window(number) for number in range(5)))
    assert tracked.accepted_windows > 0
    return tracked


def error_of(parameters: ParameterSet, run: known.Run | None = None) -> float:
    """RMSE [N] of a set against the true force of a run."""
    run = run or known.run(seed=None)
    predicted = sine_force(
        parameters.values, run.displacement, run.velocity, run.acceleration, run.current
    )
    return known.rms(predicted - run.clean)


def drifting(number: int, noise: float = known.NOISE) -> tuple[RawWindow, float]:
    """Window of the thesis' damper while it heats from 28 to 71 °C, and its true force scale."""
    run = known.run(
        THESIS_28_CELSIUS, current=1.5, samples=SAMPLES, start=number * SAMPLES * 1e-3, seed=None
    )
    clean = known.drifting_force(run, number / (WINDOWS - 1))
    error = np.random.default_rng(number).normal(0.0, noise, SAMPLES) if noise else 0.0
    changed = known.Run(**{**vars(run), "force": clean + error})
    scale = float(clean @ run.clean) / float(run.clean @ run.clean)
    return known.raw_window(changed, number=number, temperature=28.0 + number), scale


@pytest.fixture(scope="module", params=["nelder_mead", "least_squares"])
def drift(request: pytest.FixtureRequest) -> tuple[WindowTracker, list[Report], list[float]]:
    """A tracker that has followed the drift, its reports, and the true force scales."""
    tracked = known.tracker(ParameterSet(LITERATURE), method=request.param)
    pairs = [drifting(number) for number in range(WINDOWS)]
    return tracked, known.fed(tracked, *(w for w, _ in pairs)), [scale for _, scale in pairs]


Drift = tuple[WindowTracker, list[Report], list[float]]


def test_a_drift_is_followed_and_reported(drift: Drift) -> None:
    tracked, reports, truth = drift
    assert [report.reason for report in reports] == [""] * WINDOWS
    assert truth[-1] < 0.8, "the drift itself is missing"
    found = [report.scale.value for report in reports[1:]]
    np.testing.assert_allclose(found, truth[1:], rtol=SCALE_ERROR)
    errors = [
        (report.scale.value - true) / report.scale.standard_error
        for report, true in zip(reports[1:], truth[1:], strict=True)
    ]
    # Of a standard deviation of 1: 13 % for 29 windows, which share the error of the baseline.
    assert np.std(errors) == pytest.approx(1.0, abs=0.5)
    assert math.isnan(reports[0].scale.value)
    last, _ = drifting(WINDOWS - 1)
    run = known.run(
        THESIS_28_CELSIUS, current=1.5, samples=SAMPLES, start=(WINDOWS - 1) * 1.0, seed=None
    )
    hot = known.Run(**{**vars(run), "clean": known.drifting_force(run, 1.0)})
    assert error_of(tracked.parameters, hot) < FITTED
    assert tracked.parameters.set_id == reports[-1].set_id == f"window-{WINDOWS}"
    assert tracked.parameters.stamp_ns == last.end_ns
    report = reports[7]
    assert report.window_start_ns == known.T0 + 7 * known.NANOSECONDS
    assert report.stamp_ns == report.window_start_ns + 999_000_000
    assert report.sample_count == SAMPLES
    assert report.amplitude == pytest.approx(5e-3, rel=SINE_ERROR)
    assert report.frequency == pytest.approx(1.0, rel=SINE_ERROR)
    # Relative error of the reported peak velocity, 31.4 mm/s.
    assert report.peak_velocity == pytest.approx(0.0314, rel=1e-2)
    assert report.current == 1.5
    assert report.temperature == 35.0
    assert report.nrmse_after < report.nrmse_before
    assert report.evaluations > 7


# -- influences that must not change it ------------------------------------------------------


def burst(w: RawWindow) -> RawWindow:
    noise = np.zeros(SAMPLES)
    noise[300:400] = np.random.default_rng(0).normal(0.0, 150.0, 100)
    return dataclasses.replace(w, force=w.force + noise)


def spike(w: RawWindow) -> RawWindow:
    return dataclasses.replace(w, force=w.force + np.where(np.arange(SAMPLES) % 500 == 40, 5e3, 0))


def current_step(w: RawWindow) -> RawWindow:
    return dataclasses.replace(w, current=np.where(np.arange(SAMPLES) < 500, 1.0, 1.5))


def clipped(w: RawWindow) -> RawWindow:
    limit = 0.8 * w.force.max()
    return dataclasses.replace(w, force=np.clip(w.force, -limit, limit))


def stopped(w: RawWindow) -> RawWindow:
    return dataclasses.replace(w, displacement=np.full(SAMPLES, w.displacement[0]))


def millimetres(w: RawWindow) -> RawWindow:
    return dataclasses.replace(w, displacement=1e3 * w.displacement)


def reversed_force(w: RawWindow) -> RawWindow:
    return dataclasses.replace(w, force=-w.force)


def not_a_number(w: RawWindow) -> RawWindow:
    return dataclasses.replace(w, force=np.where(np.arange(SAMPLES) == 40, np.nan, w.force))


def samples_dropped_unseen(w: RawWindow) -> RawWindow:
    later = known.window(6)
    joined = [
        np.concatenate((a[:500], b[100:600]))
        for a, b in ((w.displacement, later.displacement), (w.force, later.force))
    ]
    return dataclasses.replace(w, displacement=joined[0], force=joined[1])


BAD_WINDOWS = {
    burst: "times the residual baseline: the running set",
    spike: "",
    current_step: "times the residual baseline: the running set",
    clipped: "the force is clipped",
    stopped: "the force changes as in a motion, but the displacement does not",
    millimetres: "is it in millimetres",
    reversed_force: "",
    not_a_number: "the force holds NaN",
    samples_dropped_unseen: "",
}


@pytest.mark.parametrize(
    ("spoil", "sentence"), BAD_WINDOWS.items(), ids=[f.__name__ for f in BAD_WINDOWS]
)
def test_a_bad_window_never_replaces_a_good_set_and_the_next_good_one_does(
    spoil: object, sentence: str
) -> None:
    tracked = experienced()
    good = tracked.parameters
    report = known.fed(tracked, spoil(known.window(5)))[0]  # type: ignore[operator]
    assert tracked.parameters is good
    assert not report.accepted
    assert report.reason != ""
    assert sentence in report.reason
    assert report.set_id == good.set_id
    assert known.fed(tracked, known.window(6, strength=0.9))[0].accepted
    weaker = known.weaker(0.9)
    assert error_of(tracked.parameters, known.run(weaker, seed=None)) < FITTED


def test_a_large_step_is_followed_once_it_is_confirmed() -> None:
    tracked = experienced()
    first, second = known.fed(tracked, known.window(5, strength=0.4), known.window(6, strength=0.4))
    assert (first.accepted, second.accepted) == (False, True)
    assert "waiting for the next window to confirm" in first.reason
    assert second.scale.value == pytest.approx(0.4, rel=SCALE_ERROR)


# -- parameter sets --------------------------------------------------------------------------


def test_after_a_window_the_scales_are_known_and_the_shape_is_not() -> None:
    tracked = experienced()
    shape = known.SHAPE
    assert np.isfinite(tracked.parameters.standard_errors[SCALE_INDICES]).all()
    assert tracked.parameters.observable[SCALE_INDICES].all()
    assert np.isnan(tracked.parameters.standard_errors[shape]).all()
    assert not tracked.parameters.observable[shape].any()
    np.testing.assert_array_equal(tracked.parameters.values[shape], known.weaker(0.8)[shape])


def known_over(
    *names: str, speeds: tuple[float, float], currents: tuple[float, float]
) -> WindowTracker:
    """A tracker of a nearly right set that is known over these ranges through these parameters."""
    tracked = known.tracker()
    observable = np.isin(tracked.parameters.law.parameter_names, ("f0", *names))
    tracked.replace(
        dataclasses.replace(
            tracked.parameters,
            values=known.weaker(0.97),
            observable=observable,
            peak_velocity_range=speeds,
            current_range=currents,
        )
    )
    return tracked


def test_a_window_at_one_current_does_not_narrow_the_range_that_a_user_states() -> None:
    ranges = {"peak_velocity_range": (0.0, 1.0), "current_range": (0.0, 2.0)}
    stated = ParameterSet(known.PLAUSIBLE, **ranges)
    tracked = WindowTracker(TrackerSettings(), stated)
    (report,) = known.fed(tracked, known.window(0, strength=0.8))
    assert report.accepted
    assert tracked.parameters.current_range == (0.0, 2.0)
    assert tracked.parameters.peak_velocity_range == (0.0, 1.0)


@pytest.mark.parametrize(("strength", "lowest"), [(0.7, 1.0), (1.0, 0.2)])
def test_a_law_holds_at_another_current_and_here_only_if_it_is_right_there(
    strength: float, lowest: float
) -> None:
    tracked = known_over("k2", speeds=(0.01, 0.1), currents=(0.2, 0.3))
    assert known.fed(tracked, known.window(0, strength=strength))[0].accepted
    assert tracked.parameters.current_range == (lowest, 1.0)


@pytest.mark.parametrize(("hysteresis", "kept"), [(1.0, True), (5.0, False)])
def test_a_law_keeps_its_range_unless_the_force_has_another_shape_within_it(
    hysteresis: float, kept: bool
) -> None:
    speeds = 0.01, 1.0
    tracked = known_over("a1", speeds=speeds, currents=(0.5, 1.5))
    values = tracked.parameters.values.copy()
    values[known.index("k4")] *= hysteresis
    tracked.replace(dataclasses.replace(tracked.parameters, values=values))
    reports = known.fed(tracked, *(known.window(number, strength=0.8) for number in range(2)))
    assert any(report.accepted for report in reports)
    assert (tracked.parameters.peak_velocity_range == speeds) is kept


def test_a_reset_goes_back_to_the_initial_set_and_forgets() -> None:
    tracked = experienced()
    tracked.reset()
    assert tracked.parameters.set_id == "start"
    assert tracked.accepted_windows == 0
    assert tracked.points.windows == ()
    assert math.isnan(known.fed(tracked, known.window(6))[0].scale.value)


# -- global identification -------------------------------------------------------------------

QUICK = EvolutionSettings(generations=25, population=8)


def toured(**settings: object) -> WindowTracker:
    """A tracker that has seen six operating points."""
    tracked = known.tracker(evolution=QUICK, **settings)
    number = 0
    for current in (0.3, 0.9, 1.4):
        for frequency in (1.0, 3.0):
            known.fed(tracked, known.window(number, current=current, frequency=frequency))
            number += 1
    return tracked


def test_a_search_falls_due_after_ever_more_windows_at_several_points() -> None:
    tracked = known.tracker(global_period=3)
    numbers = itertools.count()

    def due() -> bool:
        n = next(numbers)
        (report,) = known.fed(
            tracked, known.window(n, strength=1.0 - 0.05 * n, current=0.5 + 0.5 * (n % 2))
        )
        assert report.accepted
        return report.global_due

    assert [due(), due()] == [False, True]
    waited = []
    for _ in range(3):
        tracked.search()
        waited.append(next(count for count in itertools.count(1) if due()))
    assert waited == [2, 3, 3]


def test_a_search_improves_the_set_on_the_reservoir() -> None:
    tracked = toured()
    report = tracked.identify()
    assert report.accepted, report.reason
    assert report.nrmse_after < report.nrmse_before
    assert tracked.parameters.set_id == report.set_id
    assert tracked.parameters.observable[known.index("k2")]
    for current in (0.3, 0.9, 1.4):
        # RMSE [N] after a short search for the shape: twice the noise.
        assert error_of(tracked.parameters, known.run(current=current, seed=None)) < 10.0


def test_a_search_is_judged_against_the_running_set(monkeypatch: pytest.MonkeyPatch) -> None:
    tracked = toured()
    good = tracked.parameters
    monkeypatch.setattr(tracking, "evidence_of_search", lambda *_: Evidence(0.1, 0.1))
    report = tracked.identify()
    assert report.verdict is Verdict.NO_BETTER
    assert "running set predicts the reservoir as well" in report.reason
    assert tracked.parameters is good


def waiting() -> tuple[WindowTracker, ParameterSet]:
    """A tracker and the set that a due search found."""
    tracked = toured()
    good = tracked.parameters
    with pytest.MonkeyPatch.context() as patch:
        poor = Evidence(0.2, 0.1, recent=(0.2, 0.1))
        patch.setattr(tracking, "evidence_of_search", lambda *_: poor)
        outcome = tracking.run(tracked.search(asked=False))
    report = tracked.complete(outcome)
    assert report.verdict is Verdict.UNCONFIRMED
    assert tracked.parameters is good
    return tracked, outcome.found


def test_a_set_that_nobody_asked_for_is_in_use_once_a_window_confirms_it() -> None:
    tracked, found = waiting()
    before = tracked.accepted_windows
    (report,) = known.fed(tracked, known.window(9, current=1.4, frequency=3.0))
    assert report.accepted
    assert tracked.accepted_windows == before + 1
    assert report.set_id == tracked.parameters.set_id
    shape = known.SHAPE
    np.testing.assert_array_equal(tracked.parameters.values[shape], found.values[shape])


def test_a_window_of_a_faulty_sensor_leaves_a_set_waiting() -> None:
    tracked, found = waiting()
    good = tracked.parameters
    known.fed(tracked, not_a_number(known.window(9)))
    assert tracked.parameters is good
    known.fed(tracked, known.window(10, current=1.4, frequency=3.0))
    shape = known.SHAPE
    np.testing.assert_array_equal(tracked.parameters.values[shape], found.values[shape])


def test_windows_after_a_search_keep_the_shape_and_its_errors() -> None:
    tracked = toured()
    tracked.identify()
    found = tracked.parameters
    assert known.fed(tracked, known.window(9, strength=0.8))[0].accepted
    shape = known.SHAPE
    np.testing.assert_array_equal(tracked.parameters.values[shape], found.values[shape])
    np.testing.assert_array_equal(
        tracked.parameters.standard_errors[shape], found.standard_errors[shape]
    )
    low, high = tracked.parameters.current_range
    assert (low, high) == (0.3, 1.4), "what was identified over several currents stays valid there"


def test_a_set_that_the_model_would_refuse_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    tracked = toured()
    good = tracked.parameters

    def absurd(*arguments: Any) -> GlobalFit:
        fit = identify_global(*arguments)
        values = fit.parameter_set.values.copy()
        values[known.index("f0")] *= 1e6
        found = dataclasses.replace(fit.parameter_set, values=values)
        return dataclasses.replace(fit, parameter_set=found)

    better = Evidence(0.2, 0.1)
    monkeypatch.setattr(tracking, "identify_global", absurd)
    monkeypatch.setattr(tracking, "evidence_of_search", lambda *_: better)
    report = tracked.identify()
    assert report.verdict is Verdict.POOR_FIT
    assert "more than the limit" in report.reason
    assert tracked.parameters is good
