"""What the measured force was like over the latest cycles: its peak, its noise, its power."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress, product

import numpy as np

from mr_damper_ros.signals.arrays import Array, span_of, white_noise
from mr_damper_ros.tracking.model_bank import SAME_CURRENT

_HALF_CYCLES = 8
_SHORTEST_MEMORY = 2.0
_LONGEST_MEMORY = 120.0
"""The memory is so many half-cycles, and within these times [s]."""

_PEAK_MEMORY = 10.0
"""Seconds, or a cycle if that is longer, where the motion is not steady: eight half-cycles of it
may all be small ones, or go back to when it was another motion."""

_WILD = 20
"""One sample in so many may be wild to either side: the span is that of the rest ..."""

_FEWEST = 4
"""... but of no more than so many samples it is that of all."""

_STRETCHES = 32
_LONGEST_STRETCH = 0.25
"""The memory moves on by this part of it, or by so many seconds if that is less."""

_PRELOAD = 0.5
"""The middle of the force counts up to this part of half its span, as a gas pressure makes it. More
of it is a load cell that was not set to zero: the force of the damper must not vanish beside it."""

_FOR_POWER = 4
"""The power is that of so many half-cycles: what a spring takes it has given back by then."""

_SHORTEST_STUCK = 0.4
"""Seconds: no fast motion is followed so well that its half-cycle is a measure."""

_DRIVING = 0.1
"""Correlation of force and velocity below minus this: the force drives the motion."""

_STILL = 1e-9
"""Velocities [m/s] that are no motion."""


@dataclass(frozen=True)
class _Stretch:
    """Span and noise [N] of the measured force; sums of velocity and forces, and products.

    ``currents``: lowest and highest [A]; ``settled``: the stretch before had the same.
    """

    count: int
    top: float
    bottom: float
    noise: float
    sums: Array
    currents: tuple[float, float]
    settled: bool

    def had(self, current: float) -> bool:
        """Whether its force was that at this current [A] all along."""
        return self.settled and all(abs(end - current) <= SAME_CURRENT for end in self.currents)


class ForceStatistics:
    """Remembers some cycles of a stream of samples ``period`` [s] apart.

    ``peak`` and ``centre`` [N]: the largest size of the measured force and the middle of its span,
    but for wild samples; NaN before anything is known of it. Where the motion is not steady, those
    of ten seconds or a cycle. The force at another current counts for ten seconds at most, and no
    longer than until the present one has stayed for a cycle.
    ``noise`` [N]: standard deviation of its white part. ``stuck``: it has not changed at all for a
    half-cycle. ``measured_drives`` and ``predicted_drives``: that force puts power into the motion.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._parts: list[tuple[Array, Array, Array]] = []
        self._currents: list[tuple[float, float]] = []
        self._count = 0
        self._stretch = max(round(_SHORTEST_MEMORY / _STRETCHES / period), 1)
        self._past: deque[_Stretch] = deque()
        self._remembered = 0
        self._unchanged = 0
        self.peak = math.nan
        self.centre = math.nan
        self.noise = 0.0
        self.stuck = False
        self.measured_drives = False
        self.predicted_drives = False

    def add(
        self,
        forces: tuple[Array, Array],
        velocity: Array,
        current: Array | float,
        half_cycle: float,
        *,
        steady: bool,
    ) -> None:
        """Add samples of the predicted and the measured force [N] and the velocity [m/s], (n,).

        ``current`` [A] is a number or has shape (n,); ``half_cycle`` [s] is that of the motion, NaN
        before it is known; ``steady``: whether it is a sine that goes on.
        """
        self._parts.append((*forces, velocity))
        self._currents.append(
            (current, current) if isinstance(current, float) else span_of(current)
        )
        self._count += velocity.size
        if self._count >= self._stretch:
            self._finish(half_cycle, steady)

    def forget_predicted(self) -> None:
        """The predicted forces so far were those of other parameters."""
        self.predicted_drives = False
        self._parts = [(np.zeros(f.size), f, v) for _, f, v in self._parts]
        for stretch in self._past:
            stretch.sums[2] = stretch.sums[:, 3] = 0.0

    def _finish(self, half_cycle: float, steady: bool) -> None:
        predicted, measured, velocity = (
            np.concatenate(rows) for rows in zip(*self._parts, strict=True)
        )
        count, self._count = self._count, 0
        lows, highs = zip(*self._currents, strict=True)
        currents = min(lows), max(highs)
        self._parts.clear()
        self._currents.clear()
        if not np.isfinite(predicted).all():
            predicted = np.zeros(count)
        rows = np.stack((velocity, measured, predicted))
        wild = max(count // _WILD, 1) if count > _FEWEST else 0
        bottom, top = np.partition(measured, (wild, count - 1 - wild))[[wild, -1 - wild]].tolist()
        rows[1] = measured.clip(bottom, top)
        with np.errstate(over="ignore", invalid="ignore"):
            sums = np.column_stack((rows.sum(axis=1), rows @ rows.T))
        before = self._past[-1] if self._past else None
        unchanged = np.ptp(measured) == 0.0 and (
            before is None or top == before.top == before.bottom
        )
        self._unchanged = self._unchanged + count if unchanged else 0
        settled = before is None or all(
            abs(one - other) <= SAME_CURRENT for one, other in product(currents, before.currents)
        )
        noise = white_noise(measured)
        self._past.append(_Stretch(count, top, bottom, noise, sums, currents, settled))
        self._remembered += count
        # Without a half-cycle nothing is known of how long to remember: the shortest time.
        known = 0.0 if math.isnan(half_cycle) else half_cycle
        memory = min(max(_HALF_CYCLES * known, _SHORTEST_MEMORY), _LONGEST_MEMORY)
        self._stretch = max(round(min(memory / _STRETCHES, _LONGEST_STRETCH) / self._period), 1)
        unsteady = min(max(2.0 * known, _PEAK_MEMORY), _LONGEST_MEMORY)
        kept = max(memory, unsteady)
        while (self._remembered - self._past[0].count) * self._period >= kept:
            self._remembered -= self._past.popleft().count
        recent = self._latest(memory)
        self._judge_span(recent if steady else self._latest(unsteady), 2.0 * known)
        self.noise = sorted(stretch.noise for stretch in recent)[len(recent) // 2]
        self._judge_power(known)

    def _latest(self, time: float) -> list[_Stretch]:
        """The stretches of the latest so many seconds, newest first."""
        latest: list[_Stretch] = []
        count = 0
        for stretch in reversed(self._past):
            latest.append(stretch)
            count += stretch.count
            if count * self._period >= time:
                break
        return latest

    def _judge_span(self, stretches: Sequence[_Stretch], cycle: float) -> None:
        """That of stretches, newest first, of a motion of this ``cycle`` [s]."""
        current = stretches[0].currents[1]
        here = [stretch.had(current) for stretch in stretches]
        counts = np.array([stretch.count for stretch in stretches])
        stayed = int(counts[: (*here, False).index(False)].sum()) * self._period
        counted: Sequence[_Stretch] = stretches
        if not all(here):
            others = 0.0 if stayed >= max(cycle, _SHORTEST_MEMORY) else _PEAK_MEMORY
            ages = (counts.cumsum() - counts) * self._period
            counted = list(compress(stretches, here | (ages < others)))
        top, bottom = max(s.top for s in counted), min(s.bottom for s in counted)
        half, self.centre = 0.5 * (top - bottom), 0.5 * (top + bottom)
        self.peak = half + min(abs(self.centre), _PRELOAD * half)

    def _judge_power(self, half_cycle: float) -> None:
        self.stuck = self._unchanged * self._period > max(half_cycle, _SHORTEST_STUCK)
        self.measured_drives = self.predicted_drives = False
        latest = self._latest(_FOR_POWER * half_cycle)
        count = sum(stretch.count for stretch in latest)
        if half_cycle == 0.0 or count * self._period < 0.5 * _FOR_POWER * half_cycle:
            return
        with np.errstate(over="ignore", invalid="ignore"):
            sums = np.sum([stretch.sums for stretch in latest], axis=0)
            products = sums[:, 1:] - np.outer(sums[:, 0], sums[:, 0]) / count
            sizes = np.sqrt(np.maximum(np.diag(products), 0.0))
            if sizes[0] > _STILL * math.sqrt(count):
                self.measured_drives = bool(products[0, 1] < -_DRIVING * sizes[0] * sizes[1])
                self.predicted_drives = bool(products[0, 2] < -_DRIVING * sizes[0] * sizes[2])
