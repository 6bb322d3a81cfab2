"""Let what is linear in the laws follow a change of what is not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings, ProgressClock
from mr_damper_ros.models.sigmoid.coefficient_laws import CoefficientTable, fit_laws
from mr_damper_ros.models.sigmoid.extension import SIGMOID_COUNT
from mr_damper_ros.models.sigmoid.law import operating_point_coefficients
from mr_damper_ros.models.sigmoid.scale_misfit import Window
from mr_damper_ros.signals.arrays import Array


def adapted(
    windows: Sequence[Window], reference: Array, changed: Array, linear: frozenset[str]
) -> Array:
    """The set ``changed`` (p,) with parameters under which the force stays that of ``reference``.

    ``linear`` names those that may follow, of the seven scales and k2, k3: they are solved for at
    the operating points of the windows.
    """
    points = np.array([window.operating_point for window in windows])
    speeds, currents = points.T
    coefficients = np.stack(
        operating_point_coefficients(reference[:SIGMOID_COUNT], speeds, currents), axis=-1
    )
    # Yield force and steepness may change sign together: the positive pair is meant.
    coefficients[coefficients[:, 0] < 0.0, :2] *= -1.0
    table = CoefficientTable(speeds, currents, coefficients, np.zeros_like(coefficients))
    sixteen, _ = fit_laws(
        table, changed[:SIGMOID_COUNT], linear, EvolutionSettings(), ProgressClock(1, None)
    )
    return np.concatenate((sixteen, changed[SIGMOID_COUNT:]))
