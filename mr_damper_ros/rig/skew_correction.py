"""Brings displacement and force that were measured at different times together again."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from mr_damper_ros.rig.rig_block import RigBlock
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS

_NODES = 4
"""Samples that a cubic goes through."""


def aligned(blocks: Iterable[RigBlock], lateness: float) -> Iterator[RigBlock]:
    """The blocks, whose force comes ``lateness`` [s] later than the displacement, set right.

    Negative: the displacement comes later. The channel that is ahead is delayed, by a cubic through
    four of its samples, and the stamps are set back to when both were measured. After a gap the
    first samples, whose partners never came, are left out.
    """
    if lateness == 0.0:
        yield from blocks
        return
    ahead = "displacement" if lateness > 0.0 else "force"
    past: Array = np.empty(0)
    expected = None
    for block in blocks:
        if block.sample_count == 0:
            yield block
            continue
        back, weights = _weights(abs(lateness) / block.period)
        if block.sequence != expected:
            past = np.empty(0)
        expected = block.sequence + block.sample_count
        known = np.concatenate([past, getattr(block, ahead)])
        past = known[-(back + _NODES) :]
        # Value k is made of those from k - back - 3 to k - back.
        delayed = np.convolve(known, weights, "valid")[: max(known.size - _NODES + 1 - back, 0)]
        skipped = block.sample_count - min(delayed.size, block.sample_count)
        if skipped == block.sample_count:
            continue
        moved = _without_first(block, skipped)
        values = delayed[-moved.sample_count :]
        pair = {"displacement": moved.displacement, "force": moved.force, ahead: values}
        yield replace(
            moved,
            start_ns=moved.start_ns - round(abs(lateness) * NANOSECONDS),
            displacement=pair["displacement"],
            force=pair["force"],
        )


def _weights(delay: float) -> tuple[int, Array]:
    """Whole samples back, and weights of the four samples before that, the newest first."""
    back = max(math.floor(delay) - 1, 0)
    place = delay - back  # counted from the newest of the four
    nodes = np.arange(_NODES)
    weights = np.array(
        [
            np.prod([(place - other) / (own - other) for other in nodes if other != own])
            for own in nodes
        ]
    )
    return back, weights


def _without_first(block: RigBlock, count: int) -> RigBlock:
    if count == 0:
        return block
    return replace(
        block,
        start_ns=block.stamp_ns(count),
        sequence=block.sequence + count,
        displacement=block.displacement[count:],
        force=block.force[count:],
        current=block.current[count:],
        temperature=block.temperature[count:],
    )
