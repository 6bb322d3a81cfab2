"""The columns of a record as the file has them, before units."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mr_damper_ros.signals.arrays import Array

MAXIMUM_SAMPLES = 10_000_000
"""Samples that a reader takes unless it is told otherwise: 2.8 h at 1 kHz, about 1.5 GB."""


class RecordError(ValueError):
    """A record that cannot be read; the message says what to change."""


@dataclass(frozen=True, eq=False)
class RawTable:
    """Raw values by quantity, shape (n,); ``place`` says in words where a row is, for messages.

    ``period`` [s] is the time between rows where the file tells it by itself.
    """

    values: dict[str, Array]
    place: Callable[[int], str]
    period: float | None = None

    @property
    def row_count(self) -> int:
        """Number of rows n."""
        return int(next(iter(self.values.values())).size)


def too_long(name: str, maximum_samples: int) -> RecordError:
    """The error for a file that holds more than may be read."""
    return RecordError(
        f"{name} holds more than {maximum_samples} samples: split it, or allow more "
        "(import_record --maximum-samples)"
    )
