"""What another motion would say: the discrepancy of a set fitted to windows of several motions.

A law that is not exact leaves a misfit that is not noise, and each motion bends the parameters its
own way. How far, the motions themselves tell: by the scatter of their scores, corrected for what
the fit has taken of it (Bell and McCaffrey, Survey Methodology 28, 2002: their estimate for
clusters is right on average where there is nothing but noise).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mr_damper_ros.estimation.covariance import triangular_factor
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.signals.arrays import Array

_SAME_MOTION = 0.1
"""Relative difference of root mean squares up to which two motions count as one."""

_SAME_CURRENT = 0.05
"""The same of currents [A]."""

_FEWEST_MOTIONS = 3
"""Two tell a difference, but no scatter."""

_SURE = 4.0
"""The scatter exceeds that of noise where it does so by this many of its own errors."""

_LEAST_NOISE = 0.1
"""Of the variance of white noise: an estimate of correlated noise below it is chance."""

_ALONE = 1e-6
"""What all other motions together determine less than to this part rests on one alone."""

_PART = 0.01
"""Of its error: a parameter with so much in a direction is unknown where that is."""


def motion_numbers(windows: Sequence[Window]) -> np.ndarray:
    """The motion, and current, that each window is of, numbered from 0: shape (k,)."""
    seen: list[Array] = []
    numbers = []
    for window in windows:
        motion = window.motion
        size = np.array(
            [
                math.log(max(float(np.std(motion.displacement)), 1e-12)) / _SAME_MOTION,
                math.log(max(float(np.std(motion.velocity)), 1e-12)) / _SAME_MOTION,
                float(np.mean(window.current)) / _SAME_CURRENT,
            ]
        )
        same = (k for k, other in enumerate(seen) if np.all(np.abs(size - other) < 1.0))
        number = next(same, len(seen))
        if number == len(seen):
            seen.append(size)
        numbers.append(number)
    return np.array(numbers, dtype=int)


def discrepancy_between(
    jacobian: Array, residual: Array, motions: np.ndarray, covariance: Array
) -> Array:
    """Covariance (f, f) that the scatter between motions shows besides that of the noise (f, f).

    ``jacobian`` (n, f) and ``residual`` (n,) at the minimum; ``motions`` (n,): the number of the
    motion that a row belongs to. Zero where the scatter may be that of noise. NaN for a parameter
    that a single motion determines, and everywhere where there are fewer than three.
    """
    unknown = np.full_like(covariance, math.nan)
    numbers = np.unique(motions)
    lengths = np.linalg.norm(jacobian, axis=0)
    known = (np.diag(covariance) > 0.0) & (lengths > 0.0)
    if numbers.size < _FEWEST_MOTIONS or not np.any(known):
        return unknown
    block, lengths = np.ix_(known, known), lengths[known]
    triangular = triangular_factor(jacobian[:, known] / lengths)
    # In these coordinates all rows together determine each direction to one and the same.
    to_parameters = np.linalg.inv(triangular) / lengths[:, np.newaxis]
    noise = triangular * lengths @ covariance[block] @ (triangular * lengths).T
    scatter, chance = np.zeros_like(noise), 0.0
    alone: np.ndarray = np.zeros(lengths.size, dtype=bool)
    errors = np.sqrt(np.sum(to_parameters**2, axis=1))
    for number in numbers:
        rows = motions == number
        own = jacobian[np.ix_(rows, known)] @ to_parameters
        shares, axes = np.linalg.eigh(own.T @ own)
        only = shares > 1.0 - _ALONE
        alone |= np.any(np.abs(to_parameters @ axes[:, only]) > _PART * errors[:, None], axis=1)
        taken = np.where(only, 0.0, 1.0 / np.sqrt(np.maximum(1.0 - shares, _ALONE)))
        scores = taken * (axes.T @ (own.T @ residual[rows]))
        scatter += np.outer(axes @ scores, axes @ scores)
        chance += 2.0 * float(np.sum(shares**2))
    white = float(residual @ residual) / residual.size
    factor = to_parameters @ _beyond(scatter, noise, white, math.sqrt(chance))
    excess = factor @ factor.T
    excess[alone, :] = math.nan
    excess[:, alone] = math.nan
    unknown[block] = excess
    return unknown


def _beyond(scatter: Array, noise: Array, white: float, chance: float) -> Array:
    """Root (f, f) of what a covariance exceeds another by, zero where all of it may be chance.

    ``white`` is the variance of the noise were it white; ``chance`` the standard deviation of the
    sum of the scatter's variances over the noise's.
    """
    variances, vectors = np.linalg.eigh(noise)
    root = vectors * np.sqrt(np.maximum(variances, _LEAST_NOISE * white))
    whitened = np.linalg.solve(root, np.linalg.solve(root, scatter).T)
    times, axes = np.linalg.eigh(0.5 * (whitened + whitened.T))
    if float(np.sum(times)) < times.size + _SURE * chance:
        return np.zeros_like(noise)
    directions = root @ axes
    return np.asarray(directions * np.sqrt(np.maximum(times - 1.0, 0.0)))
