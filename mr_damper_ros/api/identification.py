"""Identification of one parameter set from all runs, and choice of the force law."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mr_damper_ros.api import details
from mr_damper_ros.api.causes import Explained, causes
from mr_damper_ros.api.comparison import (
    RUN_COLUMNS,
    ComparedRun,
    ComparedRuns,
    compare,
    error_entry,
)
from mr_damper_ros.api.details import Details, Estimate, Estimates
from mr_damper_ros.api.measured_runs import (
    MeasuredRun,
    RunSource,
    all_windows,
    findings_on,
    measured_runs,
    without_inertia,
)
from mr_damper_ros.data_check.findings import Finding, Kind, labelled
from mr_damper_ros.estimation.covariance import least_squares_covariance, noise_level
from mr_damper_ros.estimation.differential_evolution import (
    EvolutionSettings,
    GlobalProgress,
    Report,
)
from mr_damper_ros.estimation.experiment_design import MachineLimits
from mr_damper_ros.estimation.global_fit import GlobalFit
from mr_damper_ros.estimation.law_choice import LawChoice, cross_validate
from mr_damper_ros.estimation.multi_start import (
    MultiStart,
    SearchRecord,
    SearchRecordError,
    identify_from_seeds,
)
from mr_damper_ros.estimation.observability import operating_points_within
from mr_damper_ros.estimation.profile_likelihood import check_profiled, profiled, profiles_of
from mr_damper_ros.estimation.record_levels import Level, LevelPrior
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.misfit import ChosenParameters, Misfit
from mr_damper_ros.models.parameter_set import (
    DEFAULT_MODEL,
    ParameterSet,
    known_model,
    motion_window,
)
from mr_damper_ros.models.quantities import NOTICED, LoopReading
from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.processes.files import json_ready, write_text
from mr_damper_ros.processes.process_pool import ProcessPool
from mr_damper_ros.report.document import Cell, Grid
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.error_sums import pooled
from mr_damper_ros.tracking.state_directory import SetSource, given_set

AUTO = "auto"
"""Value of ``model`` for which the law is chosen by cross-validation."""


@dataclass(frozen=True, eq=False)
class FittedRun(ComparedRun):
    """The fit of the identified set to one run.

    ``operating_point``: representative peak velocity [m/s] and current [A] of the run;
    ``coefficients``: the coefficients of the law at this point, by name; ``level``: gain and offset
    of the run, None without ``level_per_record``; ``error``: error of the set without this level.
    """

    measured: MeasuredRun
    operating_point: tuple[float, float]
    coefficients: dict[str, Estimate]
    level: Level | None = None

    @property
    def level_row(self) -> tuple[Cell, ...]:
        """NRMSE with gain and offset; then gain and offset with their standard errors."""
        level = self.level
        if level is None:
            return "", "", ""
        scale = f"{level.scale:.4f} ± {level.scale_error:.4f}"
        return f"{level.nrmse:.2%}", scale, f"{level.zero:.1f} ± {level.zero_error:.1f}"

    def document(self) -> dict[str, Any]:
        """The fit as JSON-compatible values."""
        speed, current = self.operating_point
        return super().document() | {
            "operating_point": {"peak_velocity": speed, "current": current},
            "coefficients": _each(self.coefficients, "value"),
            "coefficient_standard_errors": _each(self.coefficients, "standard_error"),
            "coefficient_discrepancies": _each(self.coefficients, "discrepancy"),
            **({} if self.level is None else {"level": self.level._asdict()}),
        }


def _each(estimates: Estimates, name: str) -> dict[str, Any]:
    """An attribute of every estimate, by name."""
    found: dict[str, Any] = json_ready({k: getattr(e, name) for k, e in estimates.items()})
    return found


@dataclass(frozen=True, eq=False)
class Identification(ComparedRuns):
    """Result of :func:`identify`.

    ``parameter_set`` is the identified set; ``runs`` are its fits to the runs, in the given order;
    ``searches`` holds all searches, and ``duration`` [s] is their computing time; ``findings`` say
    what is wrong with the runs or the fit, and ``accepted`` whether this was accepted beforehand.
    ``choice``: the choice of the law, for the model "auto";
    ``profiles``: the requested profile likelihoods; ``mass``: the mass [kg] whose inertia was
    subtracted from the force.
    """

    parameter_set: ParameterSet
    runs: tuple[FittedRun, ...]
    searches: MultiStart
    method: str
    duration: float
    findings: tuple[Finding, ...] = ()
    accepted: bool = False
    choice: LawChoice | None = None
    profiles: Details = field(default_factory=lambda: Details([], {}))
    mass: Estimate | None = None

    @property
    def parameters(self) -> dict[str, Estimate]:
        """Value, standard error, unit and observability of each parameter, by name."""
        return details.parameter_estimates(self.parameter_set, self.searches.best.only_with)

    @property
    def _windows(self) -> list[Window]:
        return all_windows([run.measured for run in self.runs])

    @property
    def coefficients(self) -> dict[str, Estimate]:
        """The operating-point coefficients of the first run, by name.

        ``runs[k].coefficients`` holds the coefficients of the other runs.
        """
        return self.runs[0].coefficients

    @property
    def covariance(self) -> Array:
        """Covariance (p, p) of the parameters; zero for fixed parameters."""
        return self.searches.best.covariance

    @property
    def evaluations(self) -> int:
        """Evaluations of the force law, or of cheaper approximations, in the best search."""
        return self.searches.best.evaluations

    @property
    def success(self) -> bool:
        """Whether the search was completed, and no finding warns or all were accepted."""
        return self.searches.best.success and not self.warnings

    @property
    def message(self) -> str:
        """Outcome of the search and the findings that warn, in words."""
        return "; BUT ".join([self.searches.best.message, *map(str, self.warnings)])

    def force_error(self, time: ArrayLike, displacement: ArrayLike, current: ArrayLike) -> Array:
        """Standard error (n,) [N] of the force in a motion that was not measured.

        The arguments are as in :meth:`ParameterSet.force`. The error includes the model error.
        """
        return self.searches.best.force_error(motion_window(time, displacement, current))

    @one_thread()
    def determination(
        self, *, top_velocity: float | None = None, top_current: float | None = None
    ) -> Details:
        """The parameters that the runs determine, and further runs to determine the others.

        Parameters
        ----------
        top_velocity
            Largest peak velocity [m/s] of a recommended run. Default: the largest in these runs.
        top_current
            Largest current [A] of a recommended run. Default: the largest in these runs.
        """
        windows = self._windows
        speeds, currents = operating_points_within(windows)
        rig = MachineLimits(
            amplitude=max(window.motion.amplitude for window in windows),
            peak_velocity=max(speeds) if top_velocity is None else top_velocity,
            force=math.inf,
            current=max(map(abs, currents)) if top_current is None else top_current,
            duration=1.0,
        )
        return details.attempted(
            "the determined parameters",
            lambda: details.determined(self.searches.best, windows, rig),
        )

    @one_thread()
    def profile(self, *names: str, workers: int = 1, report: Report | None = None) -> Details:
        """Profile likelihood of the named parameters, with 95 % intervals.

        If an interval does not contain the identified value, the search has missed a lower minimum;
        ``identify(..., profile=names)`` continues from there. Raises ValueError if the model has
        no parameter of a given name.
        """
        windows, fit = self._windows, self.searches.best
        check_profiled(names, fit.parameter_set.law.parameter_names)
        with ProcessPool(workers) as processes:
            return details.attempted(
                "the profiles",
                lambda: details.profiles(fit, profiles_of(fit, windows, names, processes, report)),
            )

    @one_thread()
    def temperature_maps(self) -> Details:
        """Change of the force with temperature, from runs with measured temperature."""
        measured = [run.measured for run in self.runs]
        if all(part.temperature is None for run in measured for part in run.recordings):
            return Details([], {})
        found = self.parameter_set
        return details.attempted(
            "the change with temperature",
            lambda: details.temperatures(details.temperature_maps(measured, found)),
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the parameter set as YAML, for ``ParameterSet.load``, ``validate`` and the nodes.

        Raises OSError if the file cannot be written.
        """
        self.parameter_set.save(path)

    def document(self) -> dict[str, Any]:
        """The result as JSON-compatible values."""
        return {
            "model": self.parameter_set.model,
            "parameters": self.parameter_set.as_dict(),
            "standard_errors": _each(self.parameters, "standard_error"),
            "discrepancies": _each(self.parameters, "discrepancy"),
            "observable": _each(self.parameters, "observable"),
            "metrics": error_entry(self.error),
            "evaluations": self.evaluations,
            "duration_s": self.duration,
            "method": self.method,
            "success": self.success,
            "message": self.message,
            **({} if self.mass is None else {"mass": json_ready(vars(self.mass))}),
            "findings": [finding.document() for finding in self.findings],
            "bags": [run.document() for run in self.runs],
        }

    def _blocks(self) -> list[str | Grid]:
        blocks: list[str | Grid] = [] if self.choice is None else [f"{self.choice}\n"]
        if len(self.runs) == 1 and self.coefficients:
            speed, current = self.runs[0].operating_point
            blocks += [
                f"coefficients at a peak velocity of {speed:.4g} m/s and {current:.4g} A:",
                details.estimates_table("coefficient", self.coefficients),
                "",
            ]
        columns, rows = RUN_COLUMNS, [run.row for run in self.runs]
        if any(run.level for run in self.runs):
            columns += ("NRMSE with level", "force gain", "force offset [N]")
            rows = [run.row + run.level_row for run in self.runs]
        blocks += [details.estimates_table("parameter", self.parameters), "", (columns, rows)]
        if self.mass is not None:
            blocks.append(f"inertia subtracted: {self.mass} between load cell and damper")
        blocks.append(
            f"{self.method}: {self.evaluations} evaluations in {self.duration:.2f} s, "
            f"{self.searches.best.message}"
        )
        return [*blocks, *map(labelled, self.findings)]


