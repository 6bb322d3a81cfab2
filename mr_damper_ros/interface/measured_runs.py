"""Runs of a damper, from whatever users have: bags, recordings, arrays."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from mr_damper_ros.io.recording_list import RECORD_ENDINGS
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.processes.process_pool import ProcessPool, Tell
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.signals.recording import DEFAULT_START_NS, Recording
from mr_damper_ros.tracking.screening import (
    LARGEST_CURRENT,
    Screening,
    fault_of_samples,
    fault_of_sign,
    lack_of_motion,
)

RunSource = str | os.PathLike[str] | Recording | Iterable["RunSource"]
"""A bag's path, a recording, or any number of these."""

_WAY_OUT = "accept_doubtful, --accept-doubtful: take it all the same"

_LIMITS = Screening(minimum_amplitude=1e-6, current_tolerance=2.0 * LARGEST_CURRENT)


@dataclass(frozen=True, eq=False)
class MeasuredRun:
    """One run of a damper, checked and ready to be identified from.

    ``windows``: one for each stretch without a gap, which begins at ``starts`` [s] from the first
    sample. ``temperatures``: of each window that of its samples (n,) [°C], None where it was not
    measured. ``provenance``: what the recording says of where it comes from, in words; ``remarks``:
    what seems wrong with it.
    """

    name: str
    windows: tuple[Window, ...]
    starts: tuple[float, ...]
    temperatures: tuple[Array | None, ...]
    provenance: str = ""
    remarks: tuple[str, ...] = ()

    @property
    def longest(self) -> Window:
        """The window that stands for the run: the one with the most samples."""
        return max(self.windows, key=lambda window: window.sample_count)


def measured_run(
    source: str | os.PathLike[str] | Recording, accept_doubtful: bool = False
) -> MeasuredRun:
    """A run from a bag or a recording; ValueError with a sentence where it cannot be used.

    Where ``accept_doubtful``, what would be refused is a remark, as long as there is any motion and
    force.
    """
    if isinstance(source, Recording):
        name, recordings = source.name, [source]
    else:
        name, recordings = os.fspath(source), _recordings(Path(source))
    windows, remarks = [], []

    def doubt(fault: str, recording: Recording) -> None:
        lifeless = not (np.ptp(recording.displacement) > 0.0 and np.ptp(recording.force) > 0.0)
        if fault and (lifeless or not accept_doubtful):
            way_out = "" if lifeless else f" ({_WAY_OUT})"
            raise ValueError(f"{name}: {fault}{way_out}")
        if fault:
            remarks.append(f"{name}: {fault} (taken all the same)")

    for recording in recordings:
        fault = fault_of_samples(
            recording.displacement, recording.force, recording.current, _LIMITS
        ) or lack_of_motion(recording.displacement, _LIMITS)
        doubt(fault, recording)
        window = Window.from_samples(
            recording.displacement, recording.force, recording.current, recording.period
        )
        doubt(fault_of_sign(window.motion.velocity, window.force), recording)
        windows.append(window)
    first_ns = recordings[0].start_ns
    return MeasuredRun(
        name=name,
        windows=tuple(windows),
        starts=tuple((recording.start_ns - first_ns) / NANOSECONDS for recording in recordings),
        temperatures=tuple(recording.temperature for recording in recordings),
        provenance=recordings[0].details.get("provenance", ""),
        remarks=tuple(dict.fromkeys(remarks)),
    )


def measured_runs(
    sources: Iterable[RunSource],
    *,
    displacement: ArrayLike | None = None,
    force: ArrayLike | None = None,
    current: ArrayLike | None = None,
    period: float | None = None,
    accept_doubtful: bool = False,
    processes: ProcessPool | None = None,
) -> tuple[MeasuredRun, ...]:
    """All runs given, in their order; that of the four arrays, if they are given, is the last.

    Raises ValueError, in one sentence, where there are none or one cannot be used.
    """
    flat = _flat(sources)
    arrays = (displacement, force, current, period)
    if any(given is not None for given in arrays):
        flat.append(_from_arrays(displacement, force, current, period))
    if not flat:
        raise ValueError(
            "there are no runs: give paths of bags, recordings, or displacement, force, current "
            "and period"
        )
    tasks = [(source, accept_doubtful) for source in flat]
    found = (processes or ProcessPool()).map(_task, tasks)
    return tuple(run for run in found if run is not None)


def all_windows(runs: Sequence[MeasuredRun]) -> list[Window]:
    """The windows of all runs."""
    return [window for run in runs for window in run.windows]


def _task(task: tuple[str | Recording, bool], tell: Tell) -> MeasuredRun:
    return measured_run(*task)


def _flat(sources: Iterable[RunSource]) -> list[str | Recording]:
    flat: list[str | Recording] = []
    for source in sources:
        if isinstance(source, Recording):
            flat.append(source)
        elif isinstance(source, (str, os.PathLike)):
            flat.append(os.fspath(source))
        elif isinstance(source, Iterable) and not isinstance(source, (np.ndarray, dict)):
            flat += _flat(source)
        else:
            raise ValueError(
                f"a run cannot be of type {type(source).__name__}: give the path of a bag or a "
                "recording, or name the arrays (displacement=, force=, current=, period=)"
            )
    return flat


def _recordings(path: Path) -> list[Recording]:
    if path.suffix.lower() in RECORD_ENDINGS and path.is_file():
        raise ValueError(
            f"{path} is no bag: its columns and units must be told, to read_record in Python or "
            "to import_record, which makes a bag of it"
        )
    from mr_damper_ros.io.bag_reader import read_bag  # here: only bags need it

    return read_bag(path)


def _from_arrays(
    displacement: ArrayLike | None,
    force: ArrayLike | None,
    current: ArrayLike | None,
    period: float | None,
) -> Recording:
    given = {"displacement": displacement, "force": force, "current": current, "period": period}
    missing = [name for name, value in given.items() if value is None]
    if missing or displacement is None or current is None or force is None or period is None:
        raise ValueError(
            f"{' and '.join(missing)} missing: arrays take displacement [m], force [N], "
            "current [A] and period [s] together"
        )
    count = np.size(displacement)
    return Recording(
        name="arrays",
        start_ns=DEFAULT_START_NS,
        period=period,
        displacement=np.asarray(displacement, dtype=float),
        force=np.asarray(force, dtype=float),
        current=np.full(count, current) if np.ndim(current) == 0 else np.asarray(current, float),
    )
