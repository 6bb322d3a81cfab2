"""Several blocks as one, where they follow each other."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock


def joined(blocks: Iterable[SampleBlock]) -> list[SampleBlock]:
    """The same samples in as few blocks as can hold them: one for each stretch without a break."""
    runs: list[list[SampleBlock]] = []
    for block in blocks:
        if runs and _follows(runs[-1][-1], block):
            runs[-1].append(block)
        else:
            runs.append([block])
    return [_one(run) for run in runs]


def _follows(last: SampleBlock, block: SampleBlock) -> bool:
    late = abs(block.start_ns - last.end_ns) / NANOSECONDS
    return (
        block.period == last.period
        and block.sequence == last.sequence + last.sample_count
        and late <= 0.5 * block.period
    )


def _one(run: list[SampleBlock]) -> SampleBlock:
    first = run[0]
    if len(run) == 1:
        return first
    return SampleBlock(
        first.start_ns,
        first.sequence,
        first.period,
        np.concatenate([block.displacement for block in run]),
        np.concatenate([block.force for block in run]),
    )
