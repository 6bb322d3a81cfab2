"""Reading of record files, which are tables of samples, into recordings in SI units."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from mr_damper_ros.io.binary_tables import FORMATS, read_binary_table
from mr_damper_ros.io.columns import MAXIMUM_SAMPLES, Columns, RecordError, parse_columns
from mr_damper_ros.io.run_cuts import find_runs, run_summary
from mr_damper_ros.io.sampled_record import SampledRecord
from mr_damper_ros.io.text_table import read_text_table
from mr_damper_ros.processes.files import irregularity
from mr_damper_ros.signals.recording import Recording


def read_record(
    path: str | Path,
    columns: str,
    *,
    current: float | None = None,
    period: float | None = None,
    start: float | None = None,
    stop: float | None = None,
    variable: str | None = None,
    moving_average: int | None = None,
    begins_in_motion: bool = False,
    maximum_samples: int = MAXIMUM_SAMPLES,
) -> Recording:
    """Read a record file into a recording.

    A velocity column is checked against the displacement and then discarded. Without displacement,
    the velocity is integrated, and ``details["note"]`` says so.

    Parameters
    ----------
    path
        Text, CSV, MAT, XLSX or TDMS file. The fields of a text file are separated by spaces, tabs,
        semicolons or commas. Numbers may have decimal commas, unless commas separate the fields.
        Any number of lines may precede the first row of numbers.
    columns
        Quantity and unit of each column from the left.

        See :func:`mr_damper_ros.io.columns.parse_columns`.
    current
        Current [A] of the whole record, if no column holds it.
    period
        Time between samples [s], if no column holds it.
    start
        Start of the part to read [s after the first sample].
    stop
        End of the part to read [s after the first sample].
    variable
        Matrix of a MAT file, sheet of a spreadsheet, or group of channels of a TDMS file, if there
        are several.
    moving_average
        Undo a moving average over this number of samples; exact if the record begins at rest.

        Other filters cannot be undone.
    begins_in_motion
        Whether the averaged record begins in motion. The result is then approximate: it lacks the
        part that the average removed, which is small in a record of many cycles.
    maximum_samples
        Largest number of samples; a file with more is rejected.

    Raises
    ------
    RecordError, ColumnError, RecordingError
        If the file or an option cannot be used; the message says what to change.
    OSError
        If the file cannot be read.
    """
    wanted = parse_columns(columns)
    if "current" not in wanted.quantities and current is None:
        raise RecordError(
            "the coil current is unknown: name its column (current:A), or give one for all samples"
        )
    _check_current(wanted, current)
    record = read_samples(path, wanted, period, variable, maximum_samples)
    if moving_average is not None:
        record = record.without_average(moving_average, begins_in_motion)
    return record.between(start, stop).recording(current)


def read_runs(
    path: str | Path,
    columns: str,
    *,
    currents: Sequence[float | None] | None = None,
    period: float | None = None,
    variable: str | None = None,
    maximum_samples: int = MAXIMUM_SAMPLES,
) -> list[Recording]:
    """Read a file with several successive runs into one recording per run.

    A run ends where the time jumps or restarts (the logger has paused), where the rod rests for at
    least one second, where a measured current changes, and where a steady cycle changes to another.
    ``currents`` [A] has one value per run if no column holds the current; None omits the run. The
    other parameters are as in :func:`read_record`.

    Raises the exceptions of :func:`read_record`. For a wrong number of currents, the message lists
    the runs.
    """
    return RunsOfFile(path, columns, period, variable, maximum_samples).recordings(currents)


class RunsOfFile:
    """The runs of a file, before their currents are known.

    ``summaries``: a description of each run; ``asks``: whether currents are needed. Raises the
    exceptions of :func:`read_runs`.
    """

    def __init__(
        self,
        path: str | Path,
        columns: str,
        period: float | None = None,
        variable: str | None = None,
        maximum_samples: int = MAXIMUM_SAMPLES,
    ) -> None:
        self._wanted = wanted = parse_columns(columns)
        self._record = read_samples(path, wanted, period, variable, maximum_samples)
        self._rows = find_runs(self._record)
        self._name = Path(path).name
        self.asks = "current" not in wanted.quantities
        self.summaries = [run_summary(self._record, rows) for rows in self._rows]
        if not self._rows:
            raise RecordError(f"{self._name} contains no run, because the displacement is constant")

    def recordings(self, currents: Sequence[float | None] | None) -> list[Recording]:
        """A recording of each run with a current, or of all runs if a column holds the current."""
        if not self.asks and currents is not None:
            raise RecordError("the current is given twice: by a column and for each run")
        if self.asks and len(currents or ()) != len(self._rows):
            listed = "; ".join(f"{k}: {text}" for k, text in enumerate(self.summaries, start=1))
            raise RecordError(
                f"{self._name} holds {len(self._rows)} runs, but {len(currents or ())} currents "
                f"are given: give one [A] for each run, or - to omit the run ({listed})"
            )
        recordings = []
        for number, rows in enumerate(self._rows, start=1):
            current = None if currents is None else currents[number - 1]
            if self.asks and current is None:
                continue
            _check_current(self._wanted, current)
            run = self._record.part(rows)
            recordings.append(run.recording(current, f"{Path(self._name).stem}_{number}"))
        return recordings


def read_samples(
    path: str | Path,
    wanted: Columns,
    period: float | None,
    variable: str | None,
    maximum_samples: int,
) -> SampledRecord:
    """The columns of a file in SI units. Raises the exceptions of :func:`read_record`."""
    path = Path(path)
    if "time" in wanted.quantities and period is not None:
        raise RecordError("the time is given twice: by a column and by the period")
    if period is not None and not (math.isfinite(period) and period > 0.0):
        raise RecordError(f"the period is {period} s: it must be positive")
    kind = irregularity(path)
    if kind:
        raise RecordError(f"{path} is {kind}: give a text, CSV, MAT, XLSX or TDMS file")
    if path.stat().st_size == 0:
        raise RecordError(f"{path.name} is empty: give a file with at least two rows of numbers")
    read = read_binary_table if path.suffix.lower() in FORMATS else read_text_table
    table = read(path, wanted, variable, maximum_samples)
    if "time" not in wanted.quantities and period is None:
        period = table.period
        if period is None:
            raise RecordError(
                "the time between samples is unknown: name the column of the time (time:s), or "
                "give the period"
            )
    return SampledRecord.of(path, table, wanted, period)


def _check_current(wanted: Columns, current: float | None) -> None:
    if current is None:
        return
    if "current" in wanted.quantities:
        raise RecordError("the current is given twice: by a column and as a constant")
    if not math.isfinite(current):
        raise RecordError(f"the current is {current} A: give a finite number")
