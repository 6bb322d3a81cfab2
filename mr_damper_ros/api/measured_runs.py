"""Runs of a damper from bags, recordings and arrays."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any, SupportsFloat, cast

import numpy as np
from numpy.typing import ArrayLike

from mr_damper_ros.data_check.currents import current_findings
from mr_damper_ros.data_check.findings import Finding, Kind
from mr_damper_ros.data_check.lag import motion_frequency
from mr_damper_ros.data_check.recordings import usable_run
from mr_damper_ros.kinematics.motion import DataError
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.processes.process_pool import Notify, ProcessPool
from mr_damper_ros.signals.arrays import Mask
from mr_damper_ros.signals.recording import DEFAULT_START_NS, Recording

RunSource = str | os.PathLike[str] | Recording | Iterable["RunSource"]
"""The path of a bag, a recording, or an iterable of these."""

RunArrays = tuple[ArrayLike | None, ArrayLike | None, ArrayLike | None, float | None]
"""Displacement [m], force [N] and current [A] of a run, and the sample period [s]."""

_LARGEST_MASS = 1e6
_RECORD_ENDINGS = frozenset(
    {".txt", ".csv", ".tsv", ".dat", ".asc", ".mat", ".xlsx", ".xlsm", ".tdms", ".mf4"}
)


@dataclass(frozen=True, eq=False)
class MeasuredRun:
    """One run of a damper, checked and ready for identification.

    ``recordings``: one per section, as they are used; ``windows``: their motion and force, without
    samples in gaps and clipped forces; ``findings``: what the check of the data found.
    """

    name: str
    recordings: tuple[Recording, ...]
    windows: tuple[Window, ...]
    findings: tuple[Finding, ...] = ()

    @property
    def whole(self) -> bool:
        """Whether the windows leave out no sample of the recordings."""
        used = sum(window.sample_count for window in self.windows)
        return used == sum(recording.sample_count for recording in self.recordings)

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
    source: str | os.PathLike[str] | Recording, *, accept_doubtful: bool = False
) -> MeasuredRun:
    """A run from a bag or a recording; raises ValueError if it cannot be used."""
    run = _checked(source, accept_doubtful)
    return run if run.windows else _with_windows(run)


def _checked(
    source: str | os.PathLike[str] | Recording,
    accept_doubtful: bool = False,
    as_measured: bool = False,
    notify: Notify | None = None,
) -> MeasuredRun:
    """A run from a bag or a recording; ``notify`` receives the progress in words.

    It has no windows if it is too short for them. Raises DataError if a finding refuses the run;
    with ``accept_doubtful``, only if the displacement or the force is constant. ``as_measured``:
    mend and leave out nothing. Raises ValueError for another source.
    """
    name = run_name(source)
    if isinstance(source, Recording):
        recordings: Sequence[Recording] = (source,)
    elif isinstance(source, (str, os.PathLike)):
        recordings = _recordings(Path(source), notify)
    else:
        raise ValueError(
            f"a run cannot be of type {type(source).__name__}: give the path of a bag or a "
            "recording, or name the arrays (displacement=, force=, current=, period=)"
        )
    checked = usable_run(name, recordings, accept_doubtful=accept_doubtful, mend=not as_measured)
    run = MeasuredRun(name, checked.sections, (), checked.findings)
    try:
        return _with_windows(run, checked.clipped)
    except DataError:
        if _is_short(checked.findings):
            return run
        raise


def _with_windows(run: MeasuredRun, clipped: Sequence[Mask | None] = ()) -> MeasuredRun:
    """The run with its windows; raises DataError for one that cannot be fitted."""
    windows = []
    for section, mask in zip_longest(run.recordings, clipped):
        samples = section.displacement, section.force, section.current, section.period
        try:
            window = Window.from_samples(*samples).resolved()
        except DataError as error:
            raise DataError(f"{run.name}: {error}") from error
        used = np.ones(section.sample_count, dtype=bool) if mask is None else ~mask
        for gap in section.gaps:
            used[gap] = False
        windows.append(window if used.all() else window.part(used))
    return replace(run, windows=tuple(windows))


def _is_short(findings: Iterable[Finding]) -> bool:
    return any(each.kind is Kind.SHORT for each in findings)


def _without_fragments(runs: Sequence[MeasuredRun]) -> list[MeasuredRun]:
    """The runs without those that are shorter than a cycle of the longest.

    A fit of such a fragment would have the weight of a whole run.
    """
    whole = [run for run in runs if not _is_short(run.findings)]
    if not whole:
        return list(runs)
    main = max(whole, key=lambda run: run.longest.sample_count)
    longest = max(main.recordings, key=lambda recording: recording.sample_count)
    cycle = 1.0 / max(motion_frequency(longest.displacement, longest.period), 1e-9)

    def duration(run: MeasuredRun) -> float:
        return sum(recording.duration for recording in run.recordings)

    left_out = [run for run in runs if _is_short(run.findings) and duration(run) < cycle]
    total = sum(map(duration, runs))
    found = tuple(
        replace(Kind.FRAGMENT.found(value=part, what="the run", share=part), source=run.name)
        for run in left_out
        for part in (duration(run) / total,)
    )
    kept = (run for run in runs if run not in left_out)
    return [replace(r, findings=(*r.findings, *found)) if r is main else r for r in kept]


def measured_runs(
    sources: Iterable[RunSource],
    arrays: RunArrays = (None, None, None, None),
    *,
    accept_doubtful: bool = False,
    as_measured: bool = False,
    fragments: bool = True,
    processes: ProcessPool | None = None,
    tell: Callable[[str], object] | None = None,
) -> tuple[MeasuredRun, ...]:
    """All runs in the given order, followed by the run of the ``arrays``, if given.

    ``tell`` receives the progress in words. Without ``fragments``, runs that are shorter than a
    cycle of the longest are left out. Raises ValueError if there is no run, or one cannot be
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
    tasks = [(source, accept_doubtful, as_measured) for source in flat]

    def listen(number: int, words: str) -> bool:
        if tell is not None:
            tell(f"run {number + 1} of {len(flat)}, {words}" if len(flat) > 1 else words)
        return True

    found = (processes or ProcessPool()).map(_task, tasks, listen)
    loaded = [run for run in found if run is not None]
    used = loaded if fragments else _without_fragments(loaded)
    return tuple(run if run.windows else _with_windows(run) for run in used)


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


def _task(task: tuple[str | Recording, bool, bool], notify: Notify) -> MeasuredRun:
    return _checked(*task, notify)


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


def findings_on(runs: Sequence[MeasuredRun]) -> tuple[Finding, ...]:
    """The findings on each run, and on currents that contradict the forces."""
    of_currents = current_findings({run.name: run.windows for run in runs})
    return (*(finding for run in runs for finding in run.findings), *of_currents)
