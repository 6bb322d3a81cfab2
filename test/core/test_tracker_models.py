"""A damper of any model is identified, judged and followed; a sudden change is detected."""

import math
from functools import cache

import known
import numpy as np
import pytest

from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet, start_set
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.predictor import ForcePredictor, PredictorSettings
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.tracker import TrackerSettings, WindowTracker
from mr_damper_ros.tracking.window_assembler import RawWindow

SCALE_TOLERANCE = 0.01
"""Of the force scale: a tenth of the change to be detected."""

STANDARD_ERRORS = 5.0
"""Largest error of an estimate in standard errors; no more among twenty parameters by chance."""

NOISE_ERROR = 0.1
"""Relative: the validation quarter of a window determines the noise to 4.5 %."""

UNSEEN_QUARTER = {"series_springs": 2.0}
"""Residual over the noise: three quarters of a cycle do not fully determine the two springs."""

SECONDS = 10
NOISE = 5.0
"""Standard deviation of the force noise [N]."""

SINGLE_CURRENT = [name for name in MODELS if not name.startswith("sigmoid")]
EACH = pytest.mark.parametrize("model", MODELS)
EACH_OF_ONE_CURRENT = pytest.mark.parametrize("model", SINGLE_CURRENT)


@cache
def damper(model: str, samples: int = 1000 * SECONDS) -> tuple[Array, Array]:
    """Displacement and force without noise, shape (n,), of a damper that moves at 1 Hz."""
    run = known.run(samples=samples, seed=None)
    motion = run.window.motion
    return run.displacement, MODELS[model].force(
        known.EXAMPLES[model], motion, run.current, run.period
    )


def window(model: str, number: int, strength: float = 1.0) -> RawWindow:
    """Second ``number`` of the damper, its force times ``strength``."""
    part = slice(1000 * number, 1000 * (number + 1))
    displacement, force = (values[part] for values in damper(model))
    noise = np.random.default_rng(number).normal(0.0, NOISE, 1000)
    return RawWindow(
        start_ns=known.T0 + number * known.NANOSECONDS,
        period=known.PERIOD,
        displacement=displacement,
        force=strength * force + noise,
        current=np.ones(1000),
    )


def tracker(model: str, start: ParameterSet | None = None, **settings: object) -> WindowTracker:
    entries: dict[str, object] = {"method": "least_squares", "global_period": 0, **settings}
    return WindowTracker(
        TrackerSettings(model=model, **entries),  # type: ignore[arg-type]
        start or start_set(model),
    )


@cache
def followed(model: str) -> tuple[WindowTracker, list[Report]]:
    """A tracker after windows of a damper of constant force, which then loses a tenth of it."""
    tracked = tracker(model)
    usual = known.fed(tracked, *(window(model, number) for number in (2, 3)))
    return tracked, usual + known.fed(tracked, *(window(model, number, 0.9) for number in (4, 5)))


@EACH
def test_a_damper_of_which_nothing_is_known_is_found_and_its_scale_followed(model: str) -> None:
    tracked, reports = followed(model)
    assert reports[0].accepted, reports[0].reason
    times = UNSEEN_QUARTER.get(model, 1.0 + NOISE_ERROR)
    at_the_noise = times * NOISE / np.std(damper(model)[1])
    # NRMSE of a sigmoid law with the shape of the literature, and of its extension with no lag.
    most = 0.05 if model.startswith("sigmoid") else at_the_noise
    assert reports[0].nrmse_after < most
    assert tracked.parameters.model == model
    assert tracked.parameters.law is MODELS[model]
    reports = followed(model)[1]
    assert math.isnan(reports[0].scale.value)
    for report, truth in zip(reports[1:], (1.0, 0.9, 0.9), strict=True):
        # Largest standard error of the force scale; a larger one would allow any value. A misfit
        # counts once per correlation length, not once per sample.
        assert 0.0 < report.scale.standard_error < 0.02
        assert report.scale.value == pytest.approx(truth, abs=SCALE_TOLERANCE)


@EACH_OF_ONE_CURRENT
def test_the_running_set_and_coefficients_are_those_of_the_damper(model: str) -> None:
    found = followed(model)[0].parameters
    law = MODELS[model]
    truth = known.EXAMPLES[model].copy()
    truth[law.strength_indices] *= 0.9
    one_run = law.places(law.free_in_one_run)
    assert set(np.flatnonzero(found.observable)) == set(one_run)
    missed = np.abs(found.values - truth)[one_run]
    assert np.all(missed < STANDARD_ERRORS * found.standard_errors[one_run])
    assert found.current_range == (1.0, 1.0)
    # Relative error of the peak velocity, 31.4 mm/s.
    speeds = pytest.approx((0.0314, 0.0314), rel=0.01)
    assert found.peak_velocity_range == speeds
    report = followed(model)[1][1]
    truth = known.EXAMPLES[model][: len(report.coefficients)]
    assert len(report.coefficients) == len(MODELS[model].coefficient_names)
    assert np.all(np.abs(report.coefficients - truth) < STANDARD_ERRORS * report.coefficient_errors)


def test_compliance_stiffness_and_offset_are_found_after_the_first_window() -> None:
    tracked = tracker("sigmoid_lag", global_period=20)
    (first,) = known.fed(tracked, window("sigmoid_lag", 2))
    assert first.global_due
    report = tracked.identify()
    assert report.accepted, report.reason
    error = report.nrmse_after * np.std(damper("sigmoid_lag")[1])
    assert error < (1.0 + NOISE_ERROR) * NOISE
    compliance = known.EXAMPLES["sigmoid_lag"][16]
    found = tracked.parameters.as_dict()["compliance"]
    # Relative error of a compliance found from one noisy window.
    assert found == pytest.approx(compliance, rel=0.1)
    (later,) = known.fed(tracked, window("sigmoid_lag", 3, 0.9))
    assert not later.global_due
    # The force scale does not depend on the earlier knowledge of the lag.
    assert later.scale.value == pytest.approx(0.9, abs=SCALE_TOLERANCE)


@EACH
def test_the_predictor_takes_what_the_tracker_finds(model: str) -> None:
    tracked = tracker(model)
    known.fed(tracked, window(model, 2))
    displacement, force = damper(model, 5000)
    predictor = ForcePredictor(PredictorSettings(current_timeout=100.0))
    predictor.set_parameters(tracked.parameters)
    predictor.add_current(known.T0, 1.0)
    stream = known.blocks(displacement, force, (50,))
    predictions = [predictor.predict(block) for block in stream]
    assert predictions[-1].valid, predictions[-1].reason
    predicted = np.concatenate([p.force for p in predictions])
    late = slice(3000, None)
    # NRMSE of a prediction with such a set; the observer's velocity error adds to it.
    assert known.rms(predicted[late] - force[late]) < 0.06 * np.std(force)


def test_a_set_beyond_all_numbers_is_replaced_by_the_first_good_window() -> None:
    huge = known.EXAMPLES["bouc_wen"].copy()
    huge[:4] = 1.7e308
    tracked = tracker("bouc_wen", ParameterSet(huge, model="bouc_wen"))
    (report,) = known.fed(tracked, window("bouc_wen", 2))
    assert report.accepted, report.reason
    error = report.nrmse_after * np.std(damper("bouc_wen")[1])
    assert error < (1.0 + NOISE_ERROR) * NOISE
