"""Many windows as a function of some of the parameters, the others held."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mr_damper_ros.models.operating_points import PooledProblem
from mr_damper_ros.signals.arrays import Array

_RIDGE = 1e-4
"""Weight that keeps a flat direction from running away: no more than a trace of the misfit."""


class FreeParameters:
    """A pooled problem for unknowns (f,): the parameters at ``places``, each in its own unit.

    ``values`` (p,) are where it starts, ``sizes`` (f,) the units, ``bounds`` those of all
    parameters (p,). A ridge keeps flat directions where they are.
    """

    def __init__(
        self,
        pooled: PooledProblem,
        values: Array,
        places: Sequence[int],
        sizes: Array,
        bounds: tuple[Array, Array],
    ) -> None:
        self._pooled = pooled
        self._values = np.array(values, dtype=float)
        self._places = list(places)
        self._sizes = sizes
        self._ridge = _RIDGE * np.sqrt(pooled.sample_count)
        self.start = self._values[self._places] / sizes
        low, high = (bound[self._places] / sizes for bound in bounds)
        unbounded = bool(np.all(np.isinf(low)) and np.all(np.isinf(high)))
        self.bounds = None if unbounded else (low, high)

    def parameters(self, unknowns: Array) -> Array:
        """All parameters (p,)."""
        values = self._values.copy()
        values[self._places] = unknowns * self._sizes
        return values

    def residual(self, unknowns: Array) -> Array:
        """Weighted residual of all windows [1], and below it that of the ridge."""
        plain = self._pooled.residual(self.parameters(unknowns))
        return np.concatenate((plain, self._ridge * (unknowns - self.start)))

    def jacobian(self, unknowns: Array) -> Array:
        """Derivatives of the residual by the unknowns."""
        derivatives = self._pooled.jacobian(self.parameters(unknowns), self._places) * self._sizes
        return np.concatenate((derivatives, self._ridge * np.eye(len(self._places))))
