"""Channels that were measured apart in time are brought together, at the time of both."""

from __future__ import annotations

import numpy as np
import pytest

from mr_damper_ros.rig.blocks import aligned
from mr_damper_ros.signals.blocks import RigBlock

PERIOD = 1e-3
START = 1_700_000_000_000_000_000


def motion(time: np.ndarray) -> np.ndarray:
    return 0.005 * np.sin(2.0 * np.pi * 3.0 * time)


def pull(time: np.ndarray) -> np.ndarray:
    return 900.0 * np.cos(2.0 * np.pi * 3.0 * time)


def skewed(lateness: float, sizes: list[int], missing: int = -1) -> list[RigBlock]:
    """Blocks whose force is that of so long before; one of them never comes."""
    blocks, first = [], 0
    for place, size in enumerate(sizes):
        time = (first + np.arange(size)) * PERIOD
        late, later = max(lateness, 0.0), max(-lateness, 0.0)
        block = RigBlock(
            START + first * 1_000_000,
            first,
            PERIOD,
            motion(time - later),
            pull(time - late),
            np.full(size, 0.5),
            np.full(size, 30.0),
        )
        first += size
        if place != missing:
            blocks.append(block)
    return blocks


@pytest.mark.parametrize("lateness", [2.7e-3, 0.4e-3, 1e-3, -3.1e-3, -0.2e-3])
@pytest.mark.parametrize("sizes", [[100, 100], [1] * 60, [3, 50, 2, 7, 40]])
def test_both_are_what_they_were_at_the_stamp(lateness: float, sizes: list[int]) -> None:
    blocks = list(aligned(skewed(lateness, sizes), lateness))
    for block in blocks:
        time = (block.start_ns - START) * 1e-9 + np.arange(block.sample_count) * PERIOD
        np.testing.assert_allclose(block.displacement, motion(time), atol=1e-9)
        np.testing.assert_allclose(block.force, pull(time), atol=1e-3)
    numbers = np.concatenate([b.sequence + np.arange(b.sample_count) for b in blocks])
    assert (np.diff(numbers) == 1).all()
    # Only those at the beginning have no partner.
    assert numbers[-1] == sum(sizes) - 1
    assert numbers[0] <= 6


def test_after_a_gap_nothing_is_made_of_what_was_before() -> None:
    blocks = list(aligned(skewed(2.5e-3, [40] * 5, missing=2), 2.5e-3))
    assert [block.sequence for block in blocks] == [4, 40, 124, 160]
    for block in blocks:
        time = (block.start_ns - START) * 1e-9 + np.arange(block.sample_count) * PERIOD
        np.testing.assert_allclose(block.displacement, motion(time), atol=1e-9)
