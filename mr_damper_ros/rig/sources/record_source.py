"""A record file as a source."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from mr_damper_ros.rig.rig_block import RigBlock
from mr_damper_ros.rig.sources.recorded_blocks import checked, recorded_blocks
from mr_damper_ros.rig.sources.source import Source, StreamSettings
from mr_damper_ros.settings.option_table import ParameterTable, option
from mr_damper_ros.signals.recording import Recording


@dataclass(frozen=True)
class RecordOptions(ParameterTable):
    """The record file of ``source: record``."""

    file: str = option("", "Path of a text, CSV or MAT file.", read_only=True)
    columns: str = option(
        "",
        "What its columns hold, and the units, such as time:s,displacement:mm,force:N,current:A; "
        "a column to skip is a minus sign, all that follow the last one are three dots.",
        read_only=True,
    )
    current: float = option(
        math.nan,
        "Supply current [A] of the whole record, where no column holds it.",
        read_only=True,
    )
    period: float = option(
        math.nan, "Time between two samples [s], where no column holds the time.", read_only=True
    )
    variable: str = option(
        "", "Name of the matrix in a MAT file that holds more than one.", read_only=True
    )

    def objection(self) -> str:
        """Say what is missing."""
        if not self.file:
            return (
                "source is record, but no file is given: set the parameter record.file to the "
                "path of one"
            )
        if not self.columns:
            return (
                "source is record, but record.columns is empty: say what the columns hold, such "
                "as time:s,displacement:mm,force:N"
            )
        return ""


class RecordSource(Source):
    """The samples of a text, CSV or MAT file."""

    options = RecordOptions
    prefix = "record."

    def __init__(self, settings: RecordOptions, stream: StreamSettings) -> None:
        super().__init__(settings, stream)
        self._recordings: Sequence[Recording] = ()

    def open(self) -> list[str]:
        """Read the file."""
        from mr_damper_ros.io.records import read_record

        given = self.settings
        recording = read_record(
            given.file,
            given.columns,
            current=None if math.isnan(given.current) else given.current,
            period=None if math.isnan(given.period) else given.period,
            variable=given.variable or None,
        )
        self._recordings = [recording]
        return checked(self._recordings)

    def blocks(self, start_ns: int) -> Iterator[RigBlock]:
        """The samples of the record."""
        return recorded_blocks(self._recordings, self.stream, start_ns)

    def close(self) -> None:
        """Forget the record."""
        self._recordings = ()
