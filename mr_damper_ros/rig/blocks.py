"""Blocks between a source and its topics: cutting, alignment of the channels and subsampling."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, RigBlock

_LARGEST = 1e9
"""Upper limit of displacement [m] and force [N]; larger values are implausible for any press."""


class Measured(NamedTuple):
    """The values measured at one time [m, N, A, °C]; NaN if there is no such channel."""

    displacement: float
    force: float
    current: float = math.nan
    temperature: float = math.nan

    @property
    def possible(self) -> bool:
        """Whether displacement and force are finite and plausible."""
        return abs(self.displacement) < _LARGEST and abs(self.force) < _LARGEST


class BlockMaker:
    """Cuts blocks of ``size`` samples; a block ends early if a sample is missing."""

    def __init__(self, size: int) -> None:
        self._size = size
        # Stamp [ns] and number of the first sample of the current block, and its period [s].
        self._first = (0, 0, 1.0)
        self._begun: list[Measured] = []
        self._made: list[RigBlock] = []
        self.last_ns = 0
        """Stamp of the last sample."""

    def add(self, index: int, stamp_ns: int, period: float, measured: Measured) -> None:
        """Add a sample with its number, its stamp [ns] and the time [s] to the next sample."""
        _, first, begun_period = self._first
        if self._begun and (index != first + len(self._begun) or period != begun_period):
            self.cut()
        if not self._begun:
            self._first = (stamp_ns, index, period)
        self._begun.append(measured)
        self.last_ns = stamp_ns
        if len(self._begun) == self._size:
            self.cut()

    def cut(self) -> None:
        """End the current block, even if it is not full."""
        if self._begun:
            rows = np.array(self._begun, dtype=np.float64).T.copy()
            self._made.append(RigBlock(*self._first, *rows))
            self._begun = []

    def take(self) -> list[RigBlock]:
        """Remove and return the complete blocks; one block without samples if there are none."""
        made, self._made = self._made, []
        return made or [RigBlock(self.last_ns, 0, 1.0, *np.empty((4, 0)))]


_NODES = np.arange(4)
"""Samples in the cubic interpolation, newest first."""


def aligned(blocks: Iterable[RigBlock], lateness: float) -> Iterator[RigBlock]:
    """Yield the blocks with displacement and force aligned; the force lags by ``lateness`` [s].

    If ``lateness`` is negative, the displacement lags. The leading channel is delayed by cubic
    interpolation of four samples, and the stamps are moved back to the time of measurement. After a
    gap the first samples are omitted, because the matching values of the other channel are missing.
    """
    if lateness == 0.0:
        yield from blocks
        return
    ahead, behind = ("displacement", "force") if lateness > 0.0 else ("force", "displacement")
    past: Array = np.empty(0)
    expected = None
    for block in blocks:
        if block.sample_count == 0:
            yield block
            continue
        delay = abs(lateness) / block.period
        back = max(math.floor(delay) - 1, 0)
        # The weights of four samples that interpolate every cubic exactly.
        weights = np.linalg.solve(
            np.vander(_NODES, increasing=True).T, (delay - back) ** _NODES.astype(np.float64)
        )
        if block.sequence != expected:
            past = np.empty(0)
        expected = block.sequence + block.sample_count
        known = np.concatenate([past, getattr(block, ahead)])
        past = known[-(back + _NODES.size) :]
        # Value k is interpolated from the samples k - back - 3 to k - back.
        delayed = np.convolve(known, weights, "valid")[: max(known.size - back - 3, 0)]
        skipped = block.sample_count - min(delayed.size, block.sample_count)
        if skipped == block.sample_count:
            continue
        other = getattr(block, behind)[skipped:]
        yield replace(
            block,
            start_ns=block.stamp_ns(skipped) - round(abs(lateness) * NANOSECONDS),
            sequence=block.sequence + skipped,
            current=block.current[skipped:],
            temperature=block.temperature[skipped:],
            **{ahead: delayed[-other.size :], behind: other},
        )


class Decimator:
    """Picks at most ``rate`` samples per second of data; with 0, none.

    The selection restarts if the stamps jump back.
    """

    def __init__(self, rate: float) -> None:
        self._interval_ns = round(NANOSECONDS / rate) if rate else 0
        self._due_ns = 0

    def due(self, start_ns: int, period: float, count: int) -> Iterator[tuple[int, int]]:
        """Indices and stamps [ns] of the samples to pick.

        The block has ``count`` samples, ``period`` [s] apart.
        """
        if self._interval_ns == 0:
            return
        period_ns = period * NANOSECONDS
        if not -self._interval_ns <= start_ns - self._due_ns <= self._interval_ns:
            self._due_ns = start_ns
        # Because stamps are rounded, a sample may be picked half a sample early; otherwise some
        # would be picked one sample too late.
        k = max(math.ceil((self._due_ns - start_ns) / period_ns - 0.5), 0)
        while k < count:
            stamp_ns = start_ns + round(k * period_ns)
            yield k, stamp_ns
            self._due_ns += self._interval_ns
            k = max(math.ceil((self._due_ns - start_ns) / period_ns - 0.5), k + 1)


class Meter:
    """Picks the readings that an instrument with a lower sample rate would report.

    There is a reading every ``period`` seconds, and another one whenever the value has changed by
    more than ``step`` since the last reading. Unknown values (NaN) are not reported.
    """

    def __init__(self, period: float, *, step: float = math.inf) -> None:
        self._decimator = Decimator(1.0 / period)
        self._step = step
        self._last = math.nan

    def read(self, block: RigBlock, values: Array, ahead_ns: int = 0) -> list[tuple[int, float]]:
        """Stamp [ns] and value of each reading in a block; ``values`` has shape (n,).

        ``ahead_ns`` is the offset of the instrument's clock from the clock of the samples.
        """
        due = self._decimator.due(block.start_ns, block.period, values.size)
        regular = {index for index, _ in due}
        moved = np.flatnonzero(np.diff(values, prepend=self._last))
        readings = []
        for index in sorted(regular.union(moved.tolist())):
            value = float(values[index])
            if index in regular or abs(value - self._last) > self._step:
                self._last = value
                if not math.isnan(value):
                    readings.append((block.stamp_ns(index) + ahead_ns, value))
        return readings
