"""Identify many dampers from many recordings; each result is stored once."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any

from mr_damper_ros.api.findings import parameter_estimates
from mr_damper_ros.api.identification import Identification, identify_measured, start_values_of
from mr_damper_ros.api.measured_runs import measured_run
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.io.recording_list import (
    RECORD_ENDINGS,
    LeftOut,
    ListedRecording,
    RecordFormat,
    find_recordings,
    read_list,
    without_repeats,
)
from mr_damper_ros.lots.population import KnownDamper, Population
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL, ParameterSet
from mr_damper_ros.processes.files import FolderLock, json_ready, write_text
from mr_damper_ros.processes.process_pool import (
    ProcessPool,
    Workforce,
    dask_cluster,
    file_stem,
    fingerprint,
    finish,
    store_document,
    stored_document,
)
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tracking.state_directory import SetSource


def identify_group(
    group: tuple[str, Sequence[ListedRecording]],
    *,
    record_format: RecordFormat | None,
    accept_doubtful: bool,
    **search: Any,
) -> dict[str, Any]:
    """The result for a damper, as JSON-compatible values; never raises.

    ``group``: name of the damper and all its recordings; ``record_format`` describes record files,
    None if there are only bags; ``search``: arguments of :func:`identify_measured`.

    In the result, ``failure``: a sentence why the damper was not identified, or empty;
    ``left_out``: unusable recordings with the reasons; ``passing``: whether the error may be
    temporary, caused by the machine and not by the files.
    """
    began = time.perf_counter()
    damper, recordings = group
    document: dict[str, Any] = {"damper": damper, "left_out": [], "passing": False}
    runs = []

    def reason_of(error: Exception) -> str:
        # Other errors than these, of the file itself, may be temporary.
        lasting = isinstance(error, (FileNotFoundError, PermissionError, ValueError))
        document["passing"] |= not lasting
        if isinstance(error, OSError):
            return error.strerror or str(error)
        return str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"

    for listed in recordings:
        try:
            source: Path | Recording = listed.path
            record = listed.path.suffix.lower() in RECORD_ENDINGS and listed.path.is_file()
            if record and record_format is not None:
                source = record_format.read(listed.path, listed.current)
            runs.append(measured_run(source, accept_doubtful))
        # An error in one file must not affect the others.
        except Exception as error:
            document["left_out"].append({"path": str(listed.path), "reason": reason_of(error)})
    document["failure"] = "" if runs else "none of its recordings could be used"
    document["recordings"] = [run.name for run in runs]
    if runs:
        try:
            found = identify_measured(runs, processes=ProcessPool(1), **search)
            document |= _result(damper, found)
        except Exception as error:
            document["failure"] = reason_of(error)
    return document | {"duration_s": time.perf_counter() - began}


def _result(damper: str, result: Identification) -> dict[str, Any]:
    name = "".join(sign for sign in damper if sign.isprintable())[:200]
    return {
        "set": replace(result.parameter_set, set_id=name).to_yaml(),
        "covariance": result.covariance.tolist(),
        "nrmse": result.nrmse,
        "rmse": result.rmse,
        "samples": result.error.count,
        "success": result.success,
        "message": result.message,
        "remarks": list(result.remarks),
    }


_LOST = {
    "failure": "the process that identified it died repeatedly: is there enough memory?",
    "recordings": [],
    "left_out": [],
    "passing": True,
    "duration_s": 0.0,
}
"""The document of a damper whose process was lost, without its name."""

Progress = Callable[[int, int, Mapping[str, Any]], None]
"""Receives the number of finished dampers, the total number, and the last damper's document."""


