"""Details of an identification: estimates with standard errors, advice, and their tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from mr_damper_ros.api.measured_runs import MeasuredRun
from mr_damper_ros.data_check.findings import Finding, Kind
from mr_damper_ros.estimation.experiment_design import MachineLimits, extra_runs
from mr_damper_ros.estimation.global_fit import GlobalFit
from mr_damper_ros.estimation.multi_start import MultiStart
from mr_damper_ros.estimation.observability import (
    current_varies,
    determination_of,
)
from mr_damper_ros.estimation.profile_likelihood import Profile
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.files import json_ready
from mr_damper_ros.report.document import Grid
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.force_scale import (
    TemperatureMap,
    force_scale,
    temperature_map,
    with_temperature,
)
from mr_damper_ros.tracking.operating_point import KnownPoints


@dataclass(frozen=True)
class Estimate:
    """A value with its standard error, both in ``unit``; an unknown standard error is NaN.

    ``observable``: whether the data determine the value; if not, it is the start value.
    ``discrepancy``: the part of the standard error caused by model error, which only a different
    motion reveals; NaN if unknown. ``only_with``: names of the parameters that the data determine
    only jointly with this one, for example as a product. Such a value has no standard error.
    """

    value: float
    standard_error: float
    unit: str
    observable: bool = True
    meaning: str = ""
    discrepancy: float = math.nan
    only_with: tuple[str, ...] = ()

    def __str__(self) -> str:
        if not self.observable or self.only_with:
            return f"{self.value:.6g} {self.unit}, {_uncertainty(self)[0]}"
        if math.isnan(self.standard_error):
            return f"{self.value:.6g} {self.unit}"
        return f"{self.value:.6g} ± {self.standard_error:.2g} {self.unit}"


Estimates = Mapping[str, Estimate]


def parameter_estimates(
    found: ParameterSet, only_with: Mapping[str, Sequence[str]] | None = None
) -> dict[str, Estimate]:
    """The estimates of a set, by name; ``only_with`` is that of its :class:`GlobalFit`."""
    estimates = {}
    columns = found.values, found.standard_errors, found.discrepancies, found.observable
    rows = zip(found.law.parameters, *(column.tolist() for column in columns), strict=True)
    for parameter, value, error, discrepancy, observable in rows:
        others = tuple((only_with or {}).get(parameter.name, ()))
        estimates[parameter.name] = Estimate(
            value, error, parameter.unit, observable, discrepancy=discrepancy, only_with=others
        )
    return estimates


def negative_slopes(runs: Mapping[str, Estimates], found: ParameterSet) -> list[Finding]:
    """Details on negative stiffnesses and viscous slopes in the coefficients of each run."""
    entries: dict[str, list[tuple[str, Estimate]]] = {}
    for run, estimates in runs.items():
        for name, entry in estimates.items():
            if "stiffness" in entry.meaning or "viscous" in entry.meaning:
                entries.setdefault(name, []).append((run, entry))
    stiffness = parameter_estimates(found).get("stiffness")
    if stiffness is not None and stiffness.observable:
        entries["stiffness"] = [("", replace(stiffness, meaning="stiffness"))]
    negative = []
    for name, each in entries.items():
        # A negative value counts from two standard errors below zero.
        below = [(where, e) for where, e in each if e.value < -2.0 * e.standard_error]
        if below:
            where, worst = min(below, key=lambda one: one[1].value)
            found_here = Kind.NEGATIVE_SLOPE.found(
                value=worst.value,
                error=worst.standard_error,
                meaning=f"{worst.meaning} {name}",
                estimate=worst,
            )
            negative.append(replace(found_here, source=where))
    return negative


def estimates_table(heading: str, estimates: Estimates) -> Grid:
    """The table of estimates; ``heading`` is the heading of its first column, the names."""
    rows = [
        (name, f"{entry.value:.6g}", *_uncertainty(entry), entry.unit, entry.meaning)
        for name, entry in estimates.items()
    ]
    return (heading, "value", "standard error", "discrepancy", "unit", ""), rows


def _uncertainty(entry: Estimate) -> tuple[str, str]:
    """Standard error and discrepancy as text."""
    if not entry.observable:
        return "not observable", ""
    if entry.only_with:
        more = ", …" if len(entry.only_with) > _MOST_PARTNERS else ""
        return f"only with {', '.join(entry.only_with[:_MOST_PARTNERS])}{more}", ""
    error, discrepancy = (
        f"{value:.3g}" if math.isfinite(value) else "unknown"
        for value in (entry.standard_error, entry.discrepancy)
    )
    return error, discrepancy


_MOST_PARTNERS = 2
"""Largest number of jointly determined parameters that a table names."""

_SAMPLES = 500
"""Approximate number of samples of a piece, and largest number of pieces per window."""


def temperature_maps(runs: Sequence[MeasuredRun], found: ParameterSet) -> list[TemperatureMap]:
    """The temperature maps of all operating points for which the runs contain enough data.

    ``found`` is the set identified from the runs. Each run is cut into pieces of a few cycles. A
    window fit of each piece gives its force scale. Pieces that cannot be fitted are ignored.
    """
    known = KnownPoints()
    for run in runs:
        for window, recording in zip(run.windows, run.recordings, strict=True):
            if recording.temperature is None:
                continue
            for piece, mean in _pieces(window, recording.temperature):
                try:
                    fit = fit_window(
                        found.law,
                        piece,
                        found.values,
                        method="least_squares",
                        held=found.held_range,
                    )
                except ValueError:
                    continue
                known = known.with_baseline(fit)
                scale = force_scale(found.law, piece, fit, known.baselines)
                known = with_temperature(known, fit.operating_point, mean, scale)
    maps = (temperature_map(each) for each in known.records)
    return [each for each in maps if each is not None]


def _pieces(window: Window, celsius: Array) -> Iterator[tuple[Window, float]]:
    """Pieces of two cycles (or 4 s of another motion than a sine) and their mean [°C]."""
    frequency = window.motion.frequency
    duration = 2.0 / frequency if np.isfinite(frequency) else 4.0
    count = int(window.sample_count * window.period / duration)
    edges = np.linspace(0, window.sample_count, min(max(count, 1), _SAMPLES) + 1).astype(int)
    for first, last in pairwise(edges):
        place = slice(int(first), int(last))
        piece = window.part(place)
        if not current_varies(piece):
            yield piece.thinned(_SAMPLES), float(np.mean(celsius[place]))


@dataclass(frozen=True, eq=False)
class Details:
    """Further results of an identification, besides the parameter set.

    ``lines`` hold one detail each, as text; ``document`` holds the same as JSON-compatible values.
    """

    lines: list[str]
    document: dict[str, Any]

    def __post_init__(self) -> None:
        object.__setattr__(self, "document", json_ready(self.document))

    def __str__(self) -> str:
        return "\n".join(self.lines)

    def __add__(self, other: Details) -> Details:
        return Details(self.lines + other.lines, self.document | other.document)


def attempted(what: str, compute: Callable[[], Details]) -> Details:
    """The details that ``compute`` returns, or a line that says that it failed.

    What is computed after a search must not lose its result.
    """
    try:
        return compute()
    except (ValueError, ArithmeticError) as error:
        return Details([f"{what} could not be computed: {error}"], {})


def _entry(of: object, *names: str) -> dict[str, Any]:
    """These attributes, by name."""
    return {name: getattr(of, name) for name in names}


def determined(fit: GlobalFit, windows: Sequence[Window], rig: MachineLimits) -> Details:
    """The determined parameters, and runs within the range of the rig that would determine more."""
    found, noise = fit.parameter_set, max(float(np.median(fit.noise)), 1e-9)
    misfit = fit.misfit(windows)
    result = determination_of(misfit, windows, found.values)
    runs = extra_runs(misfit, noise, found.values, found.observable, rig)
    lines = [
        f"the data determine {result.rank} of {len(result.names)} combinations of the parameters",
        *(f"not determined: {combination.words}" for combination in result.open),
        *(run.sentence for run in runs),
    ]
    if not (runs or np.all(found.observable)):
        lines.append(
            f"no run up to {rig.peak_velocity:.3g} m/s and {rig.current:.3g} A would determine "
            "more: give top_velocity or top_current (--top-velocity, --top-current) if the rig "
            "allows more"
        )
    entry = {
        **_entry(result, "rank", "condition", "singular_values"),
        "open": [
            {**_entry(each, "words", "standard_error"), "weights": dict(each.weights)}
            for each in result.open
        ],
    }
    advice = [asdict(run) | _entry(run, "sentence") for run in runs]
    return Details(lines, {"determination": entry, "advice": advice})


def profiles(fit: GlobalFit, found: Sequence[Profile]) -> Details:
    """The profile likelihoods of a fit."""
    values = fit.parameter_set.as_dict()
    lines, document = [], {}
    for p in found:
        interval = f"{p.interval[0]:.6g} to {p.interval[1]:.6g}"
        line = f"profile of {p.name}: minimum at {p.best:.6g}, 95 % interval {interval}"
        if not p.contains(values[p.name]):
            line += f", WHICH EXCLUDES THE IDENTIFIED VALUE, {values[p.name]:.6g}"
        lines.append(line)
        document[p.name] = _entry(p, "values", "ratio", "best", "interval")
    return Details(lines, {"profiles": document})


def searches(found: MultiStart) -> Details:
    """Costs of the searches and their candidates, and the agreement of the best searches."""
    best, spread = found.best, found.spread
    names = best.parameter_set.law.parameter_names
    lines = []
    measure = "RMS residual relative to separate fits of the runs"  # the square root of the cost
    if best.candidates:
        residuals = "; ".join(f"{math.sqrt(c.cost):.3g} ({c.origin})" for c in best.candidates)
        lines.append(f"local searches, {measure}: {residuals}")
    if len(found.fits) > 1:
        costs = [fit.cost for fit in found.fits.values()]
        lines.append(
            f"{len(costs)} searches, {measure}: {math.sqrt(min(costs)):.6g} to "
            f"{math.sqrt(max(costs)):.6g}; {len(found.as_good)} of them are as good as the best"
        )
        if len(found.as_good) > 1:
            widest = int(np.argmax(spread))
            lines.append(
                f"the parameters of these searches differ by up to {spread[widest]:.2g} standard "
                f"errors ({names[widest]})"
            )
    entries = []
    for seed, fit in found.fits.items():
        entry = {"seed": seed, **_entry(fit, "cost", "evaluations", "message")}
        entry["parameters"] = fit.parameter_set.as_dict()
        entry["candidates"] = [
            _entry(each, "origin", "cost")
            | {"parameters": dict(zip(names, each.parameters, strict=True))}
            for each in fit.candidates
        ]
        entries.append(entry)
    return Details(lines, {"searches": entries, "spread": dict(zip(names, spread, strict=True))})


def temperatures(maps: Sequence[TemperatureMap]) -> Details:
    """Change of the force with temperature, and accuracy of the temperature from the force."""
    lines, entries = [], []
    for found in maps:
        speed, current = found.operating_point
        middle = 0.5 * (found.low + found.high)
        kelvin = found.temperature(found.scale(middle)).standard_error
        lines.append(
            f"at {speed:.3g} m/s and {current:.3g} A the force changes by "
            f"{found.slope(middle):+.2%} per kelvin, from {found.low:.3g} to {found.high:.3g} °C; "
            f"the temperature can be computed from the force to within {kelvin:.2g} K"
        )
        celsius = np.linspace(found.low, found.high, 9)
        scales = [found.scale(value) for value in celsius.tolist()]
        entries.append(
            {
                **_entry(found, "windows", "coefficients", "covariance"),
                "operating_point": {"peak_velocity": speed, "current": current},
                "range": [found.low, found.high],
                "temperature": celsius,
                "force_scale": [scale.value for scale in scales],
                "force_scale_standard_error": [scale.standard_error for scale in scales],
            }
        )
    return Details(lines, {"temperature_maps": entries})
