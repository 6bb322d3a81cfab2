"""Standard errors of least-squares estimates under noise, correlated noise and model error.

*White noise* gives the textbook covariance. *Correlated noise* gives a larger covariance, because
the samples within a correlation length count as one. The noise is described by an autoregressive
model. Schwarz' criterion selects its order, and Burg's method estimates its coefficients ("Maximum
entropy spectral analysis", 1967).

Model error is not noise. *Repeatability* is the scatter of the estimates between windows of the
same motion. *Discrepancy* is the change of the estimates under a different motion or a different
law. In a steady sine the model error repeats in every cycle. The difference between samples one
cycle apart therefore contains only noise. In any other single motion, noise and model error cannot
be separated, and the whole residual counts as noise. With windows of several motions, each motion
biases the parameters differently. The scores (Jacobian times residual) are corrected for the part
that the fit has absorbed (Bell and McCaffrey, Survey Methodology 28, 2002). If they scatter between
motions by more than noise, the discrepancy is the scatter of the fits that leave out one motion
each (jackknife).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.quantities import ROWS_AT_ONCE, SAME_CURRENT
from mr_damper_ros.signals.arrays import NEGLIGIBLE, SIGMAS, Array

DETERMINED = 1e-10
"""Relative singular value below which the data do not determine a direction."""

_FEWEST_BLOCKS = 20
"""Smallest number of blocks of samples for a usable covariance estimate."""

SIGNIFICANT = 4.0
"""A power is significant if it exceeds the noise power by this many standard errors."""


def triangular_factor(matrix: Array) -> Array:
    """Factor R (min(n, p), p) of the QR decomposition of a matrix (n, p), up to signs of rows.

    R has the same singular values and right singular vectors as the matrix. A long matrix is
    factorised in chunks, and then their stacked factors are factorised; for 200 000 rows this is
    four times as fast (Demmel, Grigori, Hoemmen and Langou, SIAM Journal on Scientific Computing
    34, 2012).
    """
    if matrix.shape[0] > ROWS_AT_ONCE:
        chunks = np.array_split(matrix, math.ceil(matrix.shape[0] / ROWS_AT_ONCE))
        matrix = np.concatenate([np.linalg.qr(chunk, mode="r") for chunk in chunks])
    return np.asarray(np.linalg.qr(matrix, mode="r"))


def normal_inverse(jacobian: Array) -> Array:
    """Inverse of JᵀJ for a Jacobian of shape (n, p), shape (p, p).

    The columns are scaled first, so that the result does not depend on the units. If the data do
    not determine a direction, each parameter with a component in this direction is NaN.
    """
    lengths = np.linalg.norm(jacobian, axis=0)
    safe = np.where(lengths > 0.0, lengths, 1.0)
    triangular = triangular_factor(jacobian) / safe
    _, singular, vt = np.linalg.svd(triangular, full_matrices=False)
    determined = singular > DETERMINED * max(float(singular[0]), 1e-300)
    inverse = np.asarray((vt[determined].T / singular[determined] ** 2) @ vt[determined])
    inverse = inverse / np.outer(safe, safe)
    lost = np.any(np.abs(vt[~determined]) > 1e-3, axis=0) | (lengths == 0.0)
    inverse[lost, :] = np.nan
    inverse[:, lost] = np.nan
    return np.asarray(inverse)


def prior_root(jacobian: Array) -> Array:
    """Root W (p, p) of the covariance W Wᵀ of unknowns with a prior of unit width.

    ``jacobian`` (n, p) belongs to a residual of unit variance. The root exists for any finite
    Jacobian; a direction whose information is lost in rounding keeps the prior.
    """
    with_prior = np.vstack((jacobian, np.eye(jacobian.shape[1])))
    _, sizes, axes = np.linalg.svd(triangular_factor(with_prior))
    lost = sizes <= sizes.size * np.finfo(float).eps * sizes[0]
    return np.asarray(axes.T / np.where(lost, 1.0, np.maximum(sizes, 1.0)))


def white_level(jacobian: Array, covariance: Array, otherwise: float) -> float:
    """Standard deviation of white noise that gives unknowns (f,) the same uncertainty.

    ``jacobian`` has shape (n, f), ``covariance`` (f, f). The median over the unknowns counts;
    ``otherwise`` is the level if none is determined.
    """
    white, variances = np.diag(normal_inverse(jacobian)), np.diag(covariance)
    known = np.isfinite(variances) & (white > 0.0)
    if not known.any():
        return otherwise
    return math.sqrt(max(float(np.median(variances[known] / white[known])), 0.0))


_NO_PRIOR: Array = np.empty(0)


def least_squares_covariance(
    jacobian: Array, residual: Array, prior_variances: Array = _NO_PRIOR
) -> Array:
    """Covariance (p, p) of least-squares parameters, from ``jacobian`` (n, p), ``residual`` (n,).

    A white residual gives s² (JᵀJ)⁻¹, with s² from n - p degrees of freedom. An autocorrelated
    residual, which model error typically causes, gives the sandwich estimate, with the scores
    summed over blocks longer than the correlation length (Liang and Zeger, Biometrika 73, 1986).
    ``prior_variances`` (m,): the last m rows belong to a prior and have these known variances.
    Parameters that the data do not determine are NaN.
    """
    bread = normal_inverse(jacobian)
    n, p = residual.size - prior_variances.size, jacobian.shape[1]
    drawn = jacobian[n:] * np.sqrt(prior_variances)[:, np.newaxis]
    jacobian, residual = jacobian[:n], residual[:n]
    freedom = max(n - p, 1)
    length = correlation_length(residual)
    white = float(residual @ residual) / freedom
    if length == 1 and not prior_variances.size:
        return np.asarray(white * bread)
    if length == 1:
        scores = white * jacobian.T @ jacobian
    else:
        # Blocks of at most ``length`` samples.
        blocks = max(n // length, min(_FEWEST_BLOCKS, n))
        edges = np.linspace(0, n, blocks, endpoint=False).astype(int)
        sums = np.add.reduceat(jacobian * residual[:, np.newaxis], edges, axis=0)
        scores = np.asarray(sums.T @ sums) * (n / freedom)
    return _sandwich(bread, scores + drawn.T @ drawn)


def _sandwich(bread: Array, scores: Array) -> Array:
    """Covariance (p, p) of parameters from the covariance of scores; NaN where ``bread`` is NaN."""
    # Undetermined parameters must not make the others NaN.
    known = np.nan_to_num(bread)
    return np.asarray(np.where(np.isnan(bread), np.nan, known @ scores @ known))


def correlation_length(residual: Array) -> int:
    """Correlation length of a residual in samples; 1 if it is white.

    It is four times the first lag at which the autocorrelation is below 0.05.
    """
    n = residual.size
    centred = residual - residual.mean()
    power = float(centred @ centred)
    if power == 0.0 or n < 32:
        return 1
    if abs(float(centred[1:] @ centred[:-1]) / power) <= SIGMAS / math.sqrt(n):
        return 1
    size = 1 << (2 * n - 1).bit_length()
    spectrum = np.fft.rfft(centred, size)
    correlation = np.fft.irfft(np.abs(spectrum) ** 2, size)[: n // 4] / power
    below = np.flatnonzero(correlation < 0.05)
    first = int(below[0]) if below.size else correlation.size
    return int(min(4 * first, n // 4))


def independent_samples(residual: Array) -> float:
    """Number of independent samples with as much information as a residual (n,)."""
    return residual.size / correlation_length(residual)


def noise_level(residual: Array, unknowns: int = 0) -> float:
    """Standard deviation of one independent sample of a residual (n,) after a fit of unknowns.

    It is larger for a correlated residual, so that model error does not average out like noise.
    """
    freedom = max(independent_samples(residual) - unknowns, 1.0)
    # A law that describes the force exactly must not give an information that overflows.
    return math.sqrt(max(float(np.sum(residual**2)) / freedom, 1e-24))


def without_negative_variance(covariance: Array) -> Array:
    """The covariance (f, f), with negative variances caused by rounding set to zero.

    This happens if the relative standard errors of the unknowns differ greatly.
    """
    result = covariance.copy()
    np.fill_diagonal(result, np.diagonal(covariance).clip(min=0.0))
    return result


_HIGHEST_ORDER = 24

_SAMPLES_PER_ORDER = 10
"""The order for n samples is at most n divided by this number."""


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Stationary autoregressive noise: x[t] + sum_k ``coefficients``[k-1] x[t-k] = e[t].

    e is white with variance ``innovation``; ``variance`` is the variance of x. ``coefficients`` has
    shape (order,); white noise has none.
    """

    coefficients: Array
    innovation: float
    variance: float

    @classmethod
    def of(cls, series: Array, highest_order: int = _HIGHEST_ORDER) -> NoiseModel:
        """Fit the noise model to uniformly sampled values (n,) with zero mean."""
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
        return cls(best, least, variance)

    @property
    def integrated_time(self) -> float:
        """Integrated autocorrelation time [samples]; 1 for white noise.

        The mean of n samples has the same variance as the mean of n / (this time) independent ones.
        """
        if not self.coefficients.size or self.variance == 0.0:
            return 1.0
        gain = (1.0 + float(np.sum(self.coefficients))) ** 2
        return self.innovation / gain / self.variance if gain > 0.0 else math.inf

    def score_covariance(self, columns: Array) -> Array:
        """Covariance (p, p) of columnsᵀ x for columns of shape (n, p)."""
        if not self.coefficients.size:
            return np.asarray(self.variance * (columns.T @ columns))
        count = columns.shape[0]
        size = 1 << (2 * count - 1).bit_length()
        polynomial = np.fft.rfft(np.append(1.0, self.coefficients), size)
        # No frequency holds more than the whole power, even if the polynomial is zero there.
        least = self.innovation / (size * self.variance)
        spectrum = self.innovation / np.maximum(np.abs(polynomial) ** 2, least)
        # Only one half of the symmetric spectrum is computed.
        twice = np.full(spectrum.size, 2.0 / size)
        twice[[0, -1]] = 1.0 / size
        transformed = np.fft.rfft(columns, size, axis=0)
        weighted = transformed * (spectrum * twice)[:, np.newaxis]
        return np.asarray((transformed.conj().T @ weighted).real)


