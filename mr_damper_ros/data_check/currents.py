"""Currents that contradict the forces, within a run and between runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from mr_damper_ros.data_check.findings import Finding, Kind
from mr_damper_ros.kinematics.window import TURN, Window, turning_points
from mr_damper_ros.models.quantities import SAME_CURRENT
from mr_damper_ros.signals.arrays import Array

_CONTRADICTING = 1.5
"""Ratio of loop heights above which runs contradict each other.

Heating to 70 °C causes a ratio of 1.35.
"""


_NO_FORCE = 1e-9
"""A force [N] by which can be divided."""


def current_findings(runs: Mapping[str, Sequence[Window]]) -> list[Finding]:
    """Findings on currents that are inconsistent with the heights of the loops, by run.

    The force increases with the current. At equal current and speed, only the temperature changes
    it.
    """
    found, middles = list[Finding](), dict[str, tuple[float, float, float]]()
    for name, windows in runs.items():
        table = _fast_cycles(windows)
        if len(table):
            found += [replace(each, source=name) for each in _within(table)]
            speed, current, height = np.median(table, axis=0).tolist()
            middles[name] = speed, current, height
    pairs = {pair: _ratio(*(middles[name] for name in pair)) for pair in combinations(middles, 2)}
    named = set[str]()
    for pair in sorted(pairs, key=pairs.__getitem__, reverse=True):
        # One wrong current contradicts every other run.
        if pairs[pair] > _CONTRADICTING and named.isdisjoint(pair):
            named.update(pair)
            one, two = pair
            (_, i1, f1), (_, i2, f2) = middles[one], middles[two]
            each = Kind.CONTRADICTING.found(
                "current", value=pairs[pair], f1=f1, i1=i1, f2=f2, i2=i2, other=two
            )
            found.append(replace(each, source=one))
    return found


def _fast_cycles(windows: Sequence[Window]) -> Array:
    """Peak velocity [m/s], current [A] and loop height [N] of the fastest cycles, shape (n, 3).

    These reach 85 % of the largest peak velocity.
    """
    found = []
    for window in windows:
        position = window.motion.displacement
        strokes = turning_points(position.tolist(), TURN * float(np.ptp(position))).tolist()
        for first, last in zip(strokes, strokes[2:], strict=False):
            cycle = slice(first, last)
            current = window.current[cycle]
            if float(np.ptp(current)) <= SAME_CURRENT:
                speed = float(np.max(np.abs(window.motion.velocity[cycle])))
                height = 0.5 * float(np.ptp(window.force[cycle]))
                found.append((speed, float(np.mean(current)), height))
    table = np.array(found).reshape(-1, 3)
    return table[table[:, 0] >= 0.85 * table[:, 0].max(initial=0.0)]


def _within(table: Array) -> list[Finding]:
    """A finding on different loop heights at one current.

    It compares the second smallest and the second largest height, so that a single disturbance
    causes none.
    """
    _, currents, every = table.T
    for current in np.unique(np.round(currents / SAME_CURRENT)) * SAME_CURRENT:
        heights = np.sort(every[np.abs(currents - current) <= SAME_CURRENT])
        if heights.size >= 4 and heights[-2] > _CONTRADICTING * heights[1] > 0.0:
            ratio, ends = heights[-2] / heights[1], {"low": heights[1], "high": heights[-2]}
            return [Kind.SEVERAL_CURRENTS.found("current", value=ratio, current=current, **ends)]
    return []


def _ratio(one: tuple[float, float, float], two: tuple[float, float, float]) -> float:
    """Ratio by which the forces of two runs contradict their currents; 0 at different speeds.

    The arguments are peak velocity [m/s], current [A] and force [N].
    """
    (v1, i1, f1), (v2, i2, f2) = one, two
    if abs(v1 - v2) > 0.2 * max(v1, v2):
        return 0.0
    if abs(i1 - i2) <= SAME_CURRENT:
        return max(f1, f2) / max(min(f1, f2), _NO_FORCE)
    weak, strong = (f1, f2) if i1 < i2 else (f2, f1)
    return weak / max(strong, _NO_FORCE)
