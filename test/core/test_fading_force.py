"""Where another set is taken up the force goes on from where it was."""

from __future__ import annotations

import dataclasses

import known
import numpy as np
import pytest

from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.tracking.fading_force import FADES
from mr_damper_ros.tracking.prediction import Prediction
from mr_damper_ros.tracking.predictor import ForcePredictor, PredictorSettings

LAWS = ("sigmoid", "hyperbolic_tangent", "bouc_wen", "modified_bouc_wen")

CHANGED = 333
"""Blocks after which another set comes."""

BLOCK = 10
RUN = known.run(current=1.0, samples=6000, seed=None)
FADED = round(FADES / known.PERIOD)

SAME_FORCE = 1e-6
"""[N]: of a kilonewton, nothing but rounding."""

SAME_DIFFERENCE = 1.0
"""[N] of some hundred: the motion is not followed quite the same in other blocks."""


def set_of(model: str, factor: float = 1.0) -> ParameterSet:
    values = np.array(known.EXAMPLES[model])
    values[list(MODELS[model].strength_indices)] *= factor
    return ParameterSet(values, set_id=f"{model} x {factor}", model=model)


def blocks(size: int = BLOCK, force: Array | None = None) -> list[SampleBlock]:
    measured = np.zeros(RUN.displacement.size) if force is None else force
    return known.blocks(RUN.displacement, measured, (size,))


def predicted(
    before: ParameterSet,
    after: ParameterSet | None = None,
    *,
    size: int = BLOCK,
    aged: bool = True,
    force: Array | None = None,
) -> list[Prediction]:
    """What comes of a stream during which another set comes, of an age unless somebody gave it."""
    sent = blocks(size, force)
    made = ForcePredictor(PredictorSettings(maximum_error=0.0 if force is None else 0.2))
    for k in range(100):
        made.add_current(known.T0 + k * NANOSECONDS // 10, 1.0)
    made.set_parameters(before, known.T0 if aged else None)
    count = CHANGED * BLOCK // size
    first = [made.predict(block) for block in sent[:count]]
    if after is not None:
        made.set_parameters(after, sent[count].start_ns if aged else None)
    return first + [made.predict(block) for block in sent[count:]]


def forces(predictions: list[Prediction]) -> Array:
    return np.concatenate([each.force for each in predictions])


@pytest.mark.parametrize("model", LAWS)
def test_the_force_does_not_step_where_a_set_comes(model: str) -> None:
    before, after = set_of(model), set_of(model, 1.4)
    alone = [np.abs(np.diff(forces(predicted(each))[1000:])).max() for each in (before, after)]
    apart = np.abs(forces(predicted(before)) - forces(predicted(after)))[1000:].max()
    step = np.abs(np.diff(forces(predicted(before, after))[1000:])).max()
    assert step <= max(alone) + 1.1 * apart / FADED


@pytest.mark.parametrize("model", LAWS)
def test_the_force_is_that_of_the_new_set_once_the_other_has_faded(model: str) -> None:
    rest = slice(CHANGED * BLOCK + FADED, None)
    found = forces(predicted(set_of(model), set_of(model, 1.4)))[rest]
    np.testing.assert_allclose(found, forces(predicted(set_of(model, 1.4)))[rest], atol=SAME_FORCE)


def test_how_it_fades_does_not_depend_on_the_blocks() -> None:
    before, after = set_of("sigmoid"), set_of("sigmoid", 1.4)
    by_tens, one_by_one = (
        (forces(predicted(before, after, size=size)) - forces(predicted(after, size=size)))[-2670:]
        for size in (BLOCK, 1)
    )
    np.testing.assert_allclose(by_tens, one_by_one, atol=SAME_DIFFERENCE)


def test_a_set_that_somebody_gives_counts_at_once() -> None:
    rest = slice(CHANGED * BLOCK, None)
    found = forces(predicted(set_of("sigmoid"), set_of("sigmoid", 1.4), aged=False))[rest]
    np.testing.assert_array_equal(found, forces(predicted(set_of("sigmoid", 1.4)))[rest])


def test_no_force_goes_on_that_no_such_damper_gives() -> None:
    rest = slice(CHANGED * BLOCK, None)
    after = dataclasses.replace(set_of("sigmoid"), largest_force=1500.0)
    found = forces(predicted(set_of("sigmoid", 50.0), after))[rest]
    np.testing.assert_array_equal(found, forces(predicted(set_of("sigmoid")))[rest])


@pytest.mark.parametrize(("before", "after"), [(1.6, 1.0), (1.3, 1.15)])
def test_what_is_left_of_a_wrong_force_is_not_valid(before: float, after: float) -> None:
    """Nor where that of the set in use is off, too, and each of both is within what is allowed."""
    truth = forces(predicted(set_of("sigmoid")))
    sets = set_of("sigmoid", before), set_of("sigmoid", after)
    rest = predicted(*sets, force=truth)[CHANGED:]
    wrong = [np.abs(p.force - truth[p.sequence : p.sequence + BLOCK]).max() for p in rest]
    peak = np.abs(truth).max()
    assert max(wrong) > 0.2 * peak
    assert not any(p.valid for p, off in zip(rest, wrong, strict=True) if off > 0.2 * peak)
