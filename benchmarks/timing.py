"""Times that can be compared on a machine that is busy with other things."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence


def cpu_seconds(work: Callable[[], object]) -> float:
    """Processor time [s] of this process for one call; on an idle machine that is wall time.

    Everything measured with it runs on one thread.
    """
    began = time.process_time()
    work()
    return time.process_time() - began


def interleaved_medians(
    works: Sequence[Callable[[], object]], repetitions: Sequence[int]
) -> list[float]:
    """Median :func:`cpu_seconds` of each work, run in turn so that disturbances hit all.

    In each of as many rounds as the smallest number of ``repetitions``, every work runs its
    share of its own number in a row.
    """
    rounds = min(repetitions)
    times: list[list[float]] = [[] for _ in works]
    for _ in range(rounds):
        for place, (work, number) in enumerate(zip(works, repetitions, strict=True)):
            times[place] += [cpu_seconds(work) for _ in range(number // rounds)]
    return [statistics.median(entries) for entries in times]
