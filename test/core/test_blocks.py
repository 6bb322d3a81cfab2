"""Which blocks are valid and accepted by a node, and sample times of uniform streams."""

import math
from collections.abc import Iterator

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
from mr_damper_ros.signals.clocks import CountedTimes

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
    lists = block(0, displacement=[0.0] * 7, force=(1,) * 7)
    assert (lists.sample_count, lists.part(2).force.dtype) == (7, np.float64)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"displacement": np.zeros(0), "force": np.zeros(0)}, "the block holds no samples"),
        ({"force": np.zeros(9)}, "the block holds 10 displacements but 9 forces"),
        ({"force": np.zeros((10, 1))}, "the block holds a table"),
        ({"force": np.ma.masked_equal(np.arange(10), 4)}, "the force of sample 4 of the block is"),
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


# -- blocks that a node accepts --------------------------------------------------------------


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


# -- times of uniform samples: by a counter, by their order, and by arrival ------------------------

RATE = 1000.0
BEGIN = 5_000_000_000

ONE_WAY = 1e-3
"""Shortest transmission delay [s]; it remains in the sample times."""


def arrivals(
    count: int, *, rate: float = RATE, burst: int = 1, seed: int = 0
) -> Iterator[tuple[int, int, int]]:
    """Sample number, sampling time and arrival [ns]: in bursts, with a delay of at least 1 ms."""
    rng = np.random.default_rng(seed)
    for k in range(count):
        last = k - k % burst + burst - 1
        way = ONE_WAY + (rng.exponential(1e-3) if k % burst == 0 else 0.0)
        yield k, BEGIN + round(k / rate * 1e9), BEGIN + round((last / rate + way) * 1e9)


@pytest.mark.parametrize(("rate", "burst"), [(1000.0, 1), (1000.0, 16), (1003.0, 1), (1000.0, 900)])
def test_the_time_of_a_sample_is_when_it_was_taken(rate: float, burst: int) -> None:
    times = CountedTimes(RATE, 2**16)
    errors = []
    for k, taken, arrival in arrivals(9000, rate=rate, burst=burst):
        index = times.add(k, arrival)
        if index is not None and k > 7000:
            errors.append((times.time_ns(index) - taken) * 1e-9 - ONE_WAY)
    assert len(errors) > 1000
    assert np.abs(errors).max() < 2e-3


def test_what_was_lost_is_counted_and_the_count_may_begin_anew() -> None:
    times = CountedTimes(RATE, 2**8, checks_rate=False)
    found = {}
    for k, _, arrival in arrivals(2000):
        if k % 100 != 7:
            found[k] = times.add(k % 2**8, arrival)
    assert times.counts["lost"] == 20
    assert all(index == k for k, index in found.items())


def test_samples_that_were_overtaken_are_left_out_and_counted() -> None:
    times = CountedTimes(RATE, 2**32, checks_rate=False)
    numbers = [0, 1, 3, 2, 4, 4, 5]
    found = [times.add(k, BEGIN + 1_000_000 * place) for place, k in enumerate(numbers)]
    assert found == [0, 1, 3, None, 4, None, 5]
    assert (times.counts["late"], times.counts["lost"]) == (2, 1)


def test_a_sender_that_was_started_again_goes_on_after_a_gap_of_the_time_that_has_passed() -> None:
    times = CountedTimes(RATE, 2**32, checks_rate=False)
    for k, _, arrival in arrivals(3000):
        before = times.add(100_000 + k, arrival)
    later = 4_000_000_000
    after = [times.add(k, arrival + 3_000_000_000 + later) for k, _, arrival in arrivals(3000)]
    assert before == 2999
    assert after[0] - 3000 == pytest.approx(4000, abs=20)
    assert after[-1] == after[0] + 2999
    assert times.counts["recounts"] == 1


@pytest.mark.parametrize("counts", [None, 2**16])
def test_a_pause_of_the_sender_is_a_gap(counts: int | None) -> None:
    times = CountedTimes(RATE, counts, checks_rate=False)
    found = []
    for k, _, arrival in arrivals(6000):
        found.append(times.add(k, arrival + (700_000_000 if k >= 3000 else 0)))
    assert found[2999] == 2999
    assert found[-1] - 5999 == pytest.approx(700, abs=20)
    assert times.counts["pauses"] == 1


@pytest.mark.parametrize("rate", [100.0, 500.0, 900.0, 960.0, 1040.0, 1100.0, 2000.0, 1e6])
def test_nothing_of_another_rate_than_the_stated_one_is_used(rate: float) -> None:
    times = CountedTimes(RATE)
    used = sum(
        times.add(None, arrival) is not None for _, _, arrival in arrivals(30_000, rate=rate)
    )
    assert used == 0


def test_what_cannot_be_read_has_its_place_where_nobody_counts() -> None:
    times = CountedTimes(RATE, checks_rate=False)
    first = times.add(None, BEGIN)
    times.skip(3)
    second = times.add(None, BEGIN + 4_000_000)
    assert (first, second, times.counts["lost"]) == (0, 4, 3)
