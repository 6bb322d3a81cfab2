"""Runs of a damper from bags, recordings and arrays."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, SupportsFloat, cast

import numpy as np
from numpy.typing import ArrayLike

from mr_damper_ros.kinematics.motion import DataError
from mr_damper_ros.kinematics.window import Window, holds_cycle
from mr_damper_ros.models.quantities import SAME_CURRENT
from mr_damper_ros.processes.process_pool import Notify, ProcessPool
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.moving_average import find_average
from mr_damper_ros.signals.recording import DEFAULT_START_NS, LARGEST_CURRENT, Recording
from mr_damper_ros.tracking.screening import (
    Screening,
    fault_of_samples,
    fault_of_sign,
    lack_of_motion,
)

RunSource = str | os.PathLike[str] | Recording | Iterable["RunSource"]
"""The path of a bag, a recording, or an iterable of these."""

RunArrays = tuple[ArrayLike | None, ArrayLike | None, ArrayLike | None, float | None]
"""Displacement [m], force [N] and current [A] of a run, and the sample period [s]."""

_LARGEST_MASS = 1e6
_RECORD_ENDINGS = frozenset(
    {".txt", ".csv", ".tsv", ".dat", ".asc", ".mat", ".xlsx", ".xlsm", ".tdms", ".mf4"}
)
_LIMITS = Screening(minimum_amplitude=1e-6, current_tolerance=2.0 * LARGEST_CURRENT)


@dataclass(frozen=True, eq=False)
class MeasuredRun:
    """One run of a damper, checked and ready for identification.

    ``recordings``: one per section without gaps; ``windows``: their motion and force; ``remarks``:
    possible problems of the run.
    """

    name: str
    recordings: tuple[Recording, ...]
    windows: tuple[Window, ...]
    remarks: tuple[str, ...] = ()

    @property
    def longest(self) -> Window:
        """The window with the most samples, which represents the run."""
        return max(self.windows, key=lambda window: window.sample_count)


def run_name(source: object) -> str:
    """The name of a recording, or the path of a bag."""
    if isinstance(source, Recording):
        return source.name
    return os.fspath(source) if isinstance(source, (str, os.PathLike)) else str(source)


def measured_run(
    source: str | os.PathLike[str] | Recording,
    accept_doubtful: bool = False,
    notify: Notify | None = None,
) -> MeasuredRun:
    """A run from a bag or a recording; ``notify`` receives the progress in words.

    Raises ValueError if the run cannot be used. With ``accept_doubtful``, a problem becomes a
    remark instead, unless the displacement or the force is constant.
    """
    recordings: tuple[Recording, ...]
    name = run_name(source)
    if isinstance(source, Recording):
        recordings = (source,)
    elif isinstance(source, (str, os.PathLike)):
        recordings = tuple(_recordings(Path(source), notify))
    else:
        raise ValueError(
            f"a run cannot be of type {type(source).__name__}: give the path of a bag or a "
            "recording, or name the arrays (displacement=, force=, current=, period=)"
        )
    windows, remarks = [], []

    def reject(fault: str, recording: Recording) -> None:
        if not fault:
            return
        if np.ptp(recording.displacement) == 0.0 or np.ptp(recording.force) == 0.0:
            raise ValueError(f"{name}: {fault}")
        if not accept_doubtful:
            remedy = "to use it anyway, give accept_doubtful=True or --accept-doubtful"
            raise ValueError(f"{name}: {fault} ({remedy})")
        remarks.append(f"{name}: {fault} (used anyway)")

    for recording in recordings:
        fault = (
            fault_of_samples(recording.displacement, recording.force, recording.current, _LIMITS)
            or lack_of_motion(recording.displacement, _LIMITS)
            or recording.implausible()
        )
        reject(fault, recording)
        try:
            window = Window.from_samples(
                recording.displacement, recording.force, recording.current, recording.period
            )
        except DataError as error:
            raise DataError(f"{name}: {error}") from error
        reject(fault_of_sign(window.motion.velocity, window.force), recording)
        windows.append(window.resolved())
    if not any(holds_cycle(recording.displacement) for recording in recordings):
        remarks.append(f"{name}: it holds less than a cycle of the motion; record some cycles")
    return MeasuredRun(name, recordings, tuple(windows), tuple(dict.fromkeys(remarks)))


def measured_runs(
    sources: Iterable[RunSource],
    arrays: RunArrays = (None, None, None, None),
    *,
    accept_doubtful: bool = False,
    processes: ProcessPool | None = None,
    tell: Callable[[str], object] | None = None,
) -> tuple[MeasuredRun, ...]:
    """All runs in the given order, followed by the run of the ``arrays``, if given.

    ``tell`` receives the progress in words. Raises ValueError if there is no run, or one cannot be
    used.
    """
    flat = flat_runs(sources)
    if any(given is not None for given in arrays):
        flat.append(_from_arrays(arrays))
    if not flat:
        raise ValueError(
            "there are no runs: give paths of bags, recordings, or displacement, force, current "
            "and period"
        )
    tasks = [(source, accept_doubtful) for source in flat]

    def listen(number: int, words: str) -> bool:
        if tell is not None:
            tell(f"run {number + 1} of {len(flat)}, {words}" if len(flat) > 1 else words)
        return True

    found = (processes or ProcessPool()).map(_task, tasks, listen)
    return tuple(run for run in found if run is not None)


def without_inertia(runs: Sequence[MeasuredRun], mass: float) -> tuple[MeasuredRun, ...]:
    """The runs without the inertia of ``mass`` [kg] between load cell and damper.

    The load cell measures the force of the damper plus mass * acceleration. The mass (rod, clevis
    and half of the load cell) belongs to the rig, not to the law. Raises ValueError if the mass is
    invalid.
    """
    if not (isinstance(mass, SupportsFloat) and 0.0 <= mass <= _LARGEST_MASS):
        raise ValueError(
            f"the mass is {mass!r}: give a number of kilograms up to {_LARGEST_MASS:g}, or 0"
        )
    if mass == 0.0:
        return tuple(runs)

    def less(window: Window) -> Window:
        return replace(window, force=window.force - mass * window.motion.acceleration)

    return tuple(replace(run, windows=tuple(map(less, run.windows))) for run in runs)


def all_windows(runs: Sequence[MeasuredRun]) -> list[Window]:
    """The windows of all runs."""
    return [window for run in runs for window in run.windows]


def _task(task: tuple[str | Recording, bool], notify: Notify) -> MeasuredRun:
    return measured_run(*task, notify)


def flat_runs(sources: Iterable[RunSource]) -> list[Any]:
    """All paths and recordings in nested iterables; other objects are kept, to be rejected."""
    flat: list[Any] = []
    for source in sources:
        whole = isinstance(source, (str, bytes, Mapping)) or hasattr(source, "__array__")
        if isinstance(source, Iterable) and not whole:
            flat += flat_runs(source)
        else:
            flat.append(source)
    return flat


def _recordings(path: Path, notify: Notify | None) -> list[Recording]:
    if path.suffix.lower() in _RECORD_ENDINGS and path.is_file():
        raise ValueError(
            f"{path} is not a bag: describe its columns and units to read_record in Python, or "
            "convert it with mr-damper import"
        )
    from mr_damper_ros.io.bag_reader import read_bag  # imported here, because only bags need it

    told = -1

    def progress(fraction: float) -> None:
        nonlocal told
        percent = int(100.0 * fraction)
        if notify is not None and percent != told:
            told = percent
            notify(f"reading {path.name}: {percent} %")

    return read_bag(path, progress=progress)


def _from_arrays(arrays: RunArrays) -> Recording:
    names = ("displacement", "force", "current", "period")
    missing = [name for name, given in zip(names, arrays, strict=True) if given is None]
    if missing:
        raise ValueError(
            f"{' and '.join(missing)} missing: give displacement [m], force [N], current [A] "
            "and period [s] together"
        )
    displacement, force, current, period = cast(tuple[Any, Any, Any, Any], arrays)
    try:
        period = float(period)
    except (TypeError, ValueError):
        raise ValueError(f"period is {period!r}: give the sample period as a number [s]") from None
    if np.ndim(current) == 0:
        current = np.full(np.size(displacement), current)
    return Recording("arrays", DEFAULT_START_NS, period, displacement, force, current)


_CONTRADICTING = 1.5
"""Ratio of loop heights from which runs contradict each other.

