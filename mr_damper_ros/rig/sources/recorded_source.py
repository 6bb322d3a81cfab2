"""Recordings as sources: a bag, or a record file."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.data_check.recordings import require_units
from mr_damper_ros.rig.sources.source import Source
from mr_damper_ros.settings.option_table import ParameterTable, option
from mr_damper_ros.signals.blocks import NANOSECONDS, RigBlock
from mr_damper_ros.signals.recording import Recording

_PAUSE_NS = NANOSECONDS
"""Gap [ns] in the stamps between two recordings, and before a recording repeats, so that no window
spans two motions."""


@dataclass(frozen=True)
class BagOptions(ParameterTable):
    """The bag of ``source: bag``."""

    bag: str = option(
        "", "Path of the bag of `source: bag`: its folder, or its .mcap or .db3 file."
    )

    def objection(self) -> str:
        """Return the reason if the path is missing, or an empty string."""
        if not self.bag:
            return "source is bag, but no bag is given: set the parameter bag to the path of a bag"
        return ""

    def read(self) -> list[Recording]:
        """The recordings of the bag; raises ValueError or OSError."""
        from mr_damper_ros.io.bag_reader import read_bag

        return read_bag(self.bag)


class RecordedSource(Source):
    """Recordings, one after the other."""

    _recordings: Sequence[Recording] = ()

    def open(self) -> list[str]:
        """Read the file; raises RecordingError if a recording is not plausible."""
        self._recordings = self.settings.read()
        found = []
        for recording in self._recordings:
            require_units(recording)
            details = "".join(f"; {key}: {value}" for key, value in recording.details.items())
            size = f"{recording.sample_count} samples, {recording.duration:.3g} s"
            found.append(f"{recording.name}: {size}{details}")
        return found

    def blocks(self, start_ns: int) -> Iterator[RigBlock]:
        """Yield the samples of all recordings; in a loop, stamps and numbering continue."""
        size, sequence = self.stream.block_size, 0
        rounds = itertools.count() if self.stream.loop else range(1)
        for recording in (each for _ in rounds for each in self._recordings):
            count, celsius = recording.sample_count, recording.temperature
            temperature = np.full(count, math.nan) if celsius is None else celsius
            rows = np.stack(
                [recording.displacement, recording.force, recording.current, temperature]
            )
            for first in range(0, count, size):
                stamp_ns = start_ns + round(first * recording.period * NANOSECONDS)
                part = rows[:, first : first + size]
                yield RigBlock(stamp_ns, sequence + first, recording.period, *part)
            sequence += count
            start_ns += round(count * recording.period * NANOSECONDS) + _PAUSE_NS

    def close(self) -> None:
        """Discard the recordings."""
        self._recordings = ()


class BagSource(RecordedSource):
    """The recordings in a bag, one after the other."""

    options = BagOptions
    prefix = ""


@dataclass(frozen=True)
class RecordOptions(ParameterTable):
    """The record file of ``source: record``."""

    file: str = option("", "Path of a text, CSV or MAT file.")
    columns: str = option(
        "",
        "Columns and their units, such as time:s,displacement:mm,force:N,current:A; a minus "
        "sign skips a column, and three dots at the end skip all further columns.",
    )
    current: float = option(
        math.nan,
        "Constant supply current [A] of a record without a current column; .nan if it has one.",
    )
    period: float = option(
        math.nan, "Sample period [s] of a record without a time column; .nan if it has one."
    )
    variable: str = option("", "Name of the matrix in a MAT file with several matrices.")

    def objection(self) -> str:
        """Return the reason if an option is missing, or an empty string."""
        if not self.file:
            return (
                "source is record, but no file is given: set the parameter record.file to the "
                "path of a file"
            )
        if not self.columns:
            return (
                "source is record, but record.columns is empty: name the columns and their units, "
                "such as time:s,displacement:mm,force:N"
            )
        return ""

    def read(self) -> list[Recording]:
        """The recording of the file; raises ValueError or OSError."""
        from mr_damper_ros.io.records import read_record

        current, period = (None if math.isnan(v) else v for v in (self.current, self.period))
        variable = self.variable or None
        return [
            read_record(self.file, self.columns, current=current, period=period, variable=variable)
        ]


class RecordSource(RecordedSource):
    """The samples of a text, CSV or MAT file."""

    options = RecordOptions
    prefix = "record."
