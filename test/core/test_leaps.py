"""Leaps of the clock that stamps a live stream: the force is valid again after a bounded time."""

from collections.abc import Callable
from dataclasses import replace

import known
import numpy as np
import pytest

from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock, joined
from mr_damper_ros.tracking.predictor import ForcePredictor, Prediction
from mr_damper_ros.tracking.validity import DoubtKind

SIZE = 10
RUN = known.run(current=1.0, samples=7000, seed=None)
BLOCKS = known.blocks(RUN.displacement, RUN.clean, (SIZE,))
SET = ParameterSet(known.PLAUSIBLE, set_id="known", current_range=(0.0, 2.0))
LEAP, AGAIN = 300, 200
"""Number of the first block after the leap, and of blocks until the force must be valid: 1.5 cycles
of the motion, and some for the velocity."""

FORCE = 30.0
"""Tolerance [N] of a valid force, whose velocity is estimated from past samples."""


def by(seconds: float) -> Callable[[int], int]:
    return lambda stamp_ns: stamp_ns + round(seconds * NANOSECONDS)


LEAPS: dict[str, Callable[[int], int]] = {
    "one second ahead": by(1.0),
    "one second back": by(-1.0),
    "0.7 s ahead": by(0.7),
    "an hour ahead": by(3600.0),
    "an hour back": by(-3600.0),
    "back to zero": by(-known.T0 / NANOSECONDS - LEAP * SIZE * known.PERIOD),
    "zero for ever": lambda _: 0,
    "frozen for ever": lambda _: BLOCKS[LEAP - 1].start_ns,
}


def leapt(name: str, block: SampleBlock, k: int) -> SampleBlock:
    return replace(block, start_ns=LEAPS[name](block.start_ns)) if k >= LEAP else block


def predicted(name: str, *, current_leaps: bool, confirmed: bool = False) -> list[Prediction]:
    """Predictions of a live stream whose clock leaps; the clock of the node does not."""
    predictor = ForcePredictor()
    predictor.set_parameters(SET, known.T0 if confirmed else None)
    found = []
    for k, block in enumerate(BLOCKS):
        sent = leapt(name, block, k)
        if k % 10 == 0:
            stamp_ns = sent.start_ns if current_leaps else block.start_ns
            predictor.add_current(stamp_ns, 1.0)
        found.append(predictor.predict(sent, block.end_ns))
    return found


@pytest.mark.parametrize("current_leaps", [True, False], ids=["one clock", "own clock of supply"])
@pytest.mark.parametrize("name", LEAPS)
def test_the_force_is_valid_again(name: str, current_leaps: bool) -> None:
    found = predicted(name, current_leaps=current_leaps)
    assert found[LEAP - 1].valid, found[LEAP - 1].reason
    invalid = [prediction.reason for prediction in found[LEAP + AGAIN :] if not prediction.valid]
    assert invalid == []


@pytest.mark.parametrize("name", LEAPS)
def test_no_wrong_force_is_valid(name: str) -> None:
    found = predicted(name, current_leaps=True)
    for prediction, block in zip(found, BLOCKS, strict=True):
        valid = prediction.valid_samples
        np.testing.assert_allclose(prediction.force[valid], block.force[valid], atol=FORCE)


@pytest.mark.parametrize("name", LEAPS)
def test_parameters_of_an_identifier_keep_their_age(name: str) -> None:
    found = predicted(name, current_leaps=True, confirmed=True)
    assert found[-1].valid, found[-1].reason


def test_frozen_stamps_interrupt_nothing() -> None:
    found = predicted("frozen for ever", current_leaps=True)
    assert {p.continuity for p in found} == {""}
    starts = np.array([p.start_ns for p in found[LEAP:]])
    np.testing.assert_allclose(np.diff(starts), SIZE * known.PERIOD * NANOSECONDS, atol=1.0)


def test_a_stream_that_falls_behind_is_outdated_without_a_leap() -> None:
    predictor = ForcePredictor()
    predictor.set_parameters(SET)
    for k, block in enumerate(BLOCKS):
        predictor.add_current(block.start_ns, 1.0)
        behind_ns = NANOSECONDS if k >= LEAP else 0
        last = predictor.predict(block, block.end_ns + behind_ns)
    assert last.doubt.kind is DoubtKind.OUTDATED


@pytest.mark.parametrize("name", ["one second ahead", "one second back"])
def test_a_leap_within_a_backlog_is_followed(name: str) -> None:
    # After a stall the newest blocks arrive together, and are joined.
    predictor = ForcePredictor()
    predictor.set_parameters(SET)
    late = LEAP + 90
    for k, block in enumerate(BLOCKS):
        if k % 10 == 0:
            predictor.add_current(block.start_ns, 1.0)
        if LEAP <= k < late:
            continue
        waiting = [leapt(name, each, j) for j, each in enumerate(BLOCKS[LEAP : k + 1], LEAP)]
        sent = joined(waiting) if k == late else [leapt(name, block, k)]
        for each in sent:
            last = predictor.predict(each, block.end_ns)
    assert last.valid, last.reason
