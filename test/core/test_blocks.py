"""What follows what in a stream of blocks, and what becomes of the rest."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mr_damper_ros.signals.blocks import (
    LONGEST_BLOCK,
    MOST_SAMPLES,
    NANOSECONDS,
    BlockError,
    BlockSequence,
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


def followed(*blocks: SampleBlock) -> BlockSequence:
    sequence = BlockSequence()
    for one in blocks:
        sequence.follow(one)
    return sequence


def kind_after_first(second: SampleBlock) -> str:
    return followed(block(0)).follow(second).kind


def test_the_first_block_is_first() -> None:
    verdict = BlockSequence().follow(block(123))
    assert (verdict.kind, verdict.sentence, verdict.restarts) == ("first", "", False)


def test_a_block_that_follows_is_next() -> None:
    verdict = followed(block(0)).follow(block(10))
    assert (verdict.kind, verdict.sentence, verdict.restarts) == ("next", "", False)


@pytest.mark.parametrize("late", [-0.49, 0.49])
def test_half_a_period_is_tolerated(late: float) -> None:
    assert kind_after_first(block(10, late=late * PERIOD)) == "next"


@pytest.mark.parametrize("late", [0.51, 3.0])
def test_more_than_half_a_period_late_is_a_gap(late: float) -> None:
    assert kind_after_first(block(10, late=late * PERIOD)) == "gap"


def test_lost_samples_are_counted() -> None:
    sequence = followed(block(0), block(10))
    verdict = sequence.follow(block(25))
    assert verdict.restarts
    assert verdict.lost == 5
    assert "5 samples were lost" in verdict.sentence
    assert sequence.lost_samples == 5


def test_a_pause_loses_no_samples() -> None:
    sequence = followed(block(0))
    verdict = sequence.follow(block(10, late=2.5))
    assert (verdict.kind, verdict.lost) == ("gap", 0)
    assert "pause for 2.5 s" in verdict.sentence


def test_a_repeated_block_is_ignored() -> None:
    sequence = followed(block(0), block(10))
    verdict = sequence.follow(block(10))
    assert (verdict.kind, verdict.restarts) == ("repeat", False)
    assert sequence.repeated_samples == 10
    assert sequence.follow(block(20)).kind == "next", "the repeat took no one's place"


def test_an_older_block_that_comes_late_is_ignored() -> None:
    sequence = followed(block(0), block(10), block(20))
    assert sequence.follow(block(0)).kind == "repeat"


def test_stamps_that_go_back_far_are_a_jump() -> None:
    sequence = followed(block(5000))
    verdict = sequence.follow(block(0))
    assert (verdict.kind, verdict.restarts) == ("jump_back", True)
    assert "jump back by 5.01 s" in verdict.sentence


def test_a_short_bag_that_loops_jumps_back_when_its_count_goes_on() -> None:
    assert kind_after_first(block(10, start_ns=T0)) == "jump_back"


def test_a_block_that_overlaps_only_in_part_is_no_repeat() -> None:
    assert kind_after_first(block(5, 10)) == "jump_back"


def test_a_changed_period_restarts() -> None:
    verdict = followed(block(0)).follow(block(10, period=2e-3))
    assert (verdict.kind, verdict.restarts) == ("changed_period", True)
    assert "from 0.001 s to 0.002 s" in verdict.sentence


def test_rounding_of_the_period_is_no_change() -> None:
    assert kind_after_first(block(10, period=PERIOD * (1.0 + 1e-9))) == "next"


def test_a_count_that_is_set_back_restarts() -> None:
    verdict = followed(block(0), block(10)).follow(block(0, late=0.020))
    assert (verdict.kind, verdict.restarts) == ("gap", True)
    assert "count was set back or forward" in verdict.sentence


def test_the_stamps_may_run_at_another_rate_than_the_nominal_one() -> None:
    # 300 parts per million over 1000 blocks: each block follows its predecessor.
    sequence = BlockSequence()
    kinds = {sequence.follow(block(10 * k, late=3e-4 * 10 * k * PERIOD)).kind for k in range(1000)}
    assert kinds == {"first", "next"}


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
        (11, 1.0, "the block stands for 11 s"),
    ],
)
def test_a_block_beyond_the_limits_is_refused(count: int, period: float, sentence: str) -> None:
    with pytest.raises(BlockError, match=sentence):
        check_live(block(0, count, period=period))
