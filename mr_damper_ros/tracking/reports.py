"""What became of a window or of a global identification, for others to read."""

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
    """What a report tells those who predict with the running set; a stamp is that of a sample.

    ``confirms``: the samples up to the stamp fit the set of ``set_id``, which is in use after this
    report. ``nrmse_before``: what the set in use before leaves of the window, NaN where unknown.
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

    ``reason`` puts the ``verdict`` into words. ``temperature`` is the measured one;
    where there is none, ``fluid`` is what the force tells of it, once a map of force over
    temperature has been learnt at the operating point. ``coefficient_errors`` are those from window
    to window, ``coefficient_discrepancies`` what another motion or law may say besides.
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
        """Whether a new set is in use since this report."""
        return self.verdict.accepted

    @property
    def line(self) -> str:
        """The set in use and what it is good for, in one line; what is not known is left out."""
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
    """The report of a job; ``set_id`` names the set in use after it."""
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
        # Linear laws are solved, the others are searched.
        searched = model.searched_laws(frozenset(model.parameter_names)) > 0
        return Report(
            window_start_ns=job.stamp_ns,
            stamp_ns=job.stamp_ns,
            sample_count=sum(window.sample_count for window in job.windows),
            method="differential_evolution" if searched else "least_squares",
            evaluations=outcome.found.evaluations if outcome.found else 0,
            # The windows are of the past: that the running set fits them confirms nothing new.
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
    # Rounding may leave a variance that is as good as zero below it.
    return np.sqrt(np.maximum(np.diag(covariance), 0.0))
