"""The newest samples of a stream, as one array: what is added or cut costs what it holds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock

_ROWS = 4
_LEAST_ROOM = 1024


class Samples(NamedTuple):
    """Displacement [m], force [N] and peak velocity [m/s] of samples, each of shape (n,).

    ``force_after`` [sample periods]: how long after the sample its force was measured.
    """

    displacement: Array
    force: Array
    peak_velocity: Array
    force_after: Array


class SampleStore:
    """Keeps what was added until it is forgotten; samples are counted from the first one on."""

    def __init__(self) -> None:
        self._values = np.empty((_ROWS, 0))
        self._stamps = np.empty(0, dtype=np.int64)
        self._begin = 0  # place of the first sample kept
        self._used = 0  # places used
        self.first = 0
        """Count of the first sample that is kept."""

    @property
    def end(self) -> int:
        """Count of the sample that comes next."""
        return self.first + self._used - self._begin

    def add(
        self,
        block: SampleBlock,
        peak_velocity: Array,
        measured: tuple[Array, Array] | None = None,
    ) -> None:
        """Add the samples of a block and the peak velocity [m/s] (n,) at them.

        ``measured``: forces [N] in place of the block's, and how many sample periods after each.
        """
        count = block.sample_count
        force, after = measured or (block.force, 0.0)
        self._make_room(count)
        place = slice(self._used, self._used + count)
        values = self._values[:, place]
        values[0], values[1], values[2], values[3] = block.displacement, force, peak_velocity, after
        # From the stamp of its own block: a sample clock that is not quite the nominal one must
        # not drift away from the stamps.
        offsets = np.rint(np.arange(count) * (block.period * NANOSECONDS))
        self._stamps[place] = block.start_ns + offsets.astype(np.int64)
        self._used += count

    def samples(self, start: int, stop: int) -> Samples:
        """The samples with these counts, as arrays of their own."""
        return Samples(*self._values[:, self._place(start) : self._place(stop)].copy())

    def displacement(self, start: int, stop: int) -> Array:
        """Displacement [m] of the samples with these counts, shape (n,); to be read at once."""
        return np.asarray(self._values[0, self._place(start) : self._place(stop)])

    def stamp_ns(self, count: int) -> int:
        """Stamp of the sample with this count."""
        return int(self._stamps[self._place(count)])

    def forget(self, before: int) -> None:
        """Let go of the samples before the one with this count."""
        gone = min(max(before - self.first, 0), self._used - self._begin)
        self._begin += gone
        self.first += gone

    def _place(self, count: int) -> int:
        return count - self.first + self._begin

    def _make_room(self, count: int) -> None:
        if self._used + count <= self._stamps.size:
            return
        kept = self._used - self._begin
        # Twice what is needed: then a sample is moved once on average, however small the blocks.
        room = max(2 * (kept + count), _LEAST_ROOM)
        values, stamps = np.empty((_ROWS, room)), np.empty(room, dtype=np.int64)
        values[:, :kept] = self._values[:, self._begin : self._used]
        stamps[:kept] = self._stamps[self._begin : self._used]
        self._values, self._stamps = values, stamps
        self._begin, self._used = 0, kept
