"""Let what is linear in the laws follow a change of what is not."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.operating_points import CoefficientTable
from mr_damper_ros.signals.arrays import Array


def adapted(
    model: Model,
    windows: Sequence[Window],
    reference: Array,
    changed: Array,
    linear: frozenset[str],
) -> Array:
    """The set ``changed`` (p,) with parameters under which the force stays that of ``reference``.

    ``linear`` names those that may follow, of the parameters that are linear in the laws: they are
    solved for at the operating points of the windows.
    """
    speeds, currents = np.array([window.operating_point for window in windows]).T
    coefficients = model.coefficients_at(reference, speeds, currents).T
    table = CoefficientTable(speeds, currents, coefficients, np.zeros_like(coefficients))
    return model.fit_laws(table, changed, linear, no_search)


def no_search(
    cost: Callable[[Array], Array],
    bounds: Sequence[tuple[float, float]],
    start: Array,
    stage: str,
) -> Array:
    """What is not linear stays where it is; see :data:`LawSearch`."""
    return start