Heating to 70 °C causes a ratio of 1.35.
"""

_MOST = 3
"""Largest number of runs, or pairs of runs, that a remark names."""


def remarks_on(runs: Sequence[MeasuredRun]) -> tuple[str, ...]:
    """The remarks of the runs, and remarks on inconsistent currents and on smoothed forces."""
    return (
        *(remark for run in runs for remark in run.remarks),
        *_current_remarks(runs),
        *_smoothing_remarks(runs),
    )


def _smoothing_remarks(runs: Sequence[MeasuredRun]) -> list[str]:
    """A remark on runs whose force was smoothed by a moving average."""
    counts = {run.name: find_average(run.longest.force) for run in runs}
    named = [f"{name} ({count} samples)" for name, count in counts.items() if count > 1]
    if not named:
        return []
    more = f" and {len(named) - _MOST} more runs" if len(named) > _MOST else ""
    return [
        f"the force of {', '.join(named[:_MOST])}{more} was smoothed by a moving average, which "
        "distorts fast motions: undo it with mr-damper import --undo-moving-average N; the record "
        "must begin at rest"
    ]


def _current_remarks(runs: Sequence[MeasuredRun]) -> list[str]:
    """Remarks on currents that are inconsistent with the heights of the loops.

    The force increases with the current. At equal current and speed, only the temperature changes
    it.
    """
    remarks, middles = [], []
    for run in runs:
        table = _fast_cycles(run.windows)
        if len(table):
            remarks += _within(run, table)
            middles.append((run.name, *np.median(table, axis=0).tolist()))
    pairs = [text for one, two in combinations(middles, 2) for text in _between(*one, *two)]
    if len(pairs) > _MOST:
        pairs = [*pairs[:_MOST], f"{len(pairs) - _MOST} more pairs of runs contradict each other"]
    return remarks + pairs


def _fast_cycles(windows: Sequence[Window]) -> Array:
    """Peak velocity [m/s], current [A] and loop height [N] of the fastest cycles, shape (n, 3).

    These reach 85 % of the largest peak velocity.
    """
    found = []
    for window in windows:
        velocity = window.motion.velocity
        # A stroke begins where the velocity exceeds a tenth of its peak in a new direction.
        moving = np.flatnonzero(np.abs(velocity) > 0.1 * float(np.max(np.abs(velocity))))
        turns = moving[1:][np.diff(np.sign(velocity[moving])) != 0.0]
        strokes = [int(moving[0]), *turns.tolist(), int(moving[-1]) + 1]
        for first, last in zip(strokes, strokes[2:], strict=False):
            cycle = slice(first, last)
            current = window.current[cycle]
            if float(np.ptp(current)) <= SAME_CURRENT:
                speed = float(np.max(np.abs(velocity[cycle])))
                height = 0.5 * float(np.ptp(window.force[cycle]))
                found.append((speed, float(np.mean(current)), height))
    table = np.array(found).reshape(-1, 3)
    return table[table[:, 0] >= 0.85 * table[:, 0].max(initial=0.0)]


def _within(run: MeasuredRun, table: Array) -> list[str]:
    """A remark on different loop heights at one current.

    It compares the second smallest and the second largest height, so that a single disturbance
    causes no remark.
    """
    _, currents, every = table.T
    for current in np.unique(np.round(currents / SAME_CURRENT)) * SAME_CURRENT:
        heights = np.sort(every[np.abs(currents - current) <= SAME_CURRENT])
        if heights.size >= 4 and heights[-2] > _CONTRADICTING * heights[1]:
            return [
                f"{run.name}: at {current:.3g} A and the same speed the force reaches "
                f"{heights[1]:.3g} N in some cycles and {heights[-2]:.3g} N in others: does the "
                "record hold several currents? (mr-damper import --split cuts it into its runs)"
            ]
    return []


def _between(
    one: str, v1: float, i1: float, f1: float, two: str, v2: float, i2: float, f2: float
) -> list[str]:
    """A remark on two runs of equal speed with contradicting currents [A] and forces [N]."""
    ratio = f1 / f2 if i1 < i2 else f2 / f1
    if abs(i1 - i2) <= SAME_CURRENT:
        ratio = max(f1, f2) / min(f1, f2)
    same_speed = abs(v1 - v2) <= 0.2 * max(v1, v2)
    if not same_speed or ratio <= _CONTRADICTING:
        return []
    return [
        f"{one} and {two}: the force reaches {f1:.3g} N at {i1:.3g} A and {f2:.3g} N at {i2:.3g} "
        "A, at the same speed: is a current wrong?"
    ]