_SECOND_CYCLE = 0.25
"""Smallest fraction of the second cycle that a window needs to separate model error from noise."""

_MOST_ABSORBED = 0.5

_CYCLE_PARTS = 8
"""Number of parts of a cycle with independent model errors."""


_PER_PHASE = 20
"""Samples of a phase in many cycles, if the samples of a single cycle would give fewer phases."""


@dataclass(frozen=True, eq=False)
class CyclePhases:
    """The phases of the samples of a steady motion.

    ``numbers`` (n,): the phase of each sample, one of ``count`` equal parts of the cycle; ``rest``:
    number of phases by which the samples exceed whole cycles.
    """

    numbers: np.ndarray
    count: int
    rest: int

    @classmethod
    def of(cls, window: Window, most: float = math.inf) -> CyclePhases | None:
        """The phases of a window; None if it has no cycles."""
        sine = window.motion.sine
        if not (window.steady and sine is not None and window.period > 0.0):
            return None
        places = window.places if window.places is not None else np.arange(window.sample_count)
        return cls.at((places - places[0]) * (window.period * sine.frequency), most)

    @classmethod
    def at(cls, cycles: Array, most: float = math.inf) -> CyclePhases:
        """The phases, ``most`` at most, of samples at increasing times (n,) in cycles, from 0 on.

        A phase holds one sample of each cycle. If these are few, it holds samples of more cycles.
        """
        n = cycles.size
        length = float(cycles[-1]) * n / max(n - 1, 1)
        count = max(round(min(max(n / max(length, 1.0), n / _PER_PHASE), most)), 1)
        numbers = np.floor(cycles % 1.0 * count).astype(int) % count
        return cls(numbers, count, round(length % 1.0 * count) % count)

    def differences(self, values: Array) -> Array:
        """Differences (m,) of values (n,) from the one before in the same phase, in time order."""
        order = np.argsort(self.numbers, kind="stable")
        same = np.diff(self.numbers[order]) == 0
        later, earlier = order[1:][same], order[:-1][same]
        in_time = np.argsort(later)
        return np.asarray(values[later[in_time]] - values[earlier[in_time]])


