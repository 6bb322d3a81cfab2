"""The newest rows of a table of numbers, in memory that never grows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mr_damper_ros.signals.arrays import Array

_PART = 4
"""A full table loses so large a part of its rows at once: making room costs little per row."""


class RollingTable:
    """Rows of numbers, counted from 0 since the beginning.

    A full table loses its oldest quarter. One that ``thins`` loses every second row of its older
    half instead: what lies far back stays in view, ever more coarsely.
    """

    def __init__(self, columns: Sequence[str], capacity: int, *, thins: bool = False) -> None:
        if capacity < 2 * _PART:
            raise ValueError(f"capacity must be at least {2 * _PART}, not {capacity}")
        self.columns = ("index", *columns)
        self._thins = thins
        # Filled, so that all of the memory is taken at once.
        self._rows = np.full((capacity, len(self.columns)), np.nan)
        self._size = 0
        self._next = 0

    def __len__(self) -> int:
        return self._size

    @property
    def next_index(self) -> int:
        """The number that the next row will have."""
        return self._next

    def append(self, values: Sequence[float]) -> None:
        """Add a row; raises ValueError where the values are not as many as the columns."""
        if len(values) != len(self.columns) - 1:
            raise ValueError(f"{len(values)} values do not fill {len(self.columns) - 1} columns")
        if self._size == len(self._rows):
            self._make_room()
        row = self._rows[self._size]
        row[0] = self._next
        row[1:] = values
        self._size += 1
        self._next += 1

    def after(self, index: int) -> Array:
        """The rows after the one of this number, shape (k, columns), their numbers first."""
        start = int(np.searchsorted(self._rows[: self._size, 0], index, side="right"))
        return self._rows[start : self._size].copy()

    def _make_room(self) -> None:
        half = self._size // 2
        if self._thins:
            kept = np.concatenate([self._rows[:half:2], self._rows[half : self._size]])
        else:
            kept = self._rows[self._size // _PART : self._size].copy()
        self._size = len(kept)
        self._rows[: self._size] = kept