@dataclass(frozen=True, eq=False)
class ManyDampers:
    """Outcome of :func:`identify_many`.

    ``documents``: results of :func:`identify_group`, sorted by the names of the dampers.
    ``unnamed``: files that are assigned to no damper. ``kept``: number of dampers whose earlier
    results were reused.
    """

    documents: tuple[dict[str, Any], ...]
    unnamed: tuple[LeftOut, ...]
    kept: int

    @cached_property
    def population(self) -> Population:
        """The identified dampers as a production lot."""
        found = (document for document in self.documents if not document["failure"])
        return Population([KnownDamper.from_document(document) for document in found])

    @property
    def failures(self) -> dict[str, str]:
        """Reasons by the names of the dampers that were not identified."""
        return {d["damper"]: d["failure"] for d in self.documents if d["failure"]}

    @property
    def left_out(self) -> tuple[LeftOut, ...]:
        """Unused files and the reasons."""
        return self.unnamed + tuple(
            LeftOut(Path(entry["path"]), entry["reason"])
            for document in self.documents
            for entry in document["left_out"]
        )

    @property
    def duration(self) -> float:
        """Sum of the computing times of all dampers [s]."""
        return float(sum(document["duration_s"] for document in self.documents))

    @property
    def table(self) -> list[dict[str, Any]]:
        """One row per damper; unknown values are None.

        Parameters that the recordings do not determine have no standard error.
        """
        rows = [_row(document) for document in self.documents]
        names = list(dict.fromkeys(name for row in rows for name in row))
        return [{name: row.get(name) for name in names} for row in rows]


def identify_many(
    *sources: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    listed: str | os.PathLike[str] | None = None,
    pattern: str | None = None,
    columns: str | None = None,
    current: float | None = None,
    period: float | None = None,
    variable: str | None = None,
    model: str = DEFAULT_MODEL,
    method: str = "global",
    start: SetSource | None = None,
    seed: int = 0,
    generations: int = EvolutionSettings.generations,
    accept_doubtful: bool = False,
    workers: int = 1,
    executor: Executor | None = None,
    scheduler: str | None = None,
    report: Progress | None = None,
) -> ManyDampers:
    """Identify every damper from all its recordings.

    The result of each damper is written to its own file below ``folder`` as soon as it is complete.
    A repeated call processes only dampers that are missing or whose files have changed.

    Parameters
    ----------
    *sources
        Folders to search, paths of bags, patterns such as ``"lot*/**/*.mcap"``.
    folder
        Folder of the results: ``dampers/`` holds the complete results, ``sets/`` the parameter
        sets.
    listed
        CSV file with the columns path, damper and optionally current [A].
    pattern
        Regular expression for paths: its group damper, or its first group, is the name of the
        damper; a group current is the current [A]. Without it, all recordings in one folder belong
        to one damper.
    columns
        Columns of record files and their units, as in :func:`read_record`; without them only bags
        are used.
    current
        Current [A] of record files, if neither a column nor the name holds it.
    period
        Time between samples [s] of record files, if no column holds it.
    variable
        Matrix, sheet or group to read, if record files have several.
    model, method, start, seed, generations
        As in :func:`identify`.
    accept_doubtful
        Accept runs that would be rejected, as in :func:`identify`.
    workers
        Number of processes on this machine.
    executor
        Executor of ``concurrent.futures`` to use instead of these processes; its workers must see
        the same paths.
    scheduler
        Address of the scheduler of a running Dask cluster, such as tcp://host:8786. Its workers
        need this package and must see the same paths.
    report
        Called after each damper.

    Returns
    -------
    ManyDampers
        Unusable files do not stop the identification: ``left_out`` and ``failures`` name the
        unusable files and dampers.

    Raises
    ------
    ValueError
        If an option is invalid, there is no recording, or the folder holds results for other
        options.
    OSError
        If the folder cannot be written, or no worker can run.
    """
    record_format = None if columns is None else RecordFormat(columns, current, period, variable)
    settings = EvolutionSettings(generations=generations, seed=seed)
    start_values = start_values_of(start, model)
    identification = partial(
        identify_group,
        record_format=record_format,
        accept_doubtful=accept_doubtful,
        model=model,
        method=method,
        start_values=start_values,
        settings=settings,
    )
    recordings, unnamed = find_recordings(
        sources, pattern=pattern, with_records=record_format is not None
    )
    if listed is not None:
        more, nameless = read_list(listed)
        recordings = without_repeats([*recordings, *more])
        unnamed += nameless
    if not recordings:
        raise ValueError(
            "there are no recordings of a known damper: give folders, a list, or another pattern"
        )
    place = Path(folder)
    lock = FolderLock(place / ".lock")
    try:
        _check_options(
            place,
            {
                "model": model,
                "method": method,
                "start": start_values,
                **asdict(settings),
                "accept_doubtful": accept_doubtful,
                "record_format": None if record_format is None else asdict(record_format),
            },
        )
        documents: dict[str, dict[str, Any]] = {}
        files: dict[str, Path] = {}
        prints, remaining = {}, []
        damper = attrgetter("damper")
        for name, found in groupby(sorted(recordings, key=damper), key=damper):
            own = tuple(found)
            states = [(str(r.path.absolute()), r.current, _state(r.path)) for r in own]
            prints[name] = fingerprint({"damper": name, "recordings": states})
            files[name] = place / "dampers" / f"{file_stem(name)}.json"
            stored = stored_document(files[name], prints[name])
            if stored is None:
                remaining.append((name, own))
            else:
                documents[name] = stored
                _save_set(place, stored)
        kept = len(documents)
        workforce: int | Workforce = workers if executor is None else Workforce(executor)
        if remaining and scheduler is not None:
            workforce = dask_cluster(scheduler)
        for (name, _), result in finish(identification, remaining, workforce):
            documents[name] = document = result or {"damper": name, **_LOST}
            # A repetition would give the same result, unless the error may be temporary.
            if not document["passing"]:
                store_document(files[name], prints[name], document)
            _save_set(place, document)
            if report is not None:
                report(len(documents), len(prints), document)
    finally:
        lock.release()
    return ManyDampers(tuple(documents[name] for name in prints), tuple(unnamed), kept)


