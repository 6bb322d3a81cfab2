"""One time policy: all consumers treat irregular stamps in the same way and recover."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.tracking.predictor import ForcePredictor, Prediction, PredictorSettings
from mr_damper_ros.tracking.window_assembler import RawWindow, WindowAssembler, WindowSettings

SIZE = 10
BLOCK_NS = round(SIZE * known.PERIOD * NANOSECONDS)
RUN = known.run(current=1.0, samples=6000, seed=None)
BLOCKS = known.blocks(RUN.displacement, RUN.clean, (SIZE,))
SET = ParameterSet(known.PLAUSIBLE, set_id="known", current_range=(0.0, 2.0))

EPOCHS_NS = {"zero": 0, "before 1970": -5 * NANOSECONDS, "2100": 4_102_444_800 * NANOSECONDS}


def shifted(blocks: list[SampleBlock], by_ns: int) -> list[SampleBlock]:
    return [replace(block, start_ns=block.start_ns + by_ns) for block in blocks]


def predicted(blocks: list[SampleBlock], made: ForcePredictor | None = None) -> list[Prediction]:
    """Predictions with a current message just before every block, with the same stamp."""
    if made is None:
        made = ForcePredictor(PredictorSettings())
        made.set_parameters(SET)
    result = []
    for block in blocks:
        made.add_current(block.start_ns, 1.0)
        result.append(made.predict(block))
    return result


def windows(blocks: list[SampleBlock]) -> list[RawWindow]:
    made = WindowAssembler(WindowSettings(1.0, 0.5, looks=0))
    result = []
    for block in blocks:
        result += made.add_current(block.start_ns, 1.0)
        result += made.add_block(block)
    return result


@pytest.mark.parametrize("epoch_ns", EPOCHS_NS.values(), ids=EPOCHS_NS)
def test_nothing_depends_on_the_epoch(epoch_ns: int) -> None:
    usual = predicted(BLOCKS)
    other = predicted(shifted(BLOCKS, epoch_ns - known.T0))
    assert usual[-1].valid
    assert [(p.valid, p.reason) for p in other] == [(p.valid, p.reason) for p in usual]
    for p, q in zip(other, usual, strict=True):
        np.testing.assert_array_equal(p.force, q.force)
    by_ns = epoch_ns - known.T0
    usual, other = windows(BLOCKS), windows(shifted(BLOCKS, by_ns))
    assert [w.start_ns for w in other] == [w.start_ns + by_ns for w in usual]
    for w, v in zip(other, usual, strict=True):
        np.testing.assert_array_equal(w.force, v.force)


# -- faults of a stream ----------------------------------------------------------------------

FAULTS: dict[str, Callable[[list[SampleBlock], list[SampleBlock]], list[SampleBlock]]] = {
    "gap": lambda before, after: [*before, *after[7:]],
    "pause": lambda before, after: [*before, *shifted(after, NANOSECONDS)],
    "duplicates": lambda before, after: [*before, *before[-3:], *after],
    "out of order": lambda before, after: [*before, after[1], after[0], *after[2:]],
    "jump back": lambda before, after: [*before, *shifted(after, -3600 * NANOSECONDS)],
    "jump into the future": lambda before, after: [
        *before,
        *shifted(after, 10 * 365 * 86_400 * NANOSECONDS),
    ],
    "source started again": lambda before, after: [
        *before,
        *(replace(b, sequence=SIZE * k) for k, b in enumerate(shifted(after, 5 * NANOSECONDS))),
    ],
    "loop": lambda before, after: [*before, *before],
    "back from the future": lambda before, after: [
        *before,
        *shifted(after[:20], 365 * 86_400 * NANOSECONDS),
        *after[20:],
    ],
    "changed period": lambda before, after: [
        *before,
        *(
            replace(b, period=2.0 * b.period, start_ns=before[-1].end_ns + 2 * k * BLOCK_NS)
            for k, b in enumerate(after)
        ),
    ],
}


@cache
def predicted_after(name: str) -> list[Prediction]:
    """Predictions of a stream with this fault in its middle."""
    return predicted(FAULTS[name](BLOCKS[:300], BLOCKS[300:]))


@pytest.mark.parametrize("name", FAULTS)
def test_no_fault_of_the_stamps_is_for_ever(name: str) -> None:
    predictions = predicted_after(name)
    assert predictions[299].valid, predictions[299].reason
    assert predictions[-1].valid, predictions[-1].reason


MENDED = {"duplicates", "out of order"}
"""Faults without interruption: duplicates are ignored, blocks out of order reordered or bridged."""


@pytest.mark.parametrize("name", sorted(set(FAULTS) - MENDED))
def test_after_a_break_nothing_is_valid_before_the_motion_is_known_again(name: str) -> None:
    predictions = predicted_after(name)
    broken = [k for k, p in enumerate(predictions) if p.continuity]
    assert broken
    assert not any(p.valid for k in broken for p in predictions[k : k + 2])


@pytest.mark.parametrize("name", FAULTS)
def test_a_window_never_spans_a_break(name: str) -> None:
    # The force is the sample number, so that the contents of a window show their origin.
    numbered = known.blocks(RUN.displacement, np.arange(RUN.clean.size, dtype=float), (SIZE,))
    found = windows(FAULTS[name](numbered[:300], numbered[300:]))
    assert len(found) > 4
    assert all((np.diff(window.force) == 1.0).all() for window in found)


@known.fixed(12)
@given(st.lists(st.sampled_from(sorted(set(FAULTS) - MENDED)), min_size=1, max_size=3))
def test_predictor_and_windows_judge_a_stream_alike(names: list[str]) -> None:
    # Only the windows can wait for blocks that are out of order.
    blocks = BLOCKS[:200]
    for name in names:
        blocks = FAULTS[name](blocks[: len(blocks) // 2], blocks[len(blocks) // 2 :])
    predictor = ForcePredictor(PredictorSettings())
    predicted(blocks, predictor)
    assembler = WindowAssembler(WindowSettings(1.0, 0.5, looks=0))
    for block in blocks:
        assembler.add_block(block)
    for counted in ("lost_samples", "repeated_samples", "interruptions", "last_interruption"):
        assert getattr(predictor.sequence, counted) == getattr(assembler.sequence, counted)


def test_a_current_from_a_clock_far_ahead_is_told() -> None:
    made = ForcePredictor(PredictorSettings())
    made.set_parameters(SET)
    made.add_current(BLOCKS[0].start_ns + 60 * NANOSECONDS, 1.0)
    prediction = made.predict(BLOCKS[0])
    assert not prediction.valid
    assert "stamped 60 s after the first sample" in prediction.reason
