"""The force is continuous when a set takes over, and the law's state is that of the new set."""

import dataclasses
import math

import known
import numpy as np
import pytest

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet, start_set
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.bumpless_transfer import FADE_TIME, ForceInUse
from mr_damper_ros.tracking.predictor import ForcePredictor, Prediction, PredictorSettings

LAWS = ("sigmoid", "modified_bouc_wen")

CHANGED = 333  # blocks after which the set changes
BLOCK = 10
RUN = known.run(current=1.0, samples=6000, seed=None)
FADED = round(FADE_TIME / known.PERIOD)


def set_of(model: str, factor: float = 1.0) -> ParameterSet:
    values = np.array(known.EXAMPLES[model])
    values[list(MODELS[model].strength_indices)] *= factor
    return ParameterSet(values, set_id=f"{model} x {factor}", model=model)


def predicted(
    before: ParameterSet,
    after: ParameterSet | None = None,
    *,
    aged: bool = True,
    force: Array | None = None,
) -> list[Prediction]:
    """Predictions of a stream during which the set changes; sets with ``aged`` have an age."""
    measured = np.zeros(RUN.displacement.size) if force is None else force
    sent = known.blocks(RUN.displacement, measured, (BLOCK,))
    made = ForcePredictor(PredictorSettings(maximum_error=0.0 if force is None else 0.2))
    for k in range(100):
        made.add_current(known.T0 + k * NANOSECONDS // 10, 1.0)
    made.set_parameters(before, known.T0 if aged else None)
    first = [made.predict(block) for block in sent[:CHANGED]]
    if after is not None:
        made.set_parameters(after, sent[CHANGED].start_ns if aged else None)
    return first + [made.predict(block) for block in sent[CHANGED:]]


def forces(predictions: list[Prediction]) -> Array:
    return np.concatenate([each.force for each in predictions])


@pytest.mark.parametrize("model", LAWS)
def test_the_force_continues_and_ends_in_that_of_the_new_set(model: str) -> None:
    sets = set_of(model), set_of(model, 1.4)
    before, after = (forces(predicted(each)) for each in sets)
    found = forces(predicted(*sets))
    alone, step = (
        max(np.abs(np.diff(each[1000:])).max() for each in some)
        for some in ((before, after), (found,))
    )
    assert step <= alone + 1.1 * np.abs(before - after)[1000:].max() / FADED
    rest = slice(CHANGED * BLOCK + FADED, None)
    # [N] of about 1000 N: rounding only.
    np.testing.assert_allclose(found[rest], after[rest], atol=1e-6)


def test_a_set_that_somebody_gives_counts_at_once() -> None:
    rest = slice(CHANGED * BLOCK, None)
    found = forces(predicted(set_of("sigmoid"), set_of("sigmoid", 1.4), aged=False))[rest]
    np.testing.assert_array_equal(found, forces(predicted(set_of("sigmoid", 1.4)))[rest])


@pytest.mark.parametrize(("before", "after"), [(1.6, 1.0), (1.3, 1.15)])
def test_what_is_left_of_a_wrong_force_is_not_valid(before: float, after: float) -> None:
    """A remaining force error is invalid, even if the old set is off too and both are tolerated."""
    truth = forces(predicted(set_of("sigmoid")))
    sets = set_of("sigmoid", before), set_of("sigmoid", after)
    rest = predicted(*sets, force=truth)[CHANGED:]
    wrong = [np.abs(p.force - truth[p.sequence : p.sequence + BLOCK]).max() for p in rest]
    peak = np.abs(truth).max()
    assert max(wrong) > 0.2 * peak
    assert not any(p.valid for p, off in zip(rest, wrong, strict=True) if off > 0.2 * peak)


# -- the state of the law --------------------------------------------------------------------------


RECOMPUTED = 1e-6
"""[N]: the recomputed half second is 280 time constants, so only rounding is left."""


def in_use(parameters: ParameterSet) -> ForceInUse:
    made = ForceInUse(known.PERIOD)
    made.use(parameters, gradual=False, fade=False)
    return made


def follow(made: ForceInUse, motion: Motion, current: float = 1.0) -> Array:
    """Force of a motion processed in blocks of 50 samples."""
    parts = [motion.part(slice(k, k + 50)) for k in range(0, motion.velocity.size, 50)]
    return np.concatenate([made.follow(part, np.full(50, current), math.nan) for part in parts])


def all_along(parameters: ParameterSet, motion: Motion, current: Array | float) -> Array:
    held = parameters.held(motion)
    return parameters.law.force(parameters.values, held, current, known.PERIOD)


@pytest.mark.parametrize("fastest", [math.inf, 0.02])
def test_the_state_is_that_of_the_new_set_and_its_range(fastest: float) -> None:
    motion = RUN.window.motion.part(slice(1000))
    before = dataclasses.replace(set_of("sigmoid_lag"), peak_velocity_range=(0.0, fastest))
    after = set_of("sigmoid_lag", 2.0)
    made = in_use(before)
    follow(made, motion.part(slice(800)))
    made.use(after, gradual=False, fade=True)
    force = follow(made, motion.part(slice(800, None)))
    expected = all_along(after, motion, 1.0)[800:]
    np.testing.assert_allclose(force, expected, rtol=0.0, atol=RECOMPUTED)


def test_the_branch_at_a_reversal_is_that_of_the_new_set() -> None:
    motion, after = RUN.window.motion.part(slice(600)), set_of("sigmoid")
    made = ForceInUse(known.PERIOD)
    made.use(start_set("sigmoid"), gradual=True, fade=False)
    # The reversal at sample 500 takes longer with the wide loop of the start set.
    follow(made, motion.part(slice(550)))
    made.use(after, gradual=True, fade=True)
    force = follow(made, motion.part(slice(550, None)))
    expected, _ = after.follow(motion, np.ones(600), known.PERIOD, None, gradual=True)
    np.testing.assert_allclose(force, expected[550:], rtol=0.0, atol=RECOMPUTED)


def test_as_much_is_followed_again_as_the_law_remembers_at_this_current() -> None:
    """The yield length grows tenfold with the current, and so does the travel to be recomputed."""
    model = MODELS["bouc_wen"]
    values = known.EXAMPLES["bouc_wen"].copy()
    values[model.parameter_names.index("yield_length_1")] = 5.0
    before = ParameterSet(values, set_id="before", model="bouc_wen")
    assert model.memory_length(values, 2.0) > 10.0 * model.memory_length(values, 0.0)
    softer = values.copy()
    softer[model.parameter_names.index("yield_length")] *= 2.0
    after = ParameterSet(softer, set_id="after", model="bouc_wen")
    # Shorter than the yield length, so that no stroke resets the memory.
    motion = known.run(amplitude=5e-4, frequency=2.0, samples=5500).window.motion
    made = in_use(before)
    follow(made, motion.part(slice(200)), current=0.0)
    follow(made, motion.part(slice(200, 5000)), current=2.0)
    made.use(after, gradual=False, fade=False)
    force = follow(made, motion.part(slice(5000, None)), current=2.0)
    expected = all_along(after, motion, np.where(np.arange(5500) < 200, 0.0, 2.0))[5000:]
    np.testing.assert_allclose(force, expected, atol=1e-3 * np.abs(expected).max())


def test_the_state_before_a_restart_is_discarded() -> None:
    """It may belong to another law, and the force of its samples is unknown."""
    motion, made, after = RUN.window.motion, in_use(set_of("bouc_wen")), set_of("sigmoid_lag", 1.4)
    follow(made, motion.part(slice(600)))
    made.forget_known()
    made.use(set_of("sigmoid_lag"), gradual=False, fade=True, restart=True)
    follow(made, motion.part(slice(600, 700)))
    made.use(after, gradual=False, fade=False)
    force = follow(made, motion.part(slice(700, 800)))
    expected = all_along(after, motion.part(slice(600, 800)), 1.0)[100:]
    np.testing.assert_allclose(force, expected, atol=RECOMPUTED)
