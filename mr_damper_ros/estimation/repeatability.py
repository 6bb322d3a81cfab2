"""Two kinds of error of the fit of a window, told apart by what its residual does.

*Repeatability*: what would change from window to window of the same motion. Only noise does that.
*Discrepancy*: what another motion, or another law, would say; it comes from what the law cannot
follow. In a steady sine that misfit repeats in every cycle: the difference of a sample and the one
a cycle later holds none of it, only the noise of both. How the noise adds up in the unknowns
follows from its autocorrelation (:mod:`autocorrelation`). In any other motion the two cannot be
told apart, and the misfit changes with the motion: all of the residual counts as noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.estimation.autocorrelation import NoiseModel
from mr_damper_ros.estimation.covariance import normal_inverse
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.signals.arrays import Array

_LEAST_PART = 0.25
"""Of a second cycle at least this part must be there, to tell the misfit from the noise."""

_SURE = 4.0
"""The residual holds a misfit where its power exceeds that of the noise by so many errors."""

_HIGHEST_ORDER = 24
_ORDERS_PER_CYCLE = 4

_MOST_TAKEN = 0.5

_DRAWS = 8
"""The misfit counts as drawn anew in each of so many parts of a cycle."""


@dataclass(frozen=True, eq=False)
class ErrorCovariances:
    """Covariances (f, f) of the unknowns of a fit, by the kind of error; NaN = undetermined."""

    repeatability: Array
    discrepancy: Array


def samples_per_cycle(window: Window) -> float:
    """Samples of a window from cycle to cycle; NaN where there are none, or not equally spaced."""
    if not (window.steady and window.motion.sine is not None and window.period > 0.0):
        return math.nan
    places = window.places if window.places is not None else np.arange(window.sample_count)
    steps = np.diff(places)
    if steps.size == 0 or not np.all(steps == steps[0]):
        return math.nan
    return 1.0 / (window.motion.sine.frequency * window.period * float(steps[0]))


def error_covariances(
    jacobian: Array, residual: Array, cycle: float = math.nan, weights: Array | None = None
) -> ErrorCovariances:
    """Errors of unknowns fitted by least squares: Jacobian (n, f) and residual (n,) of samples.

    The samples are equally spaced, ``cycle`` of them to a cycle of a steady motion (NaN for any
    other); ``weights`` (n,) multiply the squared residuals.
    """
    if weights is not None:
        root = np.sqrt(weights)
        jacobian, residual = jacobian * root[:, np.newaxis], residual * root
    bread = normal_inverse(jacobian)
    # What is not determined must not make the others unknown.
    lost = np.isnan(bread)
    bread = np.where(lost, 0.0, bread)

    def spread(scores: Array) -> Array:
        return np.asarray(np.where(lost, np.nan, bread @ scores @ bread))

    count, unknowns = jacobian.shape
    split = _split(residual, cycle, count / max(count - unknowns, 1))
    if split is None:
        noise = NoiseModel.of(residual)
        scores = noise.score_covariance(jacobian)
        # The fit takes up noise: of correlated noise more than its share of the samples.
        taken = float(np.sum(bread * scores)) / max(count * noise.variance, 1e-300)
        all_of_it = spread(scores) / max(1.0 - taken, _MOST_TAKEN)
        steady = math.isfinite(cycle)
        return ErrorCovariances(all_of_it, np.zeros_like(all_of_it) if steady else all_of_it)
    noise, phases, seen, misfit = split
    scores = jacobian * misfit[phases, np.newaxis]
    over_cycle: Array = np.zeros((misfit.size, unknowns))
    np.add.at(over_cycle, phases, scores)
    return ErrorCovariances(
        spread(
            noise.score_covariance(jacobian)
            + _of_phase(over_cycle / seen[:, np.newaxis], count, cycle)
        ),
        spread(_of_misfit(over_cycle)),
    )


def _split(
    residual: Array, cycle: float, freedom: float
) -> tuple[NoiseModel, np.ndarray, Array, Array] | None:
    """The noise, the place of each sample in the cycle, how many each place has, the misfit there.

    None where no misfit stands out of the noise, or the cycle does not repeat.

    ``freedom``: samples over degrees of freedom.
    """
    count = residual.size
    if not math.isfinite(cycle) or not 8 <= round(cycle) < count / (1.0 + _LEAST_PART):
        return None
    length = round(cycle)
    apart = (residual[length:] - residual[:-length]) / math.sqrt(2.0)
    noise = NoiseModel.of(apart, min(_HIGHEST_ORDER, length // _ORDERS_PER_CYCLE))
    power = float(residual @ residual) / count * freedom
    chance = math.sqrt(2.0 * max(noise.integrated_time, 1.0) / apart.size)
    if power <= noise.variance * (1.0 + _SURE * chance):
        return None
    phases = np.floor(np.arange(count) % cycle).astype(int) % length
    seen = np.maximum(np.bincount(phases, minlength=length), 1).astype(float)
    return noise, phases, seen, np.bincount(phases, residual, length) / seen


def _of_phase(over_cycle: Array, count: int, cycle: float) -> Array:
    """What the misfit adds where a window is not whole cycles: it begins at any phase.

    ``over_cycle`` (m, f): scores of one sample at each place of the cycle.
    """
    length = over_cycle.shape[0]
    rest = round(count % cycle) % length
    if rest == 0:
        return np.zeros((over_cycle.shape[1],) * 2)
    sums = np.cumsum(np.vstack((over_cycle, over_cycle)), axis=0)
    moving = sums[rest : rest + length] - sums[:length]
    moving = moving - moving.mean(axis=0)
    return np.asarray(moving.T @ moving) / length


def _of_misfit(over_cycle: Array) -> Array:
    edges = np.linspace(0, over_cycle.shape[0], _DRAWS, endpoint=False).astype(int)
    draws = np.add.reduceat(over_cycle, edges, axis=0)
    return np.asarray(draws.T @ draws)
