"""Blocks on a uniform grid: order, gaps, repetitions, and jitter of stamps."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_blocks import PERIOD, T0, block

from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.signals.uniform_grid import GridSettings, Placed, UniformGrid

HOLD_BACK = 0.05

AMPLITUDE, FREQUENCY = 5e-3, 1.0

SMOOTHED_NS = 0.15 * PERIOD * NANOSECONDS
"""Accuracy from some hundred stamps with errors of 0.29 periods (RMS)."""


SPIKE = replace(block(10), displacement=np.where(np.arange(10) == 4, 1.0, 0.0))


def test_of_a_block_that_overlaps_what_is_new_is_taken() -> None:
    sequence = UniformGrid()
    sequence.follow(block(0))
    (placed,) = sequence.follow(block(5, 10))
    assert placed.kind == "next"
    assert (placed.block.sequence, placed.block.sample_count) == (10, 5)
    assert placed.block.start_ns == block(10).start_ns
    assert sequence.repeated_samples == 5


@pytest.mark.parametrize(
    ("then", "kind", "lost", "repeated", "sentence"),
    [
        (block(60), "bridged", 50, 0, ""),
        (block(210), "gap", 200, 0, "200 samples were lost"),
        (block(10, late=1.0), "gap", 0, 0, "the samples pause for 1 s"),
        (block(500, late=-0.49), "gap", 0, 0, "the sample count was set back or forward"),
        (block(0), "repeat", 0, 10, "a block arrived twice or too late: it is ignored"),
        (block(0, late=-5.0), "jump_back", 0, 0, "the stamps jump back by 5.01 s"),
        (block(10, period=2e-3), "changed_period", 0, 0, "the sample period changed from 0.001 s"),
        (block(10, period=1.003e-3), "changed_period", 0, 0, "the sample period changed from 0."),
        (block(10, period=1.001e-3), "next", 0, 0, ""),
        (SPIKE, "displaced", 0, 0, "the displacement jumps by 1"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_arrives_is_judged_and_counted_as_documented(
    then: SampleBlock, kind: str, lost: int, repeated: int, sentence: str
) -> None:
    grid = UniformGrid()
    grid.follow(block(0))
    (placed,) = grid.follow(then)
    assert placed.kind == kind
    assert placed.sentence.startswith(sentence)
    assert "from 0.001 s to 0.001 s" not in placed.sentence
    assert ("restart" in placed.sentence) == placed.restarts
    assert grid.interruptions == bool(sentence)
    counts = (grid.lost_samples, grid.bridged_samples, grid.repeated_samples)
    assert counts == (lost, lost * (kind == "bridged"), repeated)
    if then is SPIKE:
        assert [grid.follow(block(at))[0].kind for at in (20, 30)] == ["displaced", "next"]


RAMP = np.linspace(0.0, 1e-3, 10)


def test_a_buffer_that_is_sent_again_is_ignored() -> None:
    grid = UniformGrid()
    sent = [block(first, displacement=RAMP, force=1e5 * RAMP) for first in range(0, 500, 10)]
    placed = [grid.follow(each)[0] for each in sent]
    assert {each.kind for each in placed[1:]} == {"repeat"}
    assert "the samples of its last block again" in placed[-1].sentence
    assert grid.follow(block(500, displacement=-RAMP))[0].kind == "gap"


@pytest.mark.parametrize("count", [2, 10, 100])
def test_a_motion_that_repeats_with_each_block_is_no_buffer_that_is_sent_again(count: int) -> None:
    cycle = AMPLITUDE * np.sin(2.0 * np.pi * np.arange(count) / count)
    grid = UniformGrid()
    sent = [block(k * count, count, displacement=cycle, force=1e5 * cycle) for k in range(20)]
    assert {grid.follow(each)[0].kind for each in sent} == {"first", "next"}


# -- streams ---------------------------------------------------------------------------------


def at(time: np.ndarray) -> np.ndarray:
    return np.asarray(AMPLITUDE * np.sin(2.0 * np.pi * FREQUENCY * time + 0.4))


def stream(
    sizes: list[int], late: np.ndarray | None = None, *, sampled: bool = False
) -> list[SampleBlock]:
    """A sine in blocks with stamp errors ``late`` [s]; if ``sampled``, the samples are late too."""
    blocks, first = [], 0
    for number, size in enumerate(sizes):
        off = 0.0 if late is None else float(late[number])
        time = (first + np.arange(size)) * PERIOD + off * sampled
        one = block(first, size, late=off, displacement=at(time), force=1e5 * at(time))
        blocks.append(one)
        first += size
    return blocks


def placed_in(grid: UniformGrid, blocks: list[SampleBlock]) -> list[Placed]:
    return [placed for one in blocks for placed in grid.follow(one)] + grid.flush()


def joined(placed: list[Placed]) -> np.ndarray:
    """Index, displacement and force of all samples on the grid, shape (n, 3)."""
    rows = [
        np.stack([one.sequence + np.arange(one.sample_count), one.displacement, one.force], axis=1)
        for one in (p.block for p in placed if p.kind != "repeat")
    ]
    return np.concatenate(rows)


SIZES = st.lists(st.integers(1, 20), min_size=5, max_size=40)


@settings(deadline=None, max_examples=50)
@given(SIZES)
def test_a_clean_stream_passes_untouched(sizes: list[int]) -> None:
    blocks = stream(sizes)
    placed = placed_in(UniformGrid(hold_back=HOLD_BACK), blocks)
    assert all(p.block is one for p, one in zip(placed, blocks, strict=True))


@settings(deadline=None, max_examples=50)
@given(SIZES, st.data())
def test_repeats_and_blocks_out_of_order_change_nothing(
    sizes: list[int], data: st.DataObject
) -> None:
    blocks = stream(sizes)
    firsts = [one.sequence * PERIOD for one in blocks]
    # Each block is delayed by less than the holding time; some are repeated.
    delays = data.draw(st.lists(st.floats(0.0, 0.02), min_size=len(blocks), max_size=len(blocks)))
    again = data.draw(st.lists(st.integers(0, len(blocks) - 1), max_size=5))
    arrivals = [(0.0, 0)] + [(firsts[k] + delays[k], k) for k in range(1, len(blocks))]
    arrivals += [(firsts[k] + 0.03, k) for k in again]
    order = [k for _, k in sorted(arrivals)]
    placed = placed_in(UniformGrid(hold_back=HOLD_BACK), [blocks[k] for k in order])
    np.testing.assert_array_equal(joined(placed), joined(placed_in(UniformGrid(), blocks)))


@settings(deadline=None, max_examples=50)
@given(SIZES, st.sets(st.integers(3, 38)), st.sampled_from([0.0, HOLD_BACK]))
def test_what_is_lost_is_reckoned_and_the_rest_stays(
    sizes: list[int], lost: set[int], hold_back: float
) -> None:
    blocks = stream(sizes)
    came = [one for number, one in enumerate(blocks) if number not in lost]
    grid = UniformGrid(GridSettings(longest_gap=1.0), hold_back)
    rows = joined(placed_in(grid, came))
    np.testing.assert_array_equal(rows[:, 0], np.arange(rows.shape[0]))
    measured = np.concatenate([one.sequence + np.arange(one.sample_count) for one in came])
    everything = joined(placed_in(UniformGrid(), blocks))
    np.testing.assert_array_equal(rows[measured], everything[measured])
    assert grid.bridged_samples == grid.lost_samples == rows.shape[0] - measured.size


@pytest.mark.parametrize("size", [1, 10])
def test_a_bridge_hits_what_was_lost(size: int) -> None:
    blocks = stream([size] * 40)
    rows = joined(placed_in(UniformGrid(), blocks[:20] + blocks[22:]))
    truth = at(rows[:, 0] * PERIOD)
    # Of the amplitude: a bridge over a twentieth of a cycle that ends in a single sample.
    assert np.max(np.abs(rows[:, 1] - truth)) < 1e-3 * AMPLITUDE


# -- jitter ----------------------------------------------------------------------------------


def jittered(count: int, part: float = 0.5) -> np.ndarray:
    return np.random.default_rng(1).uniform(-part, part, count) * PERIOD


def test_stamps_that_were_read_unevenly_are_smoothed_and_the_samples_stay() -> None:
    blocks = stream([1] * 3000, jittered(3000))
    grid = UniformGrid()
    placed = placed_in(grid, blocks)
    assert not grid.non_uniform
    assert {p.kind for p in placed} == {"first", "next"}
    np.testing.assert_array_equal(
        joined(placed), joined(placed_in(UniformGrid(), stream([1] * 3000)))
    )
    off = [p.block.start_ns - T0 - p.block.sequence * PERIOD * NANOSECONDS for p in placed[500:]]
    # A stamp close to that of the clock is not corrected.
    assert np.max(np.abs(off)) < SMOOTHED_NS + 0.1 * PERIOD * NANOSECONDS


@pytest.mark.parametrize("size", [1, 10])
def test_samples_that_were_taken_unevenly_are_brought_onto_the_grid(size: int) -> None:
    late = jittered(4000)
    blocks = stream([size] * 4000, late, sampled=True)
    grid = UniformGrid()
    placed = placed_in(grid, blocks)
    assert grid.non_uniform
    settled = placed[2000:]
    times = np.concatenate(
        [
            (p.stamp_ns - T0) / NANOSECONDS + np.arange(p.block.sample_count) * PERIOD
            for p in settled
        ]
    )
    error = joined(settled)[:, 1] - at(times)
    without = late.std() * AMPLITUDE * 2.0 * np.pi * FREQUENCY / np.sqrt(2.0)
    # Error of resampled samples relative to that of the original ones.
    assert np.std(error) < 0.1 * without


def test_that_samples_were_taken_unevenly_is_seen_though_some_are_lost() -> None:
    # The losses never leave a gap long enough to restart the detection.
    late = jittered(400)
    blocks = stream([1] * 400, late, sampled=True)
    grid = UniformGrid()
    placed_in(grid, [block for k, block in enumerate(blocks) if k % 20])
    assert grid.non_uniform
