"""Variance of the coefficients against the Cramér-Rao bound, and coverage of their intervals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.dampers import steady_window
from benchmarks.figure import Figure
from mr_damper_ros.emulation.emulator import THESIS_FORCE_NOISE
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.published import Condition, find, parameters
from mr_damper_ros.models.sigmoid.law import (
    Coefficients,
    coefficient_jacobian,
    operating_point_coefficients,
)
from mr_damper_ros.signals.arrays import Array
from studies.thesis.published_runs import PHASE

CONDITION = "5.0mm_1Hz_1.5A"
REALISATIONS = 500
SAMPLES = 2000
INTERVAL = 1.959964
"""Half width of the 95 % interval of a normal distribution, in standard deviations."""


@dataclass(frozen=True, eq=False)
class Scatter:
    """Errors and standard errors (r, 7) of coefficients; ``bound`` (7,) on their variances."""

    errors: Array
    standard_errors: Array
    bound: Array

    @property
    def ratios(self) -> Array:
        """Mean squared error over the bound, one for each coefficient (7,)."""
        return np.asarray(np.mean(self.errors**2, axis=0) / self.bound)

    @property
    def coverage(self) -> float:
        """Part of the 95 % intervals that hold the truth, over all coefficients [1]."""
        return float(np.mean(np.abs(self.errors) <= INTERVAL * self.standard_errors))


def cramer_rao_bound(condition: Condition, truth: Array, samples: int) -> Array:
    """Least variance (7,) of unbiased coefficients from samples of the exact motion at 1 kHz."""
    motion = SineMotion(condition.amplitude, condition.frequency, phase=PHASE).at(
        np.arange(samples, dtype=np.float64) * 1e-3
    )
    jacobian = coefficient_jacobian(Coefficients(*truth), motion.velocity, motion.acceleration)
    return np.diag(THESIS_FORCE_NOISE**2 * np.linalg.inv(jacobian.T @ jacobian))


def scatter(realisations: int, samples: int) -> Scatter:
    """Fits of one condition with independent noise; seeds are 0, 1, 2 ..."""
    condition = find(CONDITION)
    published = parameters(condition)
    speed = 2.0 * np.pi * condition.frequency * condition.amplitude
    truth = np.concatenate(operating_point_coefficients(published, speed, condition.current))
    if truth[0] < 0.0:
        truth[:2] *= -1.0  # the same loop, as fits report it
    fits = [
        fit_window(
            MODELS["sigmoid"],
            steady_window(published, condition, samples=samples, seed=seed),
            published,
            method="least_squares",
        )
        for seed in range(realisations)
    ]
    return Scatter(
        np.array([fit.coefficients - truth for fit in fits]),
        np.array([np.sqrt(np.diag(fit.coefficient_covariance)) for fit in fits]),
        cramer_rao_bound(condition, truth, samples),
    )


def figures(realisations: int = REALISATIONS, samples: int = SAMPLES) -> list[Figure]:
    """``crlb_ratio`` and ``coverage_percent``."""
    found = scatter(realisations, samples)
    chance = np.sqrt(2.0 / realisations)
    return [
        Figure(
            "crlb_ratio",
            float(found.ratios.max()),
            f"Mean squared error of a coefficient over its Cramér-Rao bound, {realisations} noise "
            f"realisations of {samples} samples ({CONDITION}): the largest of the seven.",
            (0.0, 1.1),
            f"Mean of the seven: {found.ratios.mean():.3f}. One ratio has a standard error of "
            f"{chance:.3f} by chance.",
        ),
        Figure(
            "coverage_percent",
            100.0 * found.coverage,
            "Part of the 95 % intervals of the same fits that hold the truth [%].",
            (93.0, 97.0),
        ),
    ]
