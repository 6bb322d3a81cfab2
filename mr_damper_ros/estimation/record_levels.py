"""Random effects: a gain and an offset for each record, so that they do not distort the law.

Temperature, filling and wear of a damper differ between records, and the load cell is zeroed for
each record. The measured force of a record is s F + z, with the force F of the law. The gain s and
the offset z are unknown and normally distributed about 1 and 0. The standard deviation of s is
given; the standard deviation of z is a fraction of the force of the weakest record. The offset does
not depend on the current: an offset that grows with the force belongs to the damper and must be
part of the law. The problem is linear in s and z, so they are integrated out: the search minimises
the misfit at their most probable values, with the prior included (a linear mixed model: Laird and
Ware, Biometrics 38, 1982). Let r be the residual and X = U S V' the effect of gain and offset in
units of their standard deviations. Then only U'r is reduced, by the factor 1 / sqrt(1 + S²). The
reduced part gets two rows per record after all samples, so that each record counts as one draw in
the standard errors.

Thousands of samples with the same model error contain no more information about gain and offset
than a few samples. If all samples counted, they would outweigh any prior, and gain and offset would
take any value that reduces the misfit, even one that makes the law a fraction of the damper's
force. The weight of the prior therefore follows from the variance of the misfit times its
correlation length (:func:`counted_samples`), for an approximate set from a search without record
levels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mr_damper_ros.estimation.covariance import noise_level
from mr_damper_ros.models.misfit import Misfit
from mr_damper_ros.signals.arrays import Array

_ZERO_SPREAD = 0.3
"""Standard deviation of the offset, relative to the standard deviation of the weakest record."""

USUAL_SPREAD = 0.1
"""Default standard deviation [1] of the gain between records."""


@dataclass(frozen=True)
class LevelPrior:
    """``records``: record number of each window; ``spread``: standard deviation of the gain [1].

    ``counted_samples``: number of independent samples that would contain as much information about
    gain and offset as all samples with their model error; infinite without model error. Raises
    ValueError unless the spread is between 0 and 1.
    """

    records: tuple[int, ...]
    spread: float = USUAL_SPREAD
    counted_samples: float = math.inf

    def of_pieces(self, owners: np.ndarray) -> LevelPrior:
        """The prior for pieces (m,) of the windows; ``owners`` are the indices of their windows."""
        return replace(self, records=tuple(self.records[owner] for owner in owners))

    def __post_init__(self) -> None:
        if not 0.0 < self.spread < 1.0:
            raise ValueError(
                f"level_per_record (--level-per-record) is {self.spread}: give the expected "
                "standard deviation of the gains, between 0 and 1, or 0 for no gains"
            )


class Level(NamedTuple):
    """Gain [1] and offset [N] of a record's force with their standard errors.

    ``nrmse``: RMSE with this gain and offset, over the standard deviation of the force [1].
    """

    scale: float
    scale_error: float
    zero: float
    zero_error: float
    nrmse: float


class _Whitened(NamedTuple):
    """One record: its rows, U (n, 2), S (2,), and V (2, 2) in units of gain and offset."""

    rows: np.ndarray
    left: Array
    sizes: Array
    right: Array


class LevelledProblem(Misfit):
    """A pooled problem with gain and offset per record integrated out; see :class:`Misfit`.

    Two rows per record, for gain and offset, follow the rows of the samples. With the Jacobian, the
    gradient of the sum of squares is exact; its curvature is the Gauss-Newton approximation.
    """

    def __init__(self, pooled: Misfit, prior: LevelPrior) -> None:
        super().__init__(*pooled.given, forces=pooled.forces)
        sizes = [window.sample_count for window in self.windows]
        of_sample = np.repeat(np.array(prior.records), sizes)
        self._records = [np.flatnonzero(of_sample == k) for k in sorted(set(prior.records))]
        smallest = min(float(np.std(self._measured[rows])) for rows in self._records)
        self._noise = math.sqrt(max(self.sample_count / prior.counted_samples, 1.0))
        spreads = np.array([prior.spread, _ZERO_SPREAD * max(smallest, 1e-12)])
        self._spreads = spreads / self._noise

    @property
    def row_windows(self) -> np.ndarray:
        """Index of the window of each row (n,) of the residual."""
        last = np.repeat([rows[-1] for rows in self._records], 2)
        return np.concatenate((self.sample_windows, self.sample_windows[last]))

    @property
    def prior_variances(self) -> Array:
        """Variances (m,) of the rows of gain and offset."""
        return np.full(2 * len(self._records), self._noise**2)

    def residual(self, parameters: Array) -> Array:
        """Weighted residual [1] with two more rows per record; infinite if it overflows."""
        plain = super().residual(parameters)
        if not np.all(np.isfinite(plain)):
            return np.full(plain.size + 2 * len(self._records), math.inf)
        return _damped(self._whitened(plain), plain)

    def jacobian(self, parameters: Array, columns: Sequence[int] | None = None) -> Array:
        """Derivatives of the residual, valid for the gradient of its sum of squares."""
        plain = super().residual(parameters)
        derivatives = super().jacobian(parameters, columns)
        whitened = self._whitened(plain)
        for each in whitened:
            derivatives[each.rows] *= 1.0 + float(_levels(each, plain)[0])
        return _damped(whitened, derivatives)

    def mean_square(self, parameters: Array) -> float:
        """Sum of squares over the number of samples."""
        residual = self.residual(parameters)
        return float(residual @ residual) / self.sample_count

    def population_cost(self, parameters: Array) -> Array:
        """:meth:`mean_square` of many sets, shape (s, p) to (s,)."""
        return np.array([self.mean_square(values) for values in parameters])

    def levels(self, parameters: Array, covariance: Array) -> list[Level]:
        """Gain and offset of each record by number, for parameters (p,) with covariance (p, p)."""
        plain = super().residual(parameters)
        varied = np.flatnonzero(np.diag(covariance) > 0.0)
        derivatives = super().jacobian(parameters, varied.tolist())
        found = []
        for each in self._whitened(plain):
            scale, zero = _levels(each, plain)
            given = self._noise**2 * each.right**2 @ (1.0 / (1.0 + each.sizes**2))
            # The uncertainty of the parameters adds to the uncertainty of gain and offset.
            by_parameters = _levels(each, derivatives)
            moved = by_parameters @ covariance[np.ix_(varied, varied)]
            errors = np.sqrt(given + np.sum(moved * by_parameters, axis=1))
            weights, measured = self.sample_weights[each.rows], self._measured[each.rows]
            counted = weights > 0.0
            force = measured + np.divide(
                plain[each.rows], weights, out=np.zeros(measured.size), where=counted
            )
            left = ((1.0 + scale) * force + zero - measured)[counted]
            found.append(
                Level(
                    scale=1.0 + float(scale),
                    scale_error=float(errors[0]),
                    zero=float(zero),
                    zero_error=float(errors[1]),
                    nrmse=float(np.sqrt(np.mean(left**2)) / np.std(measured[counted])),
                )
            )
        return found

    def _whitened(self, plain: Array) -> list[_Whitened]:
        whitened = []
        for rows in self._records:
            weights = self.sample_weights[rows]
            force = plain[rows] + weights * self._measured[rows]
            effect = np.column_stack((force, weights)) * self._spreads
            left, sizes, right = np.linalg.svd(effect, full_matrices=False)
            whitened.append(_Whitened(rows, left, sizes, self._spreads[:, np.newaxis] * right.T))
        return whitened


def counted_samples(pooled: Misfit, prior: LevelPrior, parameters: Array) -> float:
    """``counted_samples`` of a prior, for an approximate set with parameters (p,).

    The number follows from the residual after a fit of gain and offset in which all samples count,
    so that their prior has practically no weight.
    """
    without = LevelledProblem(pooled, replace(prior, counted_samples=math.inf))
    noise = noise_level(without.residual(parameters))
    return max(pooled.sample_count / max(noise * noise, 1.0), float(np.finfo(float).eps))


def _damped(whitened: Sequence[_Whitened], values: Array) -> Array:
    """Rows (n, ...) without the effect of gain and offset, then two extra rows per record."""
    left, extra = values.copy(), []
    for each in whitened:
        along = each.left.T @ values[each.rows]
        left[each.rows] -= each.left @ along
        with np.errstate(over="ignore"):  # the extra rows of an infinite size are zero
            extra.append((along.T / np.sqrt(1.0 + each.sizes**2)).T)
    return np.concatenate((left, *extra))


def _levels(each: _Whitened, residual: Array) -> Array:
    """Most probable gain - 1 and offset [N] of a record (2, ...), from its residual (n, ...)."""
    along = each.left.T @ residual[each.rows]
    return np.asarray(-each.right @ ((each.sizes / (1.0 + each.sizes**2) * along.T).T))
