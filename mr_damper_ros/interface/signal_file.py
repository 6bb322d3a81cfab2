"""A planned run as a file of samples, for machines that play files."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from mr_damper_ros.estimation.planned_run import PlannedRun
from mr_damper_ros.processes.whole_files import write_text
from mr_damper_ros.signals.arrays import Array

COLUMNS = ("time:s", "displacement:m", "current:A")
"""Head of the file, as ``import_record`` takes it."""


def signal(run: PlannedRun, sample_rate: float) -> tuple[Array, Array, Array]:
    """Time [s], displacement [m] and current [A] of a run, each of shape (n,).

    It starts and ends at rest: the motion grows smoothly within two cycles, or a length of a motion
    that is no sine, at the first current, then comes the run itself, and it fades as it grew.
    """
    motion = run.motion
    grow = motion.growth
    count = round((run.duration + 2.0 * grow) * sample_rate) + 1
    time = np.arange(count) / sample_rate
    within = np.clip(np.minimum(time, run.duration + 2.0 * grow - time) / grow, 0.0, 1.0)
    envelope = within**3 * (10.0 - 15.0 * within + 6.0 * within**2)
    displacement, _, _ = motion.at(time - grow)
    return time, envelope * displacement, run.current_at(time - grow)


def write_signal(run: PlannedRun, path: Path, sample_rate: float = 1000.0) -> None:
    """Write the samples of a run as CSV, units in the head. Raises OSError."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in zip(*signal(run, sample_rate), strict=True):
        writer.writerow([f"{value:.9g}" for value in row])
    write_text(path, text.getvalue())
