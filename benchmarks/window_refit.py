"""Warm re-fit of a window against Nelder-Mead over all sixteen parameters."""

from __future__ import annotations

import statistics
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from benchmarks.dampers import steady_window
from benchmarks.figure import Figure
from benchmarks.timing import interleaved_medians
from mr_damper_ros.emulation.emulator import scaled
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.published import find, parameters
from mr_damper_ros.models.sigmoid.law import sine_force
from mr_damper_ros.signals.arrays import Array

CONDITIONS = ("2.5mm_1Hz_0.0A", "5.0mm_1Hz_1.5A", "5.0mm_3Hz_0.5A", "7.5mm_1Hz_1.0A")
SAMPLES = 1000
DRIFT = 0.99
RESIDUAL_LIMIT = 1.001
TOLERANCE = 1e-4
"""MATLAB's default TolX and TolFun of fminsearch."""


@dataclass(frozen=True)
class Refit:
    """Processor times [s] of one re-fit, and residuals against the reference's."""

    reference: float
    nelder_mead: float
    least_squares: float
    residual_ratios: tuple[float, float]


def reference_fit(window: Window, start: Array) -> tuple[Array, float]:
    """Parameters (16,) and norm of the residual [N], as the thesis does it.

    SciPy's Nelder-Mead over all sixteen parameters on the norm of the residual (thesis eq. 12),
    with the limits and tolerances that fminsearch has by default.
    """
    m = window.motion

    def norm(trial: Array) -> float:
        predicted = sine_force(trial, m.displacement, m.velocity, m.acceleration, window.current)
        return float(np.linalg.norm(predicted - window.force))

    budget = 200 * start.size
    found = minimize(
        norm,
        start,
        method="Nelder-Mead",
        options={"maxfev": budget, "maxiter": budget, "xatol": TOLERANCE, "fatol": TOLERANCE},
    )
    return found.x, float(found.fun)


def measure(condition_name: str, repetitions: int, samples: int = SAMPLES) -> Refit:
    """Re-fit of a window of a damper that has lost 1 % of its force since the one before.

    The start is what was fitted to the window before; the reference runs ``repetitions`` times,
    the fits ten times as often.
    """
    condition = find(condition_name)
    truth = parameters(condition)
    before = steady_window(truth, condition, samples=samples, seed=1)
    window = steady_window(scaled(truth, DRIFT), condition, samples=samples, seed=2)
    start = fit_window(MODELS["sigmoid"], before, truth, method="least_squares").parameters
    reference, nelder_mead, least_squares = interleaved_medians(
        (
            lambda: reference_fit(window, start),
            lambda: fit_window(MODELS["sigmoid"], window, start, method="nelder_mead"),
            lambda: fit_window(MODELS["sigmoid"], window, start, method="least_squares"),
        ),
        (repetitions, 10 * repetitions, 10 * repetitions),
    )
    reached = reference_fit(window, start)[1] / np.sqrt(samples)
    ratios = tuple(
        fit_window(MODELS["sigmoid"], window, start, method=method).rmse / reached
        for method in ("nelder_mead", "least_squares")
    )
    return Refit(reference, nelder_mead, least_squares, (ratios[0], ratios[1]))


def figures(
    repetitions: int = 5, conditions: tuple[str, ...] = CONDITIONS, samples: int = SAMPLES
) -> list[Figure]:
    """``window_nm_speedup``, ``window_nm_ms``, ``window_ls_speedup``: medians over conditions."""
    refits = [measure(name, repetitions, samples) for name in conditions]
    worst = [max(refit.residual_ratios[which] for refit in refits) for which in (0, 1)]
    shared = (
        f"Warm re-fit of {samples} samples after a drift of 1 %, median over "
        f"{len(refits)} conditions; processor time against SciPy's Nelder-Mead over all 16 "
        f"parameters from the same start (maxfev = maxiter = 3200, tolerances {TOLERANCE:g})."
    )

    def speedup(key: str, which: int, bar: float) -> Figure:
        ratios = [
            refit.reference / (refit.nelder_mead, refit.least_squares)[which] for refit in refits
        ]
        valid = worst[which] <= RESIDUAL_LIMIT
        return Figure(
            key,
            statistics.median(ratios) if valid else None,
            shared,
            (bar, float("inf")),
            f"Single conditions: {', '.join(f'{ratio:.0f}' for ratio in ratios)}. Largest residual "
            f"against the reference's: {worst[which]:.5f} (limit {RESIDUAL_LIMIT}).",
        )

    return [
        speedup("window_nm_speedup", 0, 20.0),
        Figure(
            "window_nm_ms",
            1e3 * statistics.median(refit.nelder_mead for refit in refits),
            "Processor time of that Nelder-Mead re-fit, covariance included [ms].",
            (0.0, 10.0),
        ),
        speedup("window_ls_speedup", 1, 100.0),
    ]
