"""The recordings of one damper become one parameter set: a task for any process on any machine."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.interface.fit_result import Identification
from mr_damper_ros.interface.identification import identify_measured
from mr_damper_ros.interface.measured_runs import MeasuredRun, measured_run
from mr_damper_ros.io.recording_list import RECORD_ENDINGS, ListedRecording, RecordFormat
from mr_damper_ros.processes.process_pool import ProcessPool
from mr_damper_ros.signals.arrays import Array

_LASTING = (FileNotFoundError, PermissionError, ValueError)
"""What is wrong with the file itself; other trouble may have passed the next time."""


@dataclass(frozen=True, eq=False)
class GroupOptions:
    """What is the same for all dampers; the names are those of :func:`mr_damper_ros.identify`.

    ``start_values`` (p,) are those that a search starts from; ``record_format`` tells how record
    files are read, None where there are only bags.
    """

    model: str
    method: str
    start_values: Array
    evolution: EvolutionSettings
    accept_doubtful: bool = False
    record_format: RecordFormat | None = None


@dataclass(frozen=True, eq=False)
class DamperGroup:
    """All recordings of one damper."""

    damper: str
    recordings: tuple[ListedRecording, ...]
    options: GroupOptions


def identify_group(group: DamperGroup) -> dict[str, Any]:
    """What is known of a damper, as JSON can hold it; nothing is raised.

    ``failure``: why it could not be identified, in a sentence, empty where it was; ``left_out``:
    recordings that could not be used, with the reasons; ``passing``: whether what went wrong may
    have to do with the machine and not with the files.
    """
    began = time.perf_counter()
    runs, left_out, passing = [], [], False
    for listed in group.recordings:
        try:
            runs.append(_read(listed, group.options))
        # Whatever is wrong with one file, the others are not to suffer from it.
        except Exception as error:
            left_out.append({"path": str(listed.path), "reason": _in_words(error)})
            passing = passing or not isinstance(error, _LASTING)
    document: dict[str, Any] = {
        "damper": group.damper,
        "failure": "" if runs else "none of its recordings could be used",
        "recordings": [run.name for run in runs],
        "left_out": left_out,
    }
    if runs:
        try:
            document |= _result(group, _identified(runs, group.options))
        except Exception as error:
            document["failure"] = _in_words(error)
            passing = passing or not isinstance(error, _LASTING)
    return document | {"passing": passing, "duration_s": time.perf_counter() - began}


def is_final(document: dict[str, Any]) -> bool:
    """Whether doing the group again would give the same."""
    return not document["passing"]


def _read(listed: ListedRecording, options: GroupOptions) -> MeasuredRun:
    record = listed.path.suffix.lower() in RECORD_ENDINGS and listed.path.is_file()
    if not record or options.record_format is None:
        return measured_run(listed.path, options.accept_doubtful)
    recording = options.record_format.read(listed.path, listed.current)
    return measured_run(recording, options.accept_doubtful)


def _identified(runs: list[MeasuredRun], options: GroupOptions) -> Identification:
    return identify_measured(
        runs,
        model=options.model,
        method=options.method,
        start_values=options.start_values,
        settings=options.evolution,
        processes=ProcessPool(1),
    )


def _result(group: DamperGroup, result: Identification) -> dict[str, Any]:
    name = "".join(sign for sign in group.damper if sign.isprintable())[:200]
    found = replace(result.parameter_set, set_id=name)
    return {
        "set": found.to_yaml(),
        "covariance": result.covariance.tolist(),
        "nrmse": result.nrmse,
        "rmse": result.rmse,
        "samples": result.error.count,
        "success": result.success,
        "message": result.message,
        "remarks": list(result.remarks),
    }


def _in_words(error: Exception) -> str:
    if isinstance(error, OSError):
        return error.strerror or str(error)
    if isinstance(error, ValueError):
        return str(error)
    return f"{type(error).__name__}: {error}"
