"""Which blocks can be used, and which a node takes in."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mr_damper_ros.signals.blocks import (
    LONGEST_BLOCK,
    MOST_SAMPLES,
    NANOSECONDS,
    BlockError,
    SampleBlock,
    check_live,
)

PERIOD = 1e-3
T0 = 1_700_000_000 * NANOSECONDS


def block(sequence: int, count: int = 10, *, late: float = 0.0, **changes: object) -> SampleBlock:
    """Samples ``sequence`` and following of a stream that started at T0, ``late`` seconds late."""
    entries: dict[str, object] = {
        "start_ns": T0 + round((sequence * PERIOD + late) * NANOSECONDS),
        "sequence": sequence,
        "period": PERIOD,
        "displacement": np.zeros(count),
        "force": np.zeros(count),
    }
    return SampleBlock(**{**entries, **changes})  # type: ignore[arg-type]


def test_end_of_a_block() -> None:
    assert block(0, 10).end_ns == T0 + 10_000_000
    assert block(0, 7).sample_count == 7


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"displacement": np.zeros(0), "force": np.zeros(0)}, "the block holds no samples"),
        ({"force": np.zeros(9)}, "the block holds 10 displacements but 9 forces"),
        ({"period": 0.0}, "the sample period is 0.0 s: it must be positive"),
        ({"period": -1e-3}, "it must be positive"),
        ({"period": math.nan}, "it must be positive"),
        ({"period": math.inf}, "it must be positive"),
        ({"force": np.where(np.arange(10) == 4, np.nan, 0.0)}, "the force of sample 4 of the bl"),
        ({"displacement": np.where(np.arange(10) == 4, np.inf, 0.0)}, "displacement of sample 4"),
    ],
    ids=str,
)
def test_a_block_that_cannot_be_used_is_refused(changes: dict[str, object], sentence: str) -> None:
    with pytest.raises(BlockError) as caught:
        block(0, **changes)
    assert sentence in str(caught.value)


# -- what a node takes in --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "period"),
    [(MOST_SAMPLES, 1e-5), (MOST_SAMPLES, LONGEST_BLOCK / MOST_SAMPLES), (1, 1.0), (10, 1.0)],
)
def test_a_block_up_to_the_limits_is_taken_in(count: int, period: float) -> None:
    check_live(block(0, count, period=period))


@pytest.mark.parametrize(
    ("count", "period", "sentence"),
    [
        (MOST_SAMPLES + 1, 1e-4, "the block holds 5001 samples"),
        (18_750, 1000.0, "the block holds 18750 samples"),
        (10, 1000.0, "the sample period is 1000 s"),
        (10, 9e-6, "the sample period is 9e-06 s"),
        (11, 1.0, "the block lasts 11 s"),
    ],
)
def test_a_block_beyond_the_limits_is_refused(count: int, period: float, sentence: str) -> None:
    with pytest.raises(BlockError, match=sentence):
        check_live(block(0, count, period=period))
