"""A damper that heats from 28 to 71 °C in ten minutes, followed window by window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from benchmarks import following
from benchmarks.figure import Figure
from mr_damper_ros.emulation.emulator import TemperatureDependentDamper, ThermalModel
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.published import THESIS_28_CELSIUS, THESIS_71_CELSIUS
from mr_damper_ros.models.sigmoid.law import sine_force
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tracking.tracker import TrackerSettings

DURATION = 600.0
COLD, HOT = 28.0, 71.0
CONDUCTANCE = 0.2
"""Convection [W/K]; the heat capacity follows from the duration."""

DAMPER = TemperatureDependentDamper(THESIS_28_CELSIUS, THESIS_71_CELSIUS)


@dataclass(frozen=True, eq=False)
class Drift:
    """Errors of the reported force scales (k,) [1], and NRMSE of the forces predicted and fitted.

    ``predicted`` (m,): by the set in use on the window that follows; ``fitted`` (m,): by a fresh
    least-squares fit of that window itself.
    """

    scale_errors: Array
    predicted: Array
    fitted: Array

    @property
    def scale_error_p95(self) -> float:
        """95th percentile of the absolute errors of the force scale [1]."""
        return float(np.quantile(np.abs(self.scale_errors), 0.95))

    @property
    def nrmse_ratio(self) -> float:
        """Root mean square of the predictions' NRMSE over that of the fresh fits'."""
        return float(np.sqrt(np.mean(self.predicted**2) / np.mean(self.fitted**2)))


def thermal_model(duration: float) -> ThermalModel:
    """Thermal model that takes the damper of this test from 28 to 71 °C in ``duration`` [s]."""
    cycle = following.one_cycle()
    powers = [
        float(np.mean(sine_force(values, *cycle, following.CURRENT) * cycle[1]))
        for values in (THESIS_28_CELSIUS, THESIS_71_CELSIUS)
    ]

    def excess(capacity: float) -> float:
        model = ThermalModel(capacity=capacity, conductance=CONDUCTANCE)
        celsius, steps = model.initial, 1000
        for _ in range(steps):
            warm = (celsius - COLD) / (HOT - COLD)
            power = powers[0] + warm * (powers[1] - powers[0])
            celsius = model.after(celsius, power, duration / steps)
        return celsius - HOT

    return ThermalModel(capacity=brentq(excess, 1e-3, 1e5), conductance=CONDUCTANCE)


def bag(duration: float = DURATION, seed: int = 1) -> Recording:
    """The recording of the drift."""
    return following.recording(DAMPER, duration, seed=seed, thermal=thermal_model(duration))


def measure(run: Recording, settings: TrackerSettings) -> Drift:
    """Follow the drift, and compare with what was true when each report was published."""
    steps = following.follow(run, settings)
    length = round(following.WINDOW / run.period)
    first = next(step.report for step in steps if step.report.accepted)
    baseline_end = following.sample_of(run, first.stamp_ns) + 1
    baseline = _true_loop(run, slice(baseline_end - length, baseline_end))
    errors, predicted, fitted = [], [], []
    for step in steps:
        end = following.sample_of(run, step.report.stamp_ns) + 1
        if np.isfinite(step.report.scale.value):
            truth = following.scale_of(_true_loop(run, slice(end - 1, end)), baseline)
            errors.append(step.report.scale.value / truth - 1.0)
        if end >= baseline_end and end + length <= run.force.size:
            ahead = following.window_between(run, end, end + length)
            predicted.append(following.nrmse(step.parameters, ahead))
            fitted.append(
                fit_window(MODELS["sigmoid"], ahead, step.parameters, method="least_squares").nrmse
            )
    return Drift(np.array(errors), np.array(predicted), np.array(fitted))


def _true_loop(run: Recording, part: slice) -> Array:
    """Force (n,) of the true damper over one cycle, at the mean temperature of a part."""
    assert run.temperature is not None
    warm = (float(np.mean(run.temperature[part])) - COLD) / (HOT - COLD)
    cycle = following.one_cycle()
    cold, hot = (
        sine_force(p, *cycle, following.CURRENT) for p in (THESIS_28_CELSIUS, THESIS_71_CELSIUS)
    )
    return np.asarray(cold + min(max(warm, 0.0), 1.0) * (hot - cold))


def figures(duration: float = DURATION) -> list[Figure]:
    """``drift_scale_error_p95_percent``, ``drift_nrmse_ratio``, ``ukf_drift_...`` of the first."""
    run = bag(duration)
    window, recursive = (
        measure(run, TrackerSettings(tracker=name)) for name in ("window", "recursive")
    )
    assert run.temperature is not None
    shared = (
        f"Emulated rig heating from 28 to {float(run.temperature[-1]):.1f} °C in {duration:.0f} s, "
        f"force interpolated between the published sets, windows of {following.WINDOW:g} s every "
        f"{following.HOP:g} s:"
    )
    return [
        Figure(
            "drift_scale_error_p95_percent",
            100.0 * window.scale_error_p95,
            f"{shared} 95th percentile of the reported force scale's error against the truth at "
            "the end of the window [%].",
            (0.0, 1.0),
        ),
        Figure(
            "drift_nrmse_ratio",
            window.nrmse_ratio,
            f"{shared} NRMSE of the set in use on the window that follows, over that of a fresh "
            "fit of that very window (root mean squares).",
            (0.0, 1.1),
            f"95th percentile of the single ratios: "
            f"{float(np.quantile(window.predicted / window.fitted, 0.95)):.3f}.",
        ),
        Figure(
            "ukf_drift_scale_error_p95_percent",
            100.0 * recursive.scale_error_p95,
            "The force scale's error on the same recording by the recursive Kalman filter [%].",
            note=f"Its NRMSE ratio: {recursive.nrmse_ratio:.3f}.",
        ),
    ]
