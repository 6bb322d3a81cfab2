"""Reports on windows and global identifications, as the identifier publishes them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.acceptance import Judgement, Verdict
from mr_damper_ros.tracking.force_scale import FluidTemperature, ForceScale
from mr_damper_ros.tracking.jobs import Job, Outcome


@dataclass(frozen=True, eq=False)
class WindowVerdict:
    """The part of a report that the force prediction needs; stamps are those of samples.

    ``set_id`` names the set in use after the report. ``confirms`` says whether the samples up to
    ``stamp_ns`` fit this set. ``nrmse_before`` is the error of the previously used set in the
    window, NaN if unknown.
    """

    window_start_ns: int
    stamp_ns: int
    verdict: int
    nrmse_before: float
    confirms: bool
    set_id: str


@dataclass(frozen=True, eq=False, kw_only=True)
class Report(WindowVerdict):
    """Outcome of one window or one global identification, as published; SI units, NaN = unknown.

    ``reason`` states the ``verdict`` in words. ``temperature`` is the measured temperature.
    Without a measurement, ``fluid`` is the temperature estimated from the force, once a map of
    force over temperature has been learnt at the operating point. ``coefficient_errors`` are the
    standard errors from window to window; ``coefficient_discrepancies`` are the model errors.
    """

    verdict: Verdict
    sample_count: int
    method: str
    evaluations: int
    nrmse_after: float
    reason: str
    scale: ForceScale = field(default_factory=ForceScale)
    peak_velocity: float = math.nan
    amplitude: float = math.nan
    frequency: float = math.nan
    current: float = math.nan
    temperature: float = math.nan
    coefficient_names: tuple[str, ...] = ()
    coefficients: Array = field(default_factory=lambda: np.empty(0))
    coefficient_errors: Array = field(default_factory=lambda: np.empty(0))
    coefficient_discrepancies: Array = field(default_factory=lambda: np.empty(0))
    global_due: bool = False
    fluid: FluidTemperature = field(default_factory=FluidTemperature)

    @property
    def accepted(self) -> bool:
        """Whether the report put a new set into use."""
        return self.verdict.accepted

    @property
    def line(self) -> str:
        """The set in use with its figures, in one line; unknown figures are omitted."""
        figures = (
            (1e3 * self.amplitude, "{:.3g} mm"),
            (self.frequency, "{:.3g} Hz"),
            (self.current, "{:.3g} A"),
            (self.temperature, "{:.1f} °C"),
            (self.scale.value, f"force scale {{:.3f}} ± {self.scale.standard_error:.3f}"),
        )
        known = [text.format(value) for value, text in figures if math.isfinite(value)]
        nrmse = f"NRMSE {self.nrmse_before:.2%} -> {self.nrmse_after:.2%}"
        return f"{self.set_id} is in use: " + ", ".join([nrmse, *known])


def report_of(
    job: Job, outcome: Outcome, judgement: Judgement, set_id: str, *, global_due: bool = False
) -> Report:
    """The report on a job; ``set_id`` names the set in use after it."""
    raw, fit, evidence, summary = job.raw, outcome.fit, outcome.evidence, outcome.summary
    verdict, model = judgement.verdict, job.model
    told: dict[str, Any] = {
        "nrmse_before": evidence.nrmse_before if evidence else math.nan,
        "nrmse_after": evidence.nrmse_after if evidence else math.nan,
        "verdict": verdict,
        "reason": judgement.sentence,
        "set_id": set_id,
    }
    if raw is None:
        # Linear laws are solved by least squares; the others need a search.
        searched = model.searched_laws(frozenset(model.parameter_names)) > 0
        return Report(
            window_start_ns=job.stamp_ns,
            stamp_ns=job.stamp_ns,
            sample_count=sum(window.sample_count for window in job.windows),
            method="differential_evolution" if searched else "least_squares",
            evaluations=outcome.found.evaluations if outcome.found else 0,
            # The windows are old, so a fit to them does not confirm the set for new samples.
            confirms=verdict.accepted,
            **told,
        )
    coefficients = errors = discrepancies = np.full(len(model.coefficient_names), math.nan)
    if fit:
        coefficients = fit.coefficients
        errors = _errors(fit.coefficient_covariance)
        if fit.coefficient_discrepancy is not None:
            discrepancies = _errors(fit.coefficient_discrepancy)
    return Report(
        window_start_ns=raw.start_ns,
        stamp_ns=raw.end_ns,
        sample_count=raw.force.size,
        method=fit.method if fit else job.options.method,
        evaluations=fit.evaluations if fit else 0,
        confirms=verdict.confirms,
        scale=outcome.scale,
        peak_velocity=fit.operating_point[0] if fit else math.nan,
        amplitude=summary.amplitude if summary else math.nan,
        frequency=summary.frequency if summary else math.nan,
        current=float(np.mean(raw.current)),
        temperature=raw.temperature,
        coefficient_names=model.coefficient_names,
        coefficients=coefficients,
        coefficient_errors=errors,
        coefficient_discrepancies=discrepancies,
        global_due=global_due,
        **told,
    )


def _errors(covariance: Array) -> Array:
    # Rounding may make a variance near zero slightly negative.
    return np.sqrt(np.maximum(np.diag(covariance), 0.0))
