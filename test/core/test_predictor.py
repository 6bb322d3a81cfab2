"""The predicted force is correct and causal, and is marked invalid when unreliable."""

import dataclasses

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.sigmoid.law import force_from_coefficients, operating_point_coefficients
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.tracking.predictor import ForcePredictor, Prediction, PredictorSettings
from mr_damper_ros.tracking.validity import DoubtKind

PERIOD = 1e-3
SAMPLES = 6000
SET = ParameterSet(
    known.PLAUSIBLE, set_id="known", peak_velocity_range=(0.02, 0.05), current_range=(0.5, 1.5)
)
RUN = known.run(current=1.0, samples=SAMPLES, seed=None)

PREDICTED = 0.02
"""NRMSE with the right parameters for a motion well below the bandwidth."""


def predictor(
    parameters: ParameterSet | None = SET, current: float | None = 1.0, **settings: float
) -> ForcePredictor:
    """A predictor that knows the current of the stream from its start, at ten values per second.

    The streams here carry no force.
    """
    made = ForcePredictor(PredictorSettings(**{"maximum_error": 0.0, **settings}))
    if parameters is not None:
        made.set_parameters(parameters)
    if current is not None:
        for k in range(100):
            made.add_current(known.T0 + k * NANOSECONDS // 10, current)
    return made


def stream(displacement: Array = RUN.displacement, *sizes: int) -> list[SampleBlock]:
    return known.blocks(displacement, np.zeros(displacement.size), sizes or (10,))


def predicted(made: ForcePredictor, blocks: list[SampleBlock]) -> list[Prediction]:
    return [made.predict(block) for block in blocks]


def forces(predictions: list[Prediction]) -> Array:
    return np.concatenate([p.force for p in predictions])


def nrmse(estimate: Array, truth: Array) -> float:
    return known.rms(estimate - truth) / float(np.std(truth))


# -- force -----------------------------------------------------------------------------------


def test_the_force_of_a_sine_is_predicted() -> None:
    predictions = predicted(predictor(), stream())
    late = slice(SAMPLES // 2, None)
    assert nrmse(forces(predictions)[late], RUN.clean[late]) < PREDICTED
    assert predictions[-1].valid, predictions[-1].reason
    assert predictions[-1].set_id == "known"


def test_the_zero_of_the_load_cell_is_learnt_in_a_cycle_and_does_not_delay_validity() -> None:
    measured = RUN.clean + 0.15 * np.ptp(RUN.clean) / 2.0
    made = predictor(maximum_error=0.2)
    predictions = predicted(made, known.blocks(RUN.displacement, measured, (10,)))
    late = slice(SAMPLES // 2, None)
    assert nrmse(forces(predictions)[late], measured[late]) < PREDICTED
    # The motion has a frequency of 1 Hz.
    assert all(prediction.valid for prediction in predictions[80:])


def test_the_force_does_not_depend_on_later_blocks() -> None:
    other = RUN.displacement.copy()
    other[4000:] += 0.005
    usual = forces(predicted(predictor(), stream()))
    changed = forces(predicted(predictor(), stream(other)))
    np.testing.assert_array_equal(usual[:4000], changed[:4000])


@known.fixed(6)
@given(st.lists(st.integers(1, 150), min_size=1, max_size=6))
def test_the_force_of_a_steady_motion_does_not_depend_on_the_size_of_the_blocks(
    sizes: list[int],
) -> None:
    # The centre is known after a cycle; from then on the blocks have no influence.
    reference = forces(predicted(predictor(), stream(RUN.displacement[:3000], 50)))
    found = forces(predicted(predictor(), stream(RUN.displacement[:3000], *sizes)))
    # [N] of about 1000 N: rounding, and the remainder of the settled lag.
    np.testing.assert_allclose(found[2000:], reference[2000:], atol=1e-6)


def test_a_current_step_inside_a_block_is_followed_at_its_sample() -> None:
    made = predictor(current=None)
    made.add_current(known.T0, 0.6)
    made.add_current(known.T0 + round(5.003 * NANOSECONDS), 1.4)
    force = forces(predicted(made, stream()))
    low = forces(predicted(predictor(current=0.6), stream()))
    high = forces(predicted(predictor(current=1.4), stream()))
    np.testing.assert_array_equal(force[:5003], low[:5003])
    np.testing.assert_array_equal(force[5003:], high[5003:])


# -- validity --------------------------------------------------------------------------------


def last_reason(made: ForcePredictor, blocks: list[SampleBlock]) -> str:
    prediction = predicted(made, blocks)[-1]
    assert prediction.valid == (prediction.reason == "")
    return prediction.reason


def test_without_parameters_there_is_no_force() -> None:
    prediction = predicted(predictor(parameters=None), stream())[-1]
    assert not prediction.valid
    assert np.isnan(prediction.force).all()
    assert prediction.set_id == ""
    assert "start the identifier or give parameter_file" in prediction.reason


def test_without_a_current_there_is_no_force() -> None:
    prediction = predicted(predictor(current=None), stream())[-1]
    assert not prediction.valid
    assert np.isnan(prediction.force).all()
    assert "is it published on supply/current" in prediction.reason


def test_parameters_that_nothing_confirms_become_doubtful() -> None:
    made = predictor(parameters=None, parameters_timeout=5.0)
    made.set_parameters(SET, confirmed_ns=known.T0)
    predictions = predicted(made, stream())
    assert predictions[490].valid, predictions[490].reason
    assert "no window has confirmed the parameters for 6 s" in predictions[-1].reason
    assert np.isfinite(predictions[-1].force).all()


def test_a_confirmation_makes_parameters_young_again() -> None:
    made = predictor(parameters=None, parameters_timeout=5.0)
    made.set_parameters(SET, confirmed_ns=known.T0)
    made.follow_report(known.confirmation("another", known.T0, known.T0 + 4 * NANOSECONDS))
    assert "no window has confirmed" in last_reason(made, stream())
    made = predictor(parameters=None, parameters_timeout=5.0)
    made.set_parameters(SET, confirmed_ns=known.T0)
    made.follow_report(known.confirmation("known", known.T0, known.T0 + 4 * NANOSECONDS))
    assert last_reason(made, stream()) == ""


@pytest.mark.parametrize("current", [0.39, 1.61])
def test_a_current_that_was_not_identified_is_doubtful(current: float) -> None:
    reason = last_reason(predictor(current=current), stream())
    assert (
        f"the current of {current:.2f} A is outside the identified range of 0.50 to 1.50 A"
        in reason
    )


@pytest.mark.parametrize(("frequency", "edge"), [(1.0, 0.05), (4.0, 0.02)])
def test_the_law_is_not_extrapolated_beyond_the_identified_peak_velocities(
    frequency: float, edge: float
) -> None:
    """A sine with 0.031 m/s per hertz, below and above the range."""
    run = known.run(frequency=frequency, current=1.0, samples=SAMPLES, seed=None)
    limits = (edge, edge) if edge > 0.03 else (0.01, edge)
    limited = dataclasses.replace(SET, peak_velocity_range=limits)
    coefficients = operating_point_coefficients(SET.values, edge, 1.0)
    expected = force_from_coefficients(coefficients, run.velocity, run.acceleration)
    late = slice(SAMPLES // 2, None)
    got = forces(predicted(predictor(limited), stream(run.displacement)))
    assert nrmse(got[late], expected[late]) < PREDICTED
    assert nrmse(run.clean[late], expected[late]) > 2.0 * PREDICTED


# -- models ----------------------------------------------------------------------------------


def set_of(model: str) -> ParameterSet:
    return ParameterSet(known.EXAMPLES[model], set_id=model, model=model)


@pytest.mark.parametrize("model", MODELS)
def test_the_force_of_every_model_is_predicted(model: str) -> None:
    predictions = predicted(predictor(set_of(model)), stream())
    motion = RUN.window.motion
    truth = MODELS[model].force(known.EXAMPLES[model], motion, RUN.current, PERIOD)
    late = slice(SAMPLES // 2, None)
    assert nrmse(forces(predictions)[late], truth[late]) < PREDICTED
    assert predictions[-1].valid, predictions[-1].reason


def test_a_force_beyond_all_numbers_is_no_force() -> None:
    huge = known.EXAMPLES["bouc_wen"].copy()
    huge[:4] = 1.7e308
    made = predictor(ParameterSet(huge, set_id="huge", model="bouc_wen"))
    beyond = [p for p in predicted(made, stream()[:300]) if "overflows" in p.reason]
    assert beyond
    assert np.isnan(forces(beyond)).all()
    made.set_parameters(set_of("bouc_wen"))
    assert predicted(made, stream()[300:])[-1].valid


def test_a_force_that_was_not_measured_says_nothing_of_the_parameters() -> None:
    """The straight line over a gap misses the force of a lost reversal by far."""
    run = known.run(current=1.0, frequency=1.0, samples=1200, period=5e-3, seed=None)
    blocks = known.blocks(run.displacement, run.clean, (10,), period=5e-3)
    turns = {61, 71, 81, 91, 101, 111}
    # Of the peak force: the prediction error of a motion across a gap is smaller.
    made = predictor(maximum_error=0.05)
    kept = [block for block in blocks if block.sequence // 10 not in turns]
    doubts = {p.doubt.kind for p in predicted(made, kept)[55:]}
    assert made.sequence.bridged_samples == 10 * len(turns)
    assert doubts == {DoubtKind.NONE}


def test_a_bag_that_loops_is_predicted_again_as_the_first_time() -> None:
    made, blocks = predictor(), stream()
    first = forces(predicted(made, blocks))
    for k in range(100):
        made.add_current(known.T0 + k * NANOSECONDS // 10, 1.0)
    np.testing.assert_array_equal(forces(predicted(made, blocks)), first)


# -- the lag of the current --------------------------------------------------------------------


@pytest.mark.parametrize("lag", [-0.03, 0.012])
def test_the_current_is_shifted_by_the_lag_in_the_report(lag: float) -> None:
    made = predictor(current=0.6)
    made.follow_report(known.report("known", known.T0, known.T0, current_lag=lag))
    switched_ns = known.T0 + 3 * NANOSECONDS
    made.add_current(switched_ns, 1.4)
    currents = np.concatenate([each.current for each in predicted(made, stream())])
    steps = np.flatnonzero(np.diff(currents)) + 1
    assert steps.tolist() == [3000 + round(lag / PERIOD)]


@pytest.mark.parametrize("lag", [float("nan"), 1e300])
def test_an_impossible_lag_in_a_report_is_ignored(lag: float) -> None:
    made = predictor()
    made.follow_report(known.report("known", known.T0, known.T0, current_lag=lag))
    assert predicted(made, stream(RUN.displacement[:10]))[0].current is not None
