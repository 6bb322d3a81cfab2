"""Many recordings, each identified by itself."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import Any

from mr_damper_ros.api.identification import identify
from mr_damper_ros.api.measured_runs import RunSource, flat_runs, run_name
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.files import reason_of
from mr_damper_ros.processes.process_pool import computed
from mr_damper_ros.processes.worker import Failed
from mr_damper_ros.report.status_line import StatusLine


@dataclass(frozen=True, eq=False)
class IdentifiedRecording:
    """One result of :func:`identify_many`; ``name`` lists the paths or names of its runs.

    ``error`` says in one sentence why there is no set. Without an error it is empty, and
    ``document`` holds everything about the ``parameter_set`` (:meth:`Identification.document`).
    """

    name: str
    error: str = ""
    parameter_set: ParameterSet | None = None
    document: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """The row of a table, as JSON-compatible values; unknown numbers are None."""
        found = self.document
        row = {"recording": self.name, "error": self.error, "success": found.get("success", False)}
        if self.error:
            return row
        sentences = "; ".join(finding["sentence"] for finding in found["findings"])
        row |= {"findings": sentences} | found["metrics"] | found["parameters"]
        row |= {f"{name}_standard_error": e for name, e in found["standard_errors"].items()}
        return row | {name: found[name] for name in ("model", "message", "duration_s")}


def identify_many(
    recordings: Iterable[RunSource],
    executor: Executor | None = None,
    *,
    workers: int | None = None,
    report: Callable[[IdentifiedRecording, int, int], object] | None = None,
    **options: Any,
) -> list[IdentifiedRecording]:
    """Identify each recording by itself; returns the results in the order of the recordings.

    ``recordings``: for each result a path, a recording, or a list of all runs of a damper;
    ``options``: as in :func:`identify`; ``executor``: any of ``concurrent.futures``. Without one,
    ``workers`` processes (default: one per processor) also repeat the work of one that dies.
    ``report`` receives each result and the numbers of results and recordings (default: a line on
    the terminal). Only an option that cannot apply raises an exception, ValueError or TypeError.
    """
    if isinstance(recordings, (str, os.PathLike)) or {"displacement", "resume"} & options.keys():
        raise ValueError("a single path, arrays, or resume are for identify: give a list of runs")
    inspect.signature(identify).bind(**options)
    tasks = [(flat_runs([recording]), options) for recording in recordings]
    rows = [IdentifiedRecording(", ".join(map(run_name, runs))) for runs, _ in tasks]
    with closing(computed(_identified, tasks, executor, workers)) as outcomes, StatusLine() as line:
        show = report or (lambda _, count, total: line.show(f"{count} of {total} recordings"))
        for count, outcome in enumerate(outcomes, start=1):
            given = {"error": outcome.reason} if isinstance(outcome, Failed) else outcome.result
            rows[outcome.task] = row = replace(rows[outcome.task], **given)
            show(row, count, len(rows))
    return rows


def _identified(task: tuple[list[Any], dict[str, Any]], *_: object) -> dict[str, Any]:
    try:
        found = identify(*task[0], **task[1])
    except Exception as error:  # not passed on, because its pickle might not be readable
        return {"error": reason_of(error)}
    return {"parameter_set": found.parameter_set, "document": found.document()}