@one_thread()
def identify(
    *runs: RunSource,
    displacement: ArrayLike | None = None,
    force: ArrayLike | None = None,
    current: ArrayLike | None = None,
    period: float | None = None,
    model: str = DEFAULT_MODEL,
    method: str = "global",
    start: SetSource | None = None,
    seed: int = 0,
    strategy: str = EvolutionSettings.strategy,
    generations: int = EvolutionSettings.generations,
    starts: int = 1,
    workers: int = 1,
    accept_doubtful: bool = False,
    as_measured: bool = False,
    resume: str | os.PathLike[str] | None = None,
    profile: Sequence[str] = (),
    level_per_record: float = 0.0,
    mass: float = 0.0,
    fit_mass: bool = False,
    report: Report | None = None,
) -> Identification:
    """Fit one parameter set to all given runs.

    Parameters
    ----------
    *runs
        Paths of bags, recordings (:func:`read_bag`, :func:`read_record`), or lists of these.
    displacement, force, current, period
        A run as arrays of shape (n,): displacement [m], extension positive; force [N], tension
        positive; current [A], or one number if it is constant; and the sample period [s].
    model
        Force law. "auto" compares all laws by cross-validation (:func:`choose_law`).

        The laws are the keys of ``MODELS``.
    method
        global: differential evolution on the coefficients of the operating points, then least
        squares on the samples; nelder_mead, least_squares: local search on the samples;
        differential_evolution: search over all free parameters at once.
    start
        Parameter set with start values, or its file. Undetermined parameters keep these values.
        Default: the initial values of the model; for the sigmoid law, the set of the literature.
    seed
        Seed of the random numbers.
    strategy
        Strategy of differential evolution.
    generations
        Largest number of generations of differential evolution.
    starts
        Number of searches with different seeds; the result is the best of them.
    workers
        Number of processes; the result does not depend on it.

        A script with more than one process needs the usual ``if __name__ == "__main__":``.
    accept_doubtful
        Accept data and results that would be refused or warned of: a clipped force, a wrong unit, a
        reversed sign, too large an error. The findings then describe the problem.
    as_measured
        Use the data as they were measured: no filter for a disturbance, no bridged spikes or held
        values, no fragments left out.
    resume
        File with the progress of the searches. A repeated call continues from it.
    profile
        Parameters for which to compute the profile likelihood. If the minimum of a profile lies far
        from the identified value, the search starts again from the minimum.

        With the model "auto", parameters that the chosen law does not have are left out.
    level_per_record
        Expected standard deviation of the gains about 1, such as 0.1. Each run then has a gain and
        an offset, so that temperature, filling and load-cell zero do not distort the law.

        0: no gains and offsets.
    mass
        Moving mass [kg] between load cell and damper, whose inertia the measured force includes.
    fit_mass
        Identify this mass as well. A single sine does not suffice for that.
    report
        Called with the progress. If it returns False, the search stops with the best result so
        far.

    Returns
    -------
    Identification
        ``success`` is False if the search was stopped, or if one of the ``findings`` warns, for
        example because the NRMSE of a run is above 30 %, unless doubtful data are accepted.

    Raises
    ------
    ValueError
        If a run or an option cannot be used; the message says what to change.
    OSError
        If a file cannot be read or written.

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
    start_values = None if model == AUTO else start_values_of(start, model)
    settings = EvolutionSettings(strategy=strategy, generations=generations, seed=seed)
    choice = None
    profile = (profile,) if isinstance(profile, str) else profile
    laws = MODELS.values() if model == AUTO else [MODELS[model]]
    check_profiled(profile, list(dict.fromkeys(n for law in laws for n in law.parameter_names)))
    with ProcessPool(workers) as processes:
        measured = measured_runs(
            runs,
            (displacement, force, current, period),
            accept_doubtful=accept_doubtful,
            as_measured=as_measured,
            fragments=as_measured,
            processes=processes,
            tell=None if report is None else partial(_tell, report),
        )
        measured = without_inertia(measured, 0.0 if fit_mass else mass)
        if start_values is None:
            runs_of_windows = [run.windows for run in measured]
            seeded = EvolutionSettings(seed=seed)
            choice = cross_validate(
                runs_of_windows, settings=seeded, report=report, processes=processes
            )
            if choice.chosen is None:
                raise ValueError(_stopped_choice(choice))
            model = choice.chosen.model
            start_values = start_values_of(start, model)
        search = partial(
            identify_measured,
            model=model,
            method=method,
            start_values=start_values,
            settings=settings,
            processes=processes,
            starts=starts,
            profile=[name for name in profile if name in MODELS[model].parameter_names],
            level_per_record=level_per_record,
            report=report,
        )
        found = search(measured, resume=None if resume is None else Path(resume))
        if fit_mass and not found.searches.best.stopped:
            found = _with_mass(found, measured, search)
    known = Estimate(mass, math.nan, "kg") if mass and not fit_mass else found.mass
    return replace(found, choice=choice, mass=known, accepted=accept_doubtful)


def identify_measured(
    measured: Sequence[MeasuredRun],
    *,
    model: str,
    method: str,
    start_values: Array,
    settings: EvolutionSettings,
    processes: ProcessPool,
    starts: int = 1,
    resume: Path | None = None,
    profile: Sequence[str] = (),
    level_per_record: float = 0.0,
    report: Report | None = None,
) -> Identification:
    """:func:`identify` for runs that are already loaded; ``start_values`` has shape (p,)."""
    windows = all_windows(measured)
    levels = None
    if level_per_record:
        records = tuple(place for place, run in enumerate(measured) for _ in run.windows)
        levels = LevelPrior(records, level_per_record)
    record = SearchRecord(MODELS[model], windows, start_values, settings, method, levels)
    keep = None
    if resume is not None:
        keep = partial(_store, resume)
        if resume.exists():
            _resume(record, resume)
    began = time.monotonic()
    searches = identify_from_seeds(record, starts, report, processes=processes, keep=keep)
    profiles = Details([], {})

    def profile_result() -> Details:
        nonlocal searches
        fit, found = profiled(searches.best, windows, profile, settings, processes, report)
        searches = searches.replaced(fit)
        return details.profiles(fit, found)

    if profile and not searches.best.stopped:
        profiles = details.attempted("the profiles", profile_result)
    duration = time.monotonic() - began
    best, fitted = searches.best.parameter_set, _fitted(searches, measured)
    slopes = details.negative_slopes({run.name: run.coefficients for run in fitted}, best)
    shown = [
        Explained(run.comparison, run.measured, (run.level or run.error).nrmse) for run in fitted
    ]
    of_fit = causes(best, shown, levelled=bool(level_per_record))
    found = (*findings_on(measured), *slopes, *of_fit)
    return Identification(
        parameter_set=replace(best, nrmse=pooled(run.error for run in fitted).nrmse),
        runs=fitted,
        searches=searches,
        method=method,
        duration=duration,
        findings=found,
        profiles=profiles,
    )


def _tell(report: Report, words: str) -> None:
    report(GlobalProgress(words, 0, 0, math.nan, math.nan))


def _stopped_choice(choice: LawChoice) -> str:
    """The message that no law is chosen, with the errors of the compared laws."""
    errors = ", ".join(f"{trial.model} {trial.nrmse:.2%}" for trial in choice.trials)
    return (
        f"no law is chosen, because the comparison was stopped before {', '.join(choice.untried)} "
        f"(NRMSE on {choice.left_out} left out so far: {errors}): name the law, or let the "
        "comparison finish"
    )


def _with_mass(
    found: Identification,
    measured: Sequence[MeasuredRun],
    search: Callable[[Sequence[MeasuredRun]], Identification],
) -> Identification:
    """The identification with a fitted mass, repeated without its inertia, three times at most."""
    windows, began = all_windows(measured), time.monotonic()
    mass = _fitted_mass(found.searches.best, windows)
    if not mass.observable:
        unknown = replace(mass, value=0.0, standard_error=math.nan)
        findings = (*found.findings, Kind.UNDETERMINED_MASS.found())
        return replace(found, findings=findings, mass=unknown)
    before = found.duration
    for _ in range(3):
        found = search(without_inertia(measured, mass.value))
        last, mass = mass, _fitted_mass(found.searches.best, windows, mass.value)
        if abs(mass.value - last.value) <= mass.standard_error:
            break
    return replace(found, mass=mass, duration=before + time.monotonic() - began)


_MASS_PRIOR = 3.0
"""Prior standard deviation of the parameters about their fit, relative to their size. Without it,
``modified_bouc_wen`` finds 0.82 instead of 0.92 of the true mass (``random_current_mass``)."""

_MASS_RESOLUTION = 100
"""Samples per cycle to which a motion is resolved for the mass. With half as many, the numerical
error of the law looks like a mass that is up to half too small (``random_current_mass``)."""


def _fitted_mass(fit: GlobalFit, windows: Sequence[Window], mass: float = 0.0) -> Estimate:
    """The mass [kg], by least squares together with the observable parameters of the law.

    The forces of ``windows`` include the inertia. The search starts from ``mass`` [kg] and the fit.
    The law is evaluated as its set is used, with the peak velocity held within the identified
    range, or the mass would make up for a law that is extrapolated (0.82 instead of 0.95 of the
    true mass, ``random_current_mass``). A wide prior about the fit keeps parameters that the motion
    does not determine, or springs of opposite stiffness would make up for the mass by their
    numerical errors.
    """
    from scipy.optimize import least_squares  # imported late: see entry_points

    found = fit.parameter_set
    most = 8000 // len(windows)  # more samples would not help the fit
    few = [found.held(w.resolved(_MASS_RESOLUTION)).thinned(most) for w in windows]
    misfit = Misfit(found.law, few, fit.noise.tolist(), found.values)
    law = ChosenParameters(misfit, found.values, np.flatnonzero(found.observable).tolist())
    inertia = misfit.sample_weights * np.concatenate([w.motion.acceleration for w in few])
    sizes = np.maximum(np.abs(found.values), found.law.typical_sizes(windows))
    noise = noise_level(misfit.residual(found.values) + mass * inertia)
    prior = np.append(noise / (_MASS_PRIOR * law.unknowns(sizes)), 0.0)

    def residual(unknowns: Array) -> Array:
        left = law.residual(unknowns[:-1]) + unknowns[-1] * inertia
        return np.append(left, (prior * (unknowns - start))[:-1])

    def jacobian(unknowns: Array) -> Array:
        by = np.column_stack((law.jacobian(unknowns[:-1]), inertia))
        return np.vstack((by, np.diag(prior)[:-1]))

    low, high = (
        np.append(law.unknowns(bound), end)
        for bound, end in zip(found.law.bounds, (0.0, np.inf), strict=True)
    )
    start = np.clip(np.append(law.start, mass), low, high)
    best = least_squares(residual, start, jacobian, (low, high), x_scale="jac", max_nfev=40).x
    variances = np.full(len(law.places), noise**2)
    covariance = least_squares_covariance(jacobian(best), residual(best), variances)
    variance = float(covariance[-1, -1])
    # Rounding can make the variance of a mass that the motion does not determine negative.
    error = math.sqrt(variance) if variance >= 0.0 else math.nan
    force = misfit.sample_weights * np.concatenate([window.force for window in few])
    return Estimate(
        float(best[-1]),
        error,
        "kg",
        bool(error * np.linalg.norm(inertia) < NOTICED * np.linalg.norm(force)),
        meaning="mass between load cell and damper",
    )


def start_values_of(source: SetSource | None, model: str) -> Array:
    """Start values (p,) for a search with the model; for None, the initial values of the model."""
    law = known_model(model)
    if source is None:
        return law.initial_values()[0]
    values = given_set(source).start_of(model)
    largest = int(np.argmax(np.abs(values)))
    if abs(values[largest]) > 1e150:
        name = law.parameter_names[largest]
        raise ValueError(f"the start of {name} is {values[largest]:g}: the force would overflow")
    return values


def _resume(record: SearchRecord, path: Path) -> None:
    try:
        record.take(json.loads(path.read_text(encoding="utf-8")))
    except ValueError as error:
        detail = (
            error if isinstance(error, SearchRecordError) else "it holds no progress of a search"
        )
        raise ValueError(f"cannot resume from {path}: {detail}") from error


def _store(path: Path, record: SearchRecord) -> None:
    write_text(path, json.dumps(record.document()) + "\n")


def _fitted(searches: MultiStart, runs: Sequence[MeasuredRun]) -> tuple[FittedRun, ...]:
    fit = searches.best
    levels = dict(enumerate(fit.record_levels(all_windows(runs))))
    fitted = []
    for place, run in enumerate(runs):
        point, frequency = run.longest.operating_point, LoopReading.of(run.longest).frequency
        columns = (column.tolist() for column in fit.coefficients(point, frequency))
        coefficients = {}
        quantities = fit.parameter_set.law.at_one_current
        for quantity, value, error, discrepancy in zip(quantities, *columns, strict=True):
            coefficients[quantity.name] = Estimate(
                value,
                error if error > 0.0 else math.nan,
                quantity.unit,
                meaning=quantity.meaning,
                discrepancy=discrepancy,
            )
        comparison = compare(fit.parameter_set, run)
        fitted.append(FittedRun(comparison, run, point, coefficients, levels.get(place)))
    return tuple(fitted)


@one_thread()
def choose_law(
    *runs: RunSource,
    displacement: ArrayLike | None = None,
    force: ArrayLike | None = None,
    current: ArrayLike | None = None,
    period: float | None = None,
    models: Sequence[str] = tuple(MODELS),
    seed: int = 0,
    workers: int = 1,
    accept_doubtful: bool = False,
    report: Report | None = None,
) -> LawChoice:
    """Cross-validate force laws on unseen motions and choose the simplest good law.

    Parameters
    ----------
    *runs, displacement, force, current, period, workers, accept_doubtful, report
        As in :func:`identify`. If ``report`` returns False, only the completed laws are compared,
        and none is chosen.
    models
        Names of the laws, keys of ``MODELS``.
    seed
        Seed of the random numbers of the identifications.

    Returns
    -------
    LawChoice
        ``chosen`` is the chosen law, None if the comparison was stopped; ``trials`` are the errors
        of the compared laws, ``untried`` the names of the others, and the text of the result is
        their table.

    Raises
    ------
    ValueError
        If a run cannot be used, a law is unknown, or there is too little data for
        cross-validation; the message says what to change.

    Examples
    --------
    >>> import numpy as np
    >>> import mr_damper_ros as mr
    >>> time = np.arange(2000) * 1e-3
    >>> displacement, velocity = 5e-3 * np.sin(20 * time), 0.1 * np.cos(20 * time)
    >>> force = 900 * np.tanh(velocity / 0.02) + 1500 * velocity
    >>> choice = mr.choose_law(displacement=displacement, force=force, current=1.0, period=1e-3,
    ...                        models=("bingham", "hyperbolic_tangent"))
    >>> choice.chosen.model
    'hyperbolic_tangent'
    """
    with ProcessPool(workers) as processes:
        measured = measured_runs(
            runs,
            (displacement, force, current, period),
            accept_doubtful=accept_doubtful,
            fragments=False,
            processes=processes,
            tell=None if report is None else partial(_tell, report),
        )
        return cross_validate(
            [run.windows for run in measured],
            (models,) if isinstance(models, str) else tuple(models),
            EvolutionSettings(seed=seed),
            report,
            processes,
        )
