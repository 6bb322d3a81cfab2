"""The share of valid force of the same streams in blocks of 1, 10 and 100 samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from benchmarks.figure import Figure
from benchmarks.foreign_dampers import COMBINATIONS, Combination, trial_of
from benchmarks.healthy import at_rest

SIZES = (1, 10, 100)


def _chosen() -> list[Combination]:
    """A combination of each of some motions, as it would be without faults."""
    motions = ("sine 0.4 Hz", "sine 2 Hz", "random 0.2-3 Hz", "quarter car")
    first = [next(c for c in COMBINATIONS[k:] if c.motion == m) for k, m in enumerate(motions)]
    return [replace(combination, fault="", sensors="noisy") for combination in first]


CASES = _chosen()


def valid_shares(case: Combination, duration: float) -> list[float]:
    """Share [%] of the time in motion for which the force is valid, for each size of the blocks."""
    shares = []
    for size in SIZES:
        result = trial_of(replace(case, block=size))[0].run(duration)
        asked = (result.time >= result.sets[1].time) & ~at_rest(result)
        shares.append(100.0 * float(np.mean(result.valid[asked])))
    return shares


def figures(duration: float = 20.0, cases: Sequence[Combination] = CASES) -> list[Figure]:
    """``block_size_valid_spread``."""
    found = [(case, valid_shares(case, duration)) for case in cases]
    return [
        Figure(
            "block_size_valid_spread",
            max(max(shares) - min(shares) for _, shares in found),
            f"{len(found)} streams of dampers of foreign laws, each in blocks of "
            f"{', '.join(map(str, SIZES))} samples at 1 kHz: largest difference of the share of "
            "the time for which the force is valid, in points.",
            (0.0, 3.0),
            "; ".join(
                f"{case.law}, {case.motion}, {case.current}: "
                + ", ".join(f"{share:.1f}" for share in shares)
                for case, shares in found
            ),
        )
    ]