class ErrorCovariances(NamedTuple):
    """Covariances (f, f) of the unknowns of a fit, by kind of error; NaN: undetermined."""

    repeatability: Array
    discrepancy: Array


def error_covariances(
    jacobian: Array, residual: Array, phases: CyclePhases | None = None
) -> ErrorCovariances:
    """Covariances of least-squares unknowns from the Jacobian (n, f) and residual (n,) of samples.

    The samples are in the order of time. ``phases``: their phases in a steady motion, None for any
    other motion.
    """
    bread = normal_inverse(jacobian)
    count, unknowns = jacobian.shape
    freedom = count / max(count - unknowns, 1)
    if phases is not None and 8 <= phases.count < count / (1.0 + _SECOND_CYCLE):
        apart = phases.differences(residual) / math.sqrt(2.0)
        noise = NoiseModel.of(apart, min(_HIGHEST_ORDER, phases.count // _CYCLE_PARTS))
        power = float(residual @ residual) / count * freedom
        chance = math.sqrt(2.0 * max(noise.integrated_time, 1.0) / apart.size)
        if power > noise.variance * (1.0 + SIGNIFICANT * chance):
            by_noise = noise.score_covariance(jacobian)
            by_phase, by_misfit = _model_error_scores(jacobian, residual, phases)
            return ErrorCovariances(
                _sandwich(bread, by_noise + by_phase), _sandwich(bread, by_misfit)
            )
    noise = NoiseModel.of(residual)
    scores = noise.score_covariance(jacobian)
    # The fit absorbs more of correlated noise than of white noise (unknowns / samples).
    taken = float(np.nansum(bread * scores)) / max(count * noise.variance, 1e-300)
    all_of_it = _sandwich(bread, scores) / max(1.0 - taken, _MOST_ABSORBED)
    steady = phases is not None
    return ErrorCovariances(all_of_it, np.zeros_like(all_of_it) if steady else all_of_it)


def _model_error_scores(
    jacobian: Array, residual: Array, phases: CyclePhases
) -> tuple[Array, Array]:
    """Covariances (f, f) of the scores from a model error that repeats in every cycle.

    The first comes from incomplete cycles if the window begins at any phase, the second from the
    model error itself.
    """
    length, rest, numbers = phases.count, phases.rest, phases.numbers
    seen = np.maximum(np.bincount(numbers, minlength=length), 1).astype(float)
    misfit = np.bincount(numbers, residual, length) / seen
    over_cycle: Array = np.zeros((length, jacobian.shape[1]))
    np.add.at(over_cycle, numbers, jacobian * misfit[numbers, np.newaxis])
    edges = np.linspace(0, length, _CYCLE_PARTS, endpoint=False).astype(int)
    draws = np.add.reduceat(over_cycle, edges, axis=0)
    one_each = over_cycle / seen[:, np.newaxis]
    sums = np.cumsum(np.vstack((one_each, one_each)), axis=0)
    moving = sums[rest : rest + length] - sums[:length]
    moving = moving - moving.mean(axis=0)
    return np.asarray(moving.T @ moving) / length, np.asarray(draws.T @ draws)


SAME_MOTION = 0.1
"""Motions count as the same if their speeds, or RMS values, differ by at most this fraction."""

ENOUGH_TO_COMPARE = 3
"""Smallest number of motions, or of windows of one motion, from which their scatter is known."""

_LEAST_NOISE = 0.1
"""Lower limit of the noise variance, relative to white noise; a lower estimate is due to chance."""

_ONE_MOTION = 1e-6
"""One motion alone determines a direction if all others give less than this part of the
information."""


def motion_numbers(windows: Sequence[Window]) -> np.ndarray:
    """A number (k,) for each window, from 0; windows of equal motion share it.

    Model error persists over the currents of a motion, so currents do not make motions different.
    With fewer than three motions, only windows of equal motion and current share a number.
    """
    sizes = [
        (
            math.log(max(float(np.std(window.motion.displacement)), 1e-12)) / SAME_MOTION,
            math.log(max(float(np.std(window.motion.velocity)), 1e-12)) / SAME_MOTION,
            float(np.mean(window.current)) / SAME_CURRENT,
        )
        for window in windows
    ]
    motions = group_numbers(np.array(sizes)[:, :2])
    return motions if motions.max() + 1 >= ENOUGH_TO_COMPARE else group_numbers(np.array(sizes))


def group_numbers(sizes: Array) -> np.ndarray:
    """A number (k,) for each row (k, n); rows that differ by less than 1 everywhere share it."""
    numbers = np.full(len(sizes), -1)
    while (left := np.flatnonzero(numbers < 0)).size:
        same = np.all(np.abs(sizes[left] - sizes[left[0]]) < 1.0, axis=1)
        numbers[left[same]] = numbers.max() + 1
    return numbers


def discrepancy_between(
    jacobian: Array, residual: Array, motions: np.ndarray, covariance: Array
) -> Array:
    """Covariance (f, f) from the scatter between motions in excess of ``covariance`` (f, f).

    ``jacobian`` (n, f) and ``residual`` (n,) are taken at the minimum; ``motions`` (n,) is the
    number of the motion of each row, negative for rows of a prior. The result is the scatter of the
    fits that leave out one motion each (jackknife), because a motion that was not measured is like
    a motion left out. It is zero if noise explains the scatter, NaN for a parameter that only one
    motion determines, and all NaN with fewer than three motions.
    """
    unknown = np.full_like(covariance, math.nan)
    numbers = np.unique(motions[motions >= 0])
    lengths = np.linalg.norm(jacobian, axis=0)
    known = (np.diag(covariance) > 0.0) & (lengths > 0.0)
    if numbers.size < ENOUGH_TO_COMPARE or not np.any(known):
        return unknown
    block, lengths = np.ix_(known, known), lengths[known]
    triangular = triangular_factor(jacobian[:, known] / lengths)
    # In these coordinates the information of all rows is the identity matrix.
    to_parameters = np.linalg.inv(triangular) / lengths[:, np.newaxis]
    noise = triangular * lengths @ covariance[block] @ (triangular * lengths).T
    scatter, jackknife, chance = np.zeros_like(noise), np.zeros_like(noise), 0.0
    alone: np.ndarray = np.zeros(lengths.size, dtype=bool)
    errors = np.sqrt(np.sum(to_parameters**2, axis=1))
    for number in numbers:
        rows = motions == number
        own = jacobian[np.ix_(rows, known)] @ to_parameters
        shares, axes = np.linalg.eigh(own.T @ own)
        only = shares > 1.0 - _ONE_MOTION
        alone |= np.any(
            np.abs(to_parameters @ axes[:, only]) > NEGLIGIBLE * errors[:, None], axis=1
        )
        taken = np.where(only, 0.0, 1.0 / np.sqrt(np.maximum(1.0 - shares, _ONE_MOTION)))
        scores = taken * (axes.T @ (own.T @ residual[rows]))
        scatter += np.outer(axes @ scores, axes @ scores)
        shift = axes @ (taken * scores)
        jackknife += (1.0 - 1.0 / numbers.size) * np.outer(shift, shift)
        chance += 2.0 * float(np.sum(shares**2))
    variances, vectors = np.linalg.eigh(noise)
    least = _LEAST_NOISE * float(residual @ residual) / residual.size
    root = vectors * np.sqrt(np.maximum(variances, least))
    found = float(np.trace(np.linalg.solve(root, np.linalg.solve(root, scatter).T)))
    excess = np.zeros_like(noise)
    if found >= lengths.size + SIGNIFICANT * math.sqrt(chance):
        whitened = np.linalg.solve(root, np.linalg.solve(root, jackknife).T)
        times, axes = np.linalg.eigh(0.5 * (whitened + whitened.T))
        factor = to_parameters @ root @ axes * np.sqrt(np.maximum(times - 1.0, 0.0))
        excess = factor @ factor.T
    # The discrepancy of a parameter is unknown if its error has more than a negligible contribution
    # from a direction that one motion alone determines.
    excess[alone, :] = math.nan
    excess[:, alone] = math.nan
    unknown[block] = excess
    return unknown
