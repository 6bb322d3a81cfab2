"""One parameter set for all runs given."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from numpy.typing import ArrayLike

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings, Report
from mr_damper_ros.estimation.multi_start import (
    MultiStart,
    SearchRecord,
    SearchRecordError,
    identify_from_seeds,
)
from mr_damper_ros.estimation.profiled_fit import profiled, record_levels
from mr_damper_ros.estimation.record_levels import LevelPrior
from mr_damper_ros.interface import findings
from mr_damper_ros.interface.comparison import compare, error_over
from mr_damper_ros.interface.estimates import Estimate
from mr_damper_ros.interface.findings import Findings
from mr_damper_ros.interface.fit_result import FittedRun, Identification
from mr_damper_ros.interface.measured_runs import (
    MeasuredRun,
    RunSource,
    all_windows,
    measured_runs,
)
from mr_damper_ros.interface.run_doubts import remarks_on
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL, ParameterSet, known_model
from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.processes.process_pool import ProcessPool
from mr_damper_ros.processes.whole_files import write_text
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.state_directory import read_parameter_file

_EVOLUTION = EvolutionSettings()


@one_thread()
def identify(
    *runs: RunSource,
    displacement: ArrayLike | None = None,
    force: ArrayLike | None = None,
    current: ArrayLike | None = None,
    period: float | None = None,
    model: str = DEFAULT_MODEL,
    method: str = "global",
    start: ParameterSet | str | os.PathLike[str] | None = None,
    seed: int = 0,
    strategy: str = _EVOLUTION.strategy,
    generations: int = _EVOLUTION.generations,
    starts: int = 1,
    workers: int = 1,
    accept_doubtful: bool = False,
    resume: str | os.PathLike[str] | None = None,
    profile: Sequence[str] = (),
    level_per_record: float = 0.0,
    report: Report | None = None,
) -> Identification:
    """Fit one parameter set to all runs given.

    Parameters
    ----------
    *runs
        Paths of bags, recordings (:func:`read_bag`, :func:`read_record`), or lists of these.
    displacement, force, current, period
        A run as arrays of shape (n,): displacement [m], extension positive; force [N], tension
        positive; current [A], a number where it is constant; and the time between samples [s].
    model
        Name of the force law, a key of ``MODELS``.
    method
        "global": the laws of the coefficients by differential evolution, then least squares on the
        samples; "nelder_mead" or "least_squares": local search on the samples;
        "differential_evolution": over all free parameters at once.
    start
        Parameter set, or its file, whose values undetermined parameters keep; without it the
        model's own initial values, which are the literature's set for the sigmoid law.
    seed, strategy, generations
        Of differential evolution; ``generations`` at most.
    starts
        Search from so many seeds; the best is the result.
    workers
        Processes; the result does not depend on it. A script that asks for more than one needs the
        usual ``if __name__ == "__main__":``.
    accept_doubtful
        Take runs that would be refused as clipped, driven by the force, or in wrong units; what
        seems wrong is then a remark.
    resume
        File that keeps what each search has found, to go on from.
    profile
        Names of parameters whose profile likelihood is wanted. Where one has its minimum far from
        the value found, the search starts again from there.
    level_per_record
        Spread, such as 0.1, of a force scale that each run has for itself, drawn to 1, besides a
        force zero: temperature, filling and the load cell's zero then do not bend the law. 0: none.
    report
        Called with the progress; where it returns False, the best so far is the result.

    Returns
    -------
    Identification
        ``success`` is False where the search was stopped, or where the set leaves more than 30 %
        of the force's standard deviation; ``remarks`` say what seems wrong with the runs.

    Raises
    ------
    ValueError
        In one sentence that says what to change, where a run or an option cannot be used.
    OSError
        Where a file cannot be read or written.

    Examples
    --------
    >>> import numpy as np
    >>> import mr_damper_ros as mr
    >>> time = np.arange(2000) * 1e-3
    >>> displacement, velocity = 5e-3 * np.sin(20 * time), 0.1 * np.cos(20 * time)
    >>> force = 900 * np.tanh(velocity / 0.02) + 1500 * velocity
    >>> result = mr.identify(displacement=displacement, force=force, current=1.0, period=1e-3)
    >>> result.success
    True
    >>> result.coefficients["alpha"].unit
    's/m'
    """
    start_values = start_values_of(start, model)
    settings = EvolutionSettings(strategy=strategy, generations=generations, seed=seed)
    with ProcessPool(workers) as processes:
        measured = measured_runs(
            runs,
            displacement=displacement,
            force=force,
            current=current,
            period=period,
            accept_doubtful=accept_doubtful,
            processes=processes,
        )
        return identify_measured(
            measured,
            model=model,
            method=method,
            start_values=start_values,
            settings=settings,
            starts=starts,
            processes=processes,
            resume=None if resume is None else Path(resume),
            profile=profile,
            level_per_record=level_per_record,
            report=report,
        )


def identify_measured(
    measured: Sequence[MeasuredRun],
    *,
    model: str,
    method: str,
    start_values: Array,
    settings: EvolutionSettings,
    starts: int = 1,
    processes: ProcessPool,
    resume: Path | None = None,
    profile: Sequence[str] = (),
    level_per_record: float = 0.0,
    report: Report | None = None,
) -> Identification:
    """:func:`identify` for runs that are read already, from values (p,) to start with."""
    windows = all_windows(measured)
    law = MODELS[model]
    levels = _levels_of(measured, level_per_record) if level_per_record else None
    record = SearchRecord(law, windows, start_values, settings, method, levels)
    if resume is not None and resume.exists():
        _take(record, resume)
    began = time.monotonic()
    searches = identify_from_seeds(
        law,
        windows,
        start_values,
        settings,
        starts,
        report,
        method=method,
        levels=levels,
        processes=processes,
        record=record,
        keep=None if resume is None else partial(_keep, resume),
    )
    profiles = Findings([], {})
    if profile and not searches.best.stopped:
        fit, found = profiled(searches.best, windows, profile, settings, processes, report)
        searches, profiles = searches.replaced(fit), findings.profiles(fit, found)
    duration = time.monotonic() - began
    fitted = _fitted(searches, measured)
    nrmse = error_over(run.comparison for run in fitted).nrmse
    return Identification(
        parameter_set=replace(searches.best.parameter_set, nrmse=nrmse),
        runs=fitted,
        searches=searches,
        method=method,
        duration=duration,
        remarks=remarks_on(measured),
        profiles=profiles,
    )


def start_values_of(source: ParameterSet | str | os.PathLike[str] | None, model: str) -> Array:
    """Values (p,) that a search of the model starts from; the model's own where there is None."""
    law = known_model(model)
    if source is None:
        return law.initial_values()[0]
    found = source if isinstance(source, ParameterSet) else read_parameter_file(Path(source))
    return found.start_of(model)


