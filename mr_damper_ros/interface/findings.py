"""What else is known of an identified set: for the terminal as lines, for JSON as a document."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mr_damper_ros.estimation.experiment_design import ExtraRun, RigRange, extra_runs
from mr_damper_ros.estimation.global_fit import GlobalFit
from mr_damper_ros.estimation.multi_start import MultiStart
from mr_damper_ros.estimation.observability import (
    Determination,
    determination,
    noise_level,
    parameter_ranges,
    parameter_spans,
)
from mr_damper_ros.estimation.profile_likelihood import Profile
from mr_damper_ros.estimation.profiled_fit import search_misfit
from mr_damper_ros.interface.estimates import as_json
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.tracking.fluid_temperature import TemperatureMap

_MEASURE = "in residuals of the runs fitted one by one"
"""What a search leaves: the root of its cost."""

_POINTS = 9
"""Temperatures at which a map is written out."""


@dataclass(frozen=True, eq=False)
class Findings:
    """What there is to say of a set besides the set.

    ``lines`` are for a reader, one finding each; ``document`` holds the same for JSON.
    """

    lines: list[str]
    document: dict[str, Any]

    def __str__(self) -> str:
        return "\n".join(self.lines)

    def __add__(self, other: Findings) -> Findings:
        return Findings(self.lines + other.lines, self.document | other.document)


def determined(fit: GlobalFit, windows: Sequence[Window], rig: RigRange) -> Findings:
    """What the windows determine, and the runs within the range of the rig that would do more."""
    found = fit.parameter_set
    misfit = search_misfit(fit, windows)
    jacobian = misfit.jacobian(found.values) / noise_level(misfit, found.values)
    spans = parameter_spans(found.law, jacobian, found.values, parameter_ranges(found.law, windows))
    result = determination(found.law, jacobian, spans, found.values)
    noise = float(np.median(fit.noise))
    runs = extra_runs(found.law, misfit, noise, found.values, found.observable, rig)
    lines = [
        f"the data determine {result.rank} of {len(result.names)} combinations of the parameters",
        *(f"not determined: {combination.words}" for combination in result.open),
        *_advice(found.observable, runs, rig),
    ]
    entry = _determination_entry(result)
    advice = [
        {
            "amplitude": run.amplitude,
            "frequency": run.frequency,
            "current": run.current,
            "determines": list(run.determines),
            "worst_error": run.worst_error,
            "sentence": run.sentence,
        }
        for run in runs
    ]
    return Findings(lines, {"determination": entry, "advice": advice})


def _advice(observable: np.ndarray, runs: Sequence[ExtraRun], rig: RigRange) -> list[str]:
    if np.all(observable):
        return []
    if runs:
        return [run.sentence for run in runs]
    return [
        f"no run up to {rig.peak_velocity:.3g} m/s and {rig.current:.3g} A would determine more: "
        "give --top-velocity or --top-current if the rig may do more"
    ]


def _determination_entry(result: Determination) -> dict[str, Any]:
    return {
        "rank": result.rank,
        "condition": as_json(result.condition),
        "singular_values": result.singular_values.tolist(),
        "open": [
            {
                "words": combination.words,
                "weights": dict(combination.weights),
                "standard_error": as_json(combination.standard_error),
            }
            for combination in result.open
        ],
    }


def profiles(fit: GlobalFit, found: Sequence[Profile]) -> Findings:
    """What the profiles of a fit say."""
    values = fit.parameter_set.as_dict()
    lines = [
        f"profile of {p.name}: least at {p.best:.6g}, 95 % interval "
        f"{p.interval[0]:.6g} to {p.interval[1]:.6g}"
        + ("" if p.contains(values[p.name]) else f", WITHOUT THE VALUE FOUND, {values[p.name]:.6g}")
        for p in found
    ]
    document = {
        p.name: {
            "values": p.values.tolist(),
            "ratio": p.ratio.tolist(),
            "best": p.best,
            "interval": [as_json(end) for end in p.interval],
        }
        for p in found
    }
    return Findings(lines, {"profiles": document})


def searches(found: MultiStart) -> Findings:
    """Costs of the searches and of their candidates, and how far they agree."""
    best = found.best
    names = best.parameter_set.law.parameter_names
    lines = []
    if best.candidates:
        costs = "; ".join(f"{math.sqrt(c.cost):.3g} ({c.origin})" for c in best.candidates)
        lines.append(f"local searches left, {_MEASURE}: {costs}")
    if len(found.fits) > 1:
        spread, places = found.spread, [fit.cost for fit in found.fits.values()]
        lines.append(
            f"{len(found.fits)} searches left {math.sqrt(min(places)):.6g} to "
            f"{math.sqrt(max(places)):.6g}, {_MEASURE}; {len(found.as_good)} of them are as good "
            "as the best"
        )
        if len(found.as_good) > 1:
            widest = int(np.argmax(spread))
            lines.append(
                f"these differ by up to {spread[widest]:.2g} standard errors ({names[widest]})"
            )
    entries = [
        {
            "seed": seed,
            "cost": fit.cost,
            "parameters": fit.parameter_set.as_dict(),
            "evaluations": fit.evaluations,
            "message": fit.message,
            "candidates": [
                {
                    "origin": c.origin,
                    "cost": c.cost,
                    "parameters": dict(zip(names, c.parameters.tolist(), strict=True)),
                }
                for c in fit.candidates
            ],
        }
        for seed, fit in found.fits.items()
    ]
    of_each = {name: as_json(x) for name, x in zip(names, found.spread.tolist(), strict=True)}
    return Findings(lines, {"searches": entries, "spread": of_each})


def temperatures(maps: Sequence[TemperatureMap]) -> Findings:
    """How the force falls with temperature, and how well it tells the temperature."""
    lines, entries = [], []
    for found in maps:
        speed, current = found.operating_point
        middle = 0.5 * (found.low + found.high)
        kelvin = found.temperature(found.scale(middle)).standard_error
        lines.append(
            f"at {speed:.3g} m/s and {current:.3g} A the force changes by "
            f"{found.slope(middle):+.2%} per kelvin, from {found.low:.3g} to {found.high:.3g} °C; "
            f"it tells the temperature to {kelvin:.2g} K"
        )
        points = [(c, found.scale(c)) for c in np.linspace(found.low, found.high, _POINTS).tolist()]
        entries.append(
            {
                "operating_point": {"peak_velocity": speed, "current": current},
                "range": [found.low, found.high],
                "windows": found.windows,
                "coefficients": found.coefficients.tolist(),
                "covariance": found.covariance.tolist(),
                "temperature": [celsius for celsius, _ in points],
                "force_scale": [scale.value for _, scale in points],
                "force_scale_standard_error": [scale.standard_error for _, scale in points],
            }
        )
    return Findings(lines, {"temperature_maps": entries})
