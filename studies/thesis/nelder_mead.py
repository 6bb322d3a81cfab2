"""Nelder-Mead over all sixteen parameters, as MATLAB's fminsearch does it (thesis appendix D)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import minimize

from mr_damper_ros.signals.arrays import Array


def fminsearch(
    cost: Callable[[Array], float], start: Array, evaluations: int | None = None
) -> tuple[Array, float, int]:
    """Best point (p,), its cost, evaluations; initial simplex and tolerances of MATLAB.

    Without ``evaluations`` MATLAB's limit of 200 per unknown holds.
    """
    simplex = np.repeat(start[np.newaxis], start.size + 1, axis=0)
    for place in range(start.size):
        simplex[place + 1, place] = 1.05 * start[place] if start[place] != 0.0 else 0.00025
    options: dict[str, Any] = {
        "initial_simplex": simplex,
        "xatol": 1e-4,
        "fatol": 1e-4,
        "maxfev": 200 * start.size if evaluations is None else evaluations,
        "maxiter": 200 * start.size if evaluations is None else evaluations,
    }
    result = minimize(cost, start, method="Nelder-Mead", options=options)
    return np.asarray(result.x), float(result.fun), int(result.nfev)
