"""What in the runs looks wrong and may be right: it is said, and nothing is refused for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np

from mr_damper_ros.interface.measured_runs import MeasuredRun
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.moving_average import find_average

_FULL_SPEED = 0.85
"""Cycles are compared that reach this part of the fastest one's peak velocity."""

_SAME_SPEED = 0.2
"""Runs are compared whose peak velocities differ by less, in parts of the larger one."""

_SAME_CURRENT = 0.05
"""Currents [A] that count as the same."""

_TURNED = 0.1
"""Part of the peak velocity at which a stroke has begun."""

_CONTRADICTING = 1.5
"""Loops at one current that differ in height by this factor: heating to 70 °C takes 1.35."""

_MOST = 3
"""Pairs of runs that are named."""


@dataclass(frozen=True, eq=False)
class _Cycles:
    """Peak velocity [m/s], current [A] and loop height [N] of the cycles of a run, shape (n,)."""

    speed: Array
    current: Array
    height: Array

    def fast(self) -> _Cycles:
        chosen = self.speed >= _FULL_SPEED * self.speed.max(initial=0.0)
        return _Cycles(self.speed[chosen], self.current[chosen], self.height[chosen])


def remarks_on(runs: Sequence[MeasuredRun]) -> tuple[str, ...]:
    """All that seems wrong with runs: with each of them, their currents and their making."""
    return (
        *(remark for run in runs for remark in run.remarks),
        *doubts_of_currents(runs),
        *_averages(runs),
    )


def _averages(runs: Sequence[MeasuredRun]) -> list[str]:
    """A sentence on the runs whose makers have averaged the force."""
    counts = {run.name: find_average(run.longest.force) for run in runs}
    named = [f"{name} ({count} samples)" for name, count in counts.items() if count > 1]
    if not named:
        return []
    listed = ", ".join(named[:_MOST]) + (
        f" and {len(named) - _MOST} more runs" if len(named) > _MOST else ""
    )
    return [
        f"a moving average shows in the force of {listed}: no law holds between averages of a fast "
        "motion; import_record --undo-moving-average N brings back what was averaged, where the "
        "record begins at rest"
    ]


def doubts_of_currents(runs: Sequence[MeasuredRun]) -> list[str]:
    """Sentences on currents that the heights of the loops contradict.

    The force rises with the current, and it is the same at the same current and speed, but for the
    temperature.
    """
    fast = [_cycles(run.windows).fast() for run in runs]
    doubts = [text for run, cycles in zip(runs, fast, strict=True) for text in _within(run, cycles)]
    known = [(run, cycles) for run, cycles in zip(runs, fast, strict=True) if cycles.speed.size]
    pairs = [text for one, two in combinations(known, 2) for text in _between(*one, *two)]
    if len(pairs) > _MOST:
        pairs = [*pairs[:_MOST], f"{len(pairs) - _MOST} more pairs of runs contradict each other"]
    return doubts + pairs


def _cycles(windows: Sequence[Window]) -> _Cycles:
    found = []
    for window in windows:
        velocity = window.motion.velocity
        strokes = _strokes(velocity)
        for (first, _), (_, last) in pairwise(strokes):
            cycle = slice(first, last)
            current = window.current[cycle]
            if float(np.ptp(current)) <= _SAME_CURRENT:
                speed = float(np.max(np.abs(velocity[cycle])))
                height = 0.5 * float(np.ptp(window.force[cycle]))
                found.append((speed, float(np.mean(current)), height))
    table = np.array(found).reshape(-1, 3)
    return _Cycles(table[:, 0], table[:, 1], table[:, 2])


def _strokes(velocity: Array) -> list[tuple[int, int]]:
    """First index and last + 1 of each stretch of a motion in one direction."""
    limit = _TURNED * float(np.max(np.abs(velocity)))
    moving = np.flatnonzero(np.abs(velocity) > limit)
    turns = moving[1:][np.diff(np.sign(velocity[moving])) != 0.0]
    return list(pairwise([int(moving[0]), *turns.tolist(), int(moving[-1]) + 1]))


def _within(run: MeasuredRun, cycles: _Cycles) -> list[str]:
    """Heights at one current that differ, two cycles of each: a single jolt says nothing."""
    doubts = []
    for current in np.unique(np.round(cycles.current / _SAME_CURRENT)) * _SAME_CURRENT:
        heights = np.sort(cycles.height[np.abs(cycles.current - current) <= _SAME_CURRENT])
        if heights.size >= 4 and heights[-2] > _CONTRADICTING * heights[1]:
            doubts.append(
                f"{run.name}: at {current:.3g} A and the same speed the force reaches "
                f"{heights[1]:.3g} N in some cycles and {heights[-2]:.3g} N in others: does the "
                "record hold several currents? (import_record --split cuts it into its runs)"
            )
    return doubts[:1]


def _between(one: MeasuredRun, a: _Cycles, two: MeasuredRun, b: _Cycles) -> list[str]:
    speeds = float(np.median(a.speed)), float(np.median(b.speed))
    if max(speeds) - min(speeds) > _SAME_SPEED * max(speeds):
        return []
    currents = float(np.median(a.current)), float(np.median(b.current))
    heights = float(np.median(a.height)), float(np.median(b.height))
    ratio = heights[0] / heights[1] if currents[0] < currents[1] else heights[1] / heights[0]
    if abs(currents[0] - currents[1]) <= _SAME_CURRENT:
        ratio = max(heights) / min(heights)
    if ratio <= _CONTRADICTING:
        return []
    return [
        f"{one.name} and {two.name}: the force reaches {heights[0]:.3g} N at {currents[0]:.3g} A "
        f"and {heights[1]:.3g} N at {currents[1]:.3g} A, at the same speed: is a current wrong?"
    ]