def _levels_of(measured: Sequence[MeasuredRun], spread: float) -> LevelPrior:
    records = [place for place, run in enumerate(measured) for _ in run.windows]
    return LevelPrior(tuple(records), spread)


def _take(record: SearchRecord, path: Path) -> None:
    try:
        record.take(json.loads(path.read_text(encoding="utf-8")))
    except ValueError as error:
        detail = (
            error if isinstance(error, SearchRecordError) else "it is not the record of a search"
        )
        raise ValueError(f"cannot resume from {path}: {detail}") from error


def _keep(path: Path, record: SearchRecord) -> None:
    write_text(path, json.dumps(record.document()) + "\n")


def _fitted(searches: MultiStart, runs: Sequence[MeasuredRun]) -> tuple[FittedRun, ...]:
    fit = searches.best
    quantities = fit.parameter_set.law.coefficient_quantities
    levels = dict(enumerate(record_levels(fit, all_windows(runs))))
    fitted = []
    for place, run in enumerate(runs):
        point = run.longest.operating_point
        coefficients = {
            name: Estimate(
                value,
                error if error > 0.0 else math.nan,
                unit,
                meaning=meaning,
                discrepancy=discrepancy,
            )
            for (name, unit, meaning), value, error, discrepancy in zip(
                quantities, *(each.tolist() for each in fit.coefficients(point)), strict=True
            )
        }
        comparison = compare(fit.parameter_set, run)
        fitted.append(FittedRun(run, comparison, point, coefficients, levels.get(place)))
    return tuple(fitted)
