"""Errors of least-squares estimates, where the residual is noise, correlated noise, or misfit.

*White noise* gives the textbook covariance, *correlated noise* a larger one: samples within a
correlation length count once together. Noise is described by an autoregression, whose order is
chosen by Schwarz' criterion and whose coefficients are Burg's ("Maximum entropy spectral
analysis", 1967).

What a law cannot follow is no noise. *Repeatability* is what would change from window to window of
the same motion; *discrepancy* is what another motion, or another law, would say. In a steady sine
the misfit repeats in every cycle: the difference of a sample and the one a cycle later holds none
of it, only the noise of both. In any other single motion the two cannot be told apart, and all of
the residual counts as noise. Of windows of several motions, each motion bends the parameters its
own way; the discrepancy is the scatter of their scores, corrected for what the fit has taken of it
(Bell and McCaffrey, Survey Methodology 28, 2002).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.misfit import PriorRows
from mr_damper_ros.signals.arrays import Array

_DETERMINED = 1e-10
"""A singular value smaller than this part of the largest stands for a direction without data."""

_FEWEST_BLOCKS = 20
"""Fewer block sums than this would give a covariance of their own chance."""

_WHITE = 3.0
"""Residuals whose lag-1 autocorrelation is within this many standard errors of 0 count as white."""

_CHUNK = 4096
"""Rows of a matrix that are factorised at once: so many stay in the cache."""


def triangular_factor(matrix: Array) -> Array:
    """Factor R (min(n, p), p) of the QR decomposition of a matrix (n, p), signs of rows aside.

    It has the singular values and the right singular vectors of the matrix, and is small. A long
    matrix is factorised in chunks, and their factors together: four times as fast for 200 000 rows
    (Demmel, Grigori, Hoemmen and Langou, SIAM Journal on Scientific Computing 34, 2012).
    """
    if matrix.shape[0] > _CHUNK:
        chunks = np.array_split(matrix, math.ceil(matrix.shape[0] / _CHUNK))
        matrix = np.concatenate([np.linalg.qr(chunk, mode="r") for chunk in chunks])
    return np.asarray(np.linalg.qr(matrix, mode="r"))


def normal_inverse(jacobian: Array) -> Array:
    """Inverse of JᵀJ for a Jacobian of shape (n, p), shape (p, p).

    Columns are scaled first, so that units do not matter. Directions that the data do not
    determine get an infinite variance: every parameter that has a part in one is NaN.
    """
    lengths = np.linalg.norm(jacobian, axis=0)
    safe = np.where(lengths > 0.0, lengths, 1.0)
    triangular = triangular_factor(jacobian) / safe
    _, singular, vt = np.linalg.svd(triangular, full_matrices=False)
    determined = singular > _DETERMINED * max(float(singular[0]), 1e-300)
    inverse = np.asarray((vt[determined].T / singular[determined] ** 2) @ vt[determined])
    inverse = inverse / np.outer(safe, safe)
    lost = np.any(np.abs(vt[~determined]) > 1e-3, axis=0) | (lengths == 0.0)
    inverse[lost, :] = np.nan
    inverse[:, lost] = np.nan
    return np.asarray(inverse)


def least_squares_covariance(
    jacobian: Array,
    residual: Array,
    weights: Array | None = None,
    prior: PriorRows | None = None,
) -> Array:
    """Covariance (p, p) of parameters fitted by weighted least squares.

    ``jacobian`` (n, p) and ``residual`` (n,) are unweighted, ``weights`` (n,) multiply the
    squared residuals. A white residual gives s² (JᵀWJ)⁻¹, with s² from n - p degrees of freedom.
    An autocorrelated one, the rule where the model and not the sensor limits the fit, gives the
    sandwich estimate with the scores summed over blocks longer than the correlation (Liang and
    Zeger, Biometrika 73, 1986). ``prior``: rows that are no samples. NaN for parameters that the
    data do not determine.
    """
    if weights is not None:
        root = np.sqrt(weights)
        jacobian, residual = jacobian * root[:, np.newaxis], residual * root
    bread = normal_inverse(jacobian)
    drawn = np.zeros((0, jacobian.shape[1]))
    if prior is not None:
        drawn = jacobian[prior.rows] * np.sqrt(np.reshape(prior.variance, (-1, 1)))
        jacobian, residual = jacobian[~prior.rows], residual[~prior.rows]
    n, p = jacobian.shape
    freedom = max(n - p, 1)
    length = correlation_length(residual)
    white = float(residual @ residual) / freedom
    if length == 0 and prior is None:
        return np.asarray(white * bread)
    # What is not determined must not make the others unknown.
    lost = np.isnan(bread)
    bread = np.where(lost, 0.0, bread)
    if length == 0:
        scores = white * jacobian.T @ jacobian
    else:
        scores = _block_scores(jacobian, residual, length) * (n / freedom)
    return np.asarray(np.where(lost, np.nan, bread @ (scores + drawn.T @ drawn) @ bread))


def _block_scores(jacobian: Array, residual: Array, length: int) -> Array:
    """Sum (p, p) over blocks of so many samples, or fewer, of the squares of their scores."""
    n = residual.size
    blocks = max(n // length, min(_FEWEST_BLOCKS, n))
    edges = np.linspace(0, n, blocks, endpoint=False).astype(int)
    scores = np.add.reduceat(jacobian * residual[:, np.newaxis], edges, axis=0)
    return np.asarray(scores.T @ scores)


def correlation_length(residual: Array) -> int:
    """Number of samples over which a residual is correlated; 0 where it is white.

    Four times the first lag at which the autocorrelation has fallen below 0.05.
    """
    n = residual.size
    centred = residual - residual.mean()
    power = float(centred @ centred)
    if power == 0.0 or n < 32:
        return 0
    if abs(float(centred[1:] @ centred[:-1]) / power) <= _WHITE / math.sqrt(n):
        return 0
    size = 1 << (2 * n - 1).bit_length()
    spectrum = np.fft.rfft(centred, size)
    correlation = np.fft.irfft(np.abs(spectrum) ** 2, size)[: n // 4] / power
    below = np.flatnonzero(correlation < 0.05)
    first = int(below[0]) if below.size else correlation.size
    return int(min(4 * first, n // 4))


def without_negative_variance(covariance: Array) -> Array:
    """A covariance (f, f) in whose variances rounding has left no less than nothing.

    Where unknowns are known to very different parts of their sizes, it does.
    """
    variances = np.diagonal(covariance)
    if not np.any(variances < 0.0):
        return covariance
    result = covariance.copy()
    np.fill_diagonal(result, np.where(variances < 0.0, 0.0, variances))
    return result


_HIGHEST_ORDER = 24

_PATIENCE = 8
"""So many higher orders are tried in vain before the search ends."""

_SAMPLES_PER_ORDER = 10
"""An autoregression of n samples has at most the n-th part of this as its order."""


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Stationary noise x of an autoregression, x[t] + sum_k ``coefficients``[k-1] x[t-k] = e[t].

    e is white and has the variance ``innovation``; ``variance`` is that of x. ``coefficients`` has
    shape (order,).
    """

    coefficients: Array
    innovation: float
    variance: float

    @classmethod
    def of(cls, series: Array, highest_order: int = _HIGHEST_ORDER) -> NoiseModel:
        """The noise of samples (n,) of mean zero, equally spaced."""
        count = series.size
        variance = float(series @ series) / max(count, 1)
        coefficients = best = np.empty(0)
        innovation = least = variance
        chosen = math.inf
        forward = backward = np.asarray(series, dtype=float)
        for order in range(min(highest_order, count // _SAMPLES_PER_ORDER) + 1):
            if order > 0:
                ahead, behind = forward[1:], backward[:-1]
                power = float(ahead @ ahead + behind @ behind)
                if not power > 0.0:
                    break
                reflection = -2.0 * float(ahead @ behind) / power
                padded = np.append(coefficients, 0.0)
                coefficients = padded + reflection * np.append(coefficients[::-1], 1.0)
                forward = ahead + reflection * behind
                backward = behind + reflection * ahead
                innovation *= max(1.0 - reflection**2, 0.0)
            if not innovation > 0.0:
                break
            criterion = count * math.log(innovation) + order * math.log(max(count, 2))
            if criterion < chosen:
                chosen, best, least = criterion, coefficients, innovation
            elif order > best.size + _PATIENCE:
                break
        return cls(best, least, variance)

    @property
    def white(self) -> bool:
        """Whether no sample tells anything of the next."""
        return self.coefficients.size == 0

    @property
    def integrated_time(self) -> float:
        """Integrated autocorrelation time [samples]: 1 of white noise.

        The mean of n samples has the variance of n / this many independent ones.
        """
        if self.white or self.variance == 0.0:
            return 1.0
        level = self.innovation / (1.0 + float(np.sum(self.coefficients))) ** 2
        return level / self.variance

    def score_covariance(self, columns: Array) -> Array:
        """Covariance (p, p) of columnsᵀ x for columns of shape (n, p)."""
        if self.white:
            return np.asarray(self.variance * (columns.T @ columns))
        count = columns.shape[0]
        size = 1 << (2 * count - 1).bit_length()
        polynomial = np.fft.rfft(np.append(1.0, self.coefficients), size)
        spectrum = self.innovation / np.abs(polynomial) ** 2
        # Of the two halves of the spectrum only one is computed.
        twice = np.full(spectrum.size, 2.0 / size)
        twice[[0, -1]] = 1.0 / size
        transformed = np.fft.rfft(columns, size, axis=0)
        weighted = transformed * (spectrum * twice)[:, np.newaxis]
        return np.asarray((transformed.conj().T @ weighted).real)


_LEAST_PART = 0.25
"""Of a second cycle at least this part must be there, to tell the misfit from the noise."""

_SURE = 4.0
"""A power exceeds that of the noise where it does so by this many of its own errors."""

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


_SAME_MOTION = 0.1
"""Relative difference of root mean squares up to which two motions count as one."""

_SAME_CURRENT = 0.05
"""The same of currents [A]."""

_FEWEST_MOTIONS = 3
"""Two tell a difference, but no scatter."""

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
