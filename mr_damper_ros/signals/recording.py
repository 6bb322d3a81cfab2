"""One uninterrupted recording of a damper in a test machine, in SI units, and its stream."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from mr_damper_ros.signals.arrays import Array, samples_of, usable
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock

DEFAULT_START_NS = 1_672_531_200 * NANOSECONDS
"""Stamp of the first sample if the time of a recording is unknown: 1 January 2023, 0:00 UTC.

Many ROS programs interpret a stamp near zero as "time unknown".
"""

LARGEST_MOTION, LARGEST_FORCE, LARGEST_CURRENT = 0.5, 1e6, 50.0
"""Largest plausible span of a displacement [m], also between two samples, force [N], current [A].
"""

TEMPERATURES = (-60.0, 250.0)
"""Range [°C] of plausible temperatures."""


class RecordingError(ValueError):
    """A recording cannot be used; the message says what to change."""


class NotFiniteError(RecordingError):
    """A sample of a recording is not finite; has its ``quantity`` and index (``sample``)."""

    def __init__(self, sentence: str, quantity: str, sample: int) -> None:
        super().__init__(sentence)
        self.quantity = quantity
        self.sample = sample


@dataclass(frozen=True, eq=False)
class Recording:
    """Samples of displacement, force and current at a fixed period.

    ``displacement`` [m] (extension positive), ``force`` [N] (tension positive), ``current`` [A]
    and, if it was measured, ``temperature`` [°C] have shape (n,). Sample k was taken at
    ``start_ns`` + k ``period`` (nanoseconds since the epoch, seconds). ``details`` describes the
    origin of the recording and is stored in the metadata of a bag. The samples in ``gaps`` were not
    recorded, but are interpolated; a bag does not hold them.

    The constructor checks the values, so all later computations may assume finite values.

    Raises RecordingError if there are no samples, lengths differ, a value is not finite or its
    magnitude exceeds 1e12 (NotFiniteError), or the period is not 1 ns to 1e9 s.
    """

    name: str
    start_ns: int
    period: float
    displacement: Array
    force: Array
    current: Array
    temperature: Array | None = None
    details: dict[str, str] = field(default_factory=dict)
    gaps: tuple[slice, ...] = ()

    def __post_init__(self) -> None:
        period = np.asarray(self.period, dtype=np.float64)
        if period.size != 1 or not 1e-9 <= period.item() <= 1e9:
            raise RecordingError(
                f"the sample period of '{self.name}' is {self.period} s: it must be positive, "
                "1e-9 to 1e9"
            )
        # Numbers of NumPy would make every comparison with them a number of NumPy, too.
        object.__setattr__(self, "start_ns", int(self.start_ns))
        object.__setattr__(self, "period", period.item())
        object.__setattr__(self, "details", {str(k): str(v) for k, v in self.details.items()})
        for name in ("displacement", "force", "current", "temperature"):
            values = getattr(self, name)
            if values is None and name == "temperature":
                continue
            object.__setattr__(self, name, self._checked(name, values))

    def _checked(self, name: str, values: Array) -> Array:
        array = samples_of(values)
        if array.ndim != 1:
            raise RecordingError(
                f"the {name} of '{self.name}' has shape {array.shape}: give a list of samples"
            )
        if array.size == 0:
            raise RecordingError(f"the {name} of '{self.name}' holds no samples")
        if array.size != np.size(self.displacement):
            raise RecordingError(
                f"'{self.name}' holds {np.size(self.displacement)} displacements but "
                f"{array.size} values of {name}: give one for each sample"
            )
        possible = usable(array)
        if not possible.all():
            index = int(np.argmin(possible))
            raise NotFiniteError(
                f"the {name} of sample {index} of '{self.name}' is {array[index]}: "
                "cut the recording before it, or correct the value",
                name,
                index,
            )
        array.flags.writeable = False
        return array

    @property
    def sample_count(self) -> int:
        """Number of samples n."""
        return int(self.displacement.size)

    @property
    def duration(self) -> float:
        """Duration [s] of the recording, n times the period."""
        return self.sample_count * self.period

    @property
    def time(self) -> Array:
        """Time of each sample [s] since the first, shape (n,)."""
        return np.arange(self.sample_count, dtype=np.float64) * self.period

    def part(self, chosen: slice) -> Recording:
        """The samples of a slice without a stride."""
        first, last, _ = chosen.indices(self.sample_count)
        if (first, last) == (0, self.sample_count):
            return self
        channels: dict[str, Any] = {
            name: None if (values := getattr(self, name)) is None else values[chosen]
            for name in ("displacement", "force", "current", "temperature")
        }
        gaps = tuple(
            slice(max(gap.start, first) - first, min(gap.stop, last) - first)
            for gap in self.gaps
            if gap.stop > first and gap.start < last
        )
        return replace(self, start_ns=self.stamp_ns(first), gaps=gaps, **channels)

    def stamp_ns(self, index: int) -> int:
        """Stamp of a sample [ns since the epoch]."""
        return self.start_ns + round(index * self.period * NANOSECONDS)


BLOCK_SIZE = 10
"""Number of samples in a block, the default of the bridge."""


class CurrentReading(NamedTuple):
    """Supply current [A] that holds from a stamp on."""

    stamp_ns: int
    current: float


class TemperatureReading(NamedTuple):
    """Temperature [°C] of the damper at a stamp."""

    stamp_ns: int
    celsius: float


StreamItem = SampleBlock | CurrentReading | TemperatureReading


def stream_of(recording: Recording, block_size: int = BLOCK_SIZE) -> Iterator[StreamItem]:
    """The samples of a recording in blocks, each preceded by the readings for its samples.

    There is a reading of the current at each change and at the last sample of each block, and one
    reading of a measured temperature per block. Raises ValueError for a block size below 1.
    """
    if block_size < 1:
        raise ValueError(f"the block size is {block_size}: it must be at least 1")
    changes = np.flatnonzero(np.diff(recording.current, prepend=math.nan))
    starts = [0, *(gap.stop for gap in recording.gaps)]
    stops = [*(gap.start for gap in recording.gaps), recording.sample_count]
    blocks = [
        (first, min(first + block_size, stop) - 1)
        for start, stop in zip(starts, stops, strict=True)
        for first in range(start, stop, block_size)
    ]
    for first, last in blocks:
        inside = changes[np.searchsorted(changes, first) : np.searchsorted(changes, last)]
        for place in (*inside.tolist(), last):
            yield CurrentReading(recording.stamp_ns(place), float(recording.current[place]))
        if recording.temperature is not None:
            yield TemperatureReading(recording.stamp_ns(last), float(recording.temperature[last]))
        part = slice(first, last + 1)
        yield SampleBlock(
            recording.stamp_ns(first),
            first,
            recording.period,
            recording.displacement[part],
            recording.force[part],
        )
