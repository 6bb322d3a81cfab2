"""Derivatives by forward differences, for what says no more than its values."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mr_damper_ros.signals.arrays import Array

_STEP = 1e-6
"""Step of a difference, relative to the size of the parameter."""

_SMALLEST = 0.1
"""A parameter counts as no smaller than this part of its typical size."""


def moved_sets(
    parameters: Array, places: Sequence[int] | np.ndarray, sizes: Array, high: Array
) -> tuple[Array, Array]:
    """Parameters (f + 1, p) to evaluate, as they are and each of f moved, and the steps (f,).

    ``places`` are those of the f in ``parameters`` (p,), ``sizes`` their typical sizes; ``high``
    (f,) is not exceeded. With values y (f + 1, n) the derivatives are (y[1:] - y[0]).T / steps.
    """
    values = parameters[places]
    steps = _STEP * np.maximum(np.abs(values), _SMALLEST * sizes)
    steps = np.where(values + steps > high, -steps, steps)
    moved = np.tile(parameters, (values.size + 1, 1))
    moved[1 + np.arange(values.size), places] += steps
    return moved, steps
