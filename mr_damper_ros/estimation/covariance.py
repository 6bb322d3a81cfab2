"""Covariance of least-squares estimates, also where the residual is autocorrelated."""

from __future__ import annotations

import math

import numpy as np

from mr_damper_ros.models.operating_points import PriorRows
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
        drawn = math.sqrt(prior.variance) * jacobian[prior.rows]
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