def _state(path: Path) -> list[tuple[str, int, int]] | None:
    """Name, size and modification time of a file, or of the files in the folder of a bag."""
    try:
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        return [(f.name, f.stat().st_size, f.stat().st_mtime_ns) for f in files]
    except OSError:
        return None


def _check_options(folder: Path, wanted: dict[str, Any]) -> None:
    """Check that the results in a folder have the same options. Raises ValueError and OSError."""
    path, wanted = folder / "options.json", json_ready(wanted)
    if not path.exists():
        write_text(path, json.dumps(wanted, indent=2) + "\n")
        return
    try:
        before = json.loads(path.read_text(encoding="utf-8"))
        differs = [name for name in wanted if before.get(name) != wanted[name]]
    except (ValueError, AttributeError) as error:
        raise ValueError(f"{path} is damaged: choose another folder") from error
    if differs:
        raise ValueError(
            f"{folder} holds results with a different {' and '.join(differs)}: choose another "
            "folder, or use the same options as before"
        )


def _save_set(folder: Path, document: Mapping[str, Any]) -> None:
    path = folder / "sets" / f"{file_stem(document['damper'])}.yaml"
    if document["failure"]:
        path.unlink(missing_ok=True)
    elif not path.exists() or path.read_text(encoding="utf-8") != document["set"]:
        write_text(path, document["set"])


def _row(document: Mapping[str, Any]) -> dict[str, Any]:
    failure = document["failure"]
    row: dict[str, Any] = {
        "damper": document["damper"],
        "identified": not failure,
        "message": failure or document["message"],
        "recordings": len(document["recordings"]),
        "left_out": len(document["left_out"]),
        "duration_s": document["duration_s"],
    }
    if failure:
        return row
    found = ParameterSet.from_yaml(document["set"])
    speeds, currents = found.peak_velocity_range, found.current_range
    row |= {
        "model": found.model,
        "success": document["success"],
        "samples": document["samples"],
        "rmse_N": document["rmse"],
        "nrmse": document["nrmse"],
        "lowest_peak_velocity_m_s": speeds[0],
        "highest_peak_velocity_m_s": speeds[1],
        "lowest_current_A": currents[0],
        "highest_current_A": currents[1],
        "largest_force_N": found.largest_force,
    }
    for name, entry in parameter_estimates(found).items():
        row[name] = entry.value
        error = entry.standard_error
        row[f"{name}_standard_error"] = error if math.isfinite(error) else None
    return row
