"""A level of its own for each record: what bends the shape of a law where it is left out.

A damper is warmer, fuller or older from one record to the next, and a load cell is zeroed anew: the
measured force of a record is s F + z, F that of the law. Scale s and zero z are unknown, normal
about 1 and 0: s with a spread that is given, z with a part of the smallest record's force. A zero
knows no current: one that grows with the force would be the damper's, which the law must hold.
They are linear, so they are integrated out: what is minimised over the parameters is the misfit at
the most probable levels, the prior included (a linear mixed model: Laird and Ware, Biometrics 38,
1982). Of the residual r and X, the effect of both levels in units of their spreads, with X = U S
V', only U'r is damped, by 1 / sqrt(1 + S²). It gets two rows of its own, next to those of the
record, so that it counts for the standard errors as the one draw that it is.

What a law cannot follow is no noise: thousands of samples of the same misfit tell a level no better
than a few. Counted as if they did, they outweigh any prior, and the levels take whatever makes the
misfit smaller, up to a set whose force is a fraction of the damper's. So the prior is weighed
against the variance of the misfit times the samples that count once together
(:func:`counted_samples`). That needs a set that is about right, which one search without levels
gives.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mr_damper_ros.estimation.observability import noise_level
from mr_damper_ros.models.misfit import Misfit, PriorRows
from mr_damper_ros.signals.arrays import Array

_ZERO_SPREAD = 0.3
"""Standard deviation of the force zero, as a part of that of the smallest record's force."""

_NEXT_TO_NOTHING = 1e-6
"""So many samples count where the force overflows."""

_FREE = 1.0 - 1e-9
"""A spread that leaves the levels free."""

USUAL_SPREAD = 0.1
"""Standard deviation [1] of the force scale from record to record, where no other is given."""


@dataclass(frozen=True)
class LevelPrior:
    """``records``: number of the record that each window is of; ``spread`` of the scales [1].

    ``counted_samples``: so many independent samples of the noise that the misfit is weighed by tell
    the levels as much as all samples do, which the law does not quite follow; infinite where it
    does. Raises ValueError where the spread is not positive.
    """

    records: tuple[int, ...]
    spread: float = USUAL_SPREAD
    counted_samples: float = math.inf

    def of_pieces(self, owners: np.ndarray) -> LevelPrior:
        """The same for pieces (m,) of the windows, each with the place of its window."""
        return replace(self, records=tuple(self.records[owner] for owner in owners))

    def __post_init__(self) -> None:
        if not 0.0 < self.spread < 1.0:
            raise ValueError(
                f"the spread of the levels is {self.spread}: it must lie between 0 and 1"
            )


class Level(NamedTuple):
    """Scale [1] and zero [N] of a record's force with their standard errors.

    ``nrmse``: RMSE over the standard deviation of the force that is left with them [1].
    """

    scale: float
    scale_error: float
    zero: float
    zero_error: float
    nrmse: float


class _Whitened(NamedTuple):
    """Of one record: the rows, U (n, 2), S (2,), and V scaled back to scale and zero (2, 2)."""

    rows: np.ndarray
    left: Array
    sizes: Array
    right: Array


class LevelledProblem(Misfit):
    """A pooled problem with the levels of its records integrated out; see :class:`Misfit`.

    The rows of a record are followed by two for its levels. The Jacobian is that of the sum of
    squares: exact in its gradient, and in its curvature as far as Gauss and Newton go.
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
        """The place of the window that each row (n,) of the residual belongs to."""
        of_sample = self.sample_windows
        return np.concatenate([of_sample[[*rows, rows[-1], rows[-1]]] for rows in self._records])

    @property
    def prior(self) -> PriorRows:
        """The rows of the levels; a law with a parameter for each record leaves nothing in them."""
        sizes = [rows.size for rows in self._records]
        last = np.cumsum(np.array(sizes) + 2)
        rows = np.zeros(last[-1], dtype=bool)
        rows[last - 1] = rows[last - 2] = True
        return PriorRows(rows, self._noise**2)

    def residual(self, parameters: Array) -> Array:
        """Weighted residual [1], two rows more for each record; infinite where it overflows."""
        plain = super().residual(parameters)
        if not np.all(np.isfinite(plain)):
            return np.full(plain.size + 2 * len(self._records), math.inf)
        return self._each(plain, lambda each: _damped(each, plain[each.rows]))

    def jacobian(self, parameters: Array, columns: Sequence[int] | None = None) -> Array:
        """Derivatives of it, so far as its sum of squares is concerned."""
        plain = super().residual(parameters)
        derivatives = super().jacobian(parameters, columns)

        def of_record(each: _Whitened) -> Array:
            scale = 1.0 + float(_levels(each, plain)[0])
            return _damped(each, scale * derivatives[each.rows])

        return self._each(plain, of_record)

    def mean_square(self, parameters: Array) -> float:
        """Sum of squares over the number of samples."""
        residual = self.residual(parameters)
        return float(residual @ residual) / self.sample_count

    def population_cost(self, parameters: Array) -> Array:
        """The same of many sets, shape (s, p) to (s,)."""
        return np.array([self.mean_square(values) for values in parameters])

    def levels(self, parameters: Array, covariance: Array) -> list[Level]:
        """Of each record, by rising number, for parameters (p,) of that covariance (p, p)."""
        plain = super().residual(parameters)
        varied = np.flatnonzero(np.diag(covariance) > 0.0)
        derivatives = super().jacobian(parameters, varied.tolist())
        found = []
        for each in self._whitened(plain):
            scale, zero = _levels(each, plain)
            given = self._noise**2 * each.right**2 @ (1.0 / (1.0 + each.sizes**2))
            # What the parameters are not known by, the levels are not, either.
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

    def _each(self, plain: Array, of_record: Callable[[_Whitened], Array]) -> Array:
        return np.concatenate([of_record(each) for each in self._whitened(plain)])

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
    """That of a prior, for a set with parameters (p,) that is about right.

    By what the residual still is without what levels of any size would explain.
    """
    without = LevelledProblem(pooled, replace(prior, spread=_FREE, counted_samples=math.inf))
    noise = noise_level(without, parameters)
    return max(pooled.sample_count / max(noise * noise, 1.0), _NEXT_TO_NOTHING)


def _damped(each: _Whitened, values: Array) -> Array:
    """Rows (n, ...) of a record without what its levels explain, and two rows of that, damped."""
    along = each.left.T @ values
    damping = 1.0 / np.sqrt(1.0 + each.sizes**2)
    return np.concatenate((values - each.left @ along, (damping * along.T).T))


def _levels(each: _Whitened, residual: Array) -> Array:
    """The most probable scale less 1, and zero [N], of a record: residual (n, ...) to (2, ...)."""
    along = each.left.T @ residual[each.rows]
    return np.asarray(-each.right @ ((each.sizes / (1.0 + each.sizes**2) * along.T).T))
