"""Which of the sixteen parameters the data determine.

Two views. *What was varied*: a law over current needs as many different currents as it has
unknowns, a law over peak velocity at least two. *What the samples say*: the Jacobian at the
solution tells how far each parameter could move before the misfit would notice. A parameter is
observable where both agree; the others keep the value of the start and have no standard error.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mr_damper_ros.estimation.covariance import triangular_factor
from mr_damper_ros.models.sigmoid.extension import EXTENDED_NAMES
from mr_damper_ros.models.sigmoid.law import SCALE_PARAMETER_NAMES
from mr_damper_ros.models.sigmoid.scale_misfit import Window
from mr_damper_ros.signals.arrays import Array

VELOCITY_SHAPE = ("a1", "k0", "a4")
"""They need two peak velocities."""

CURRENT_SHAPE = (("k2", "k3"), ("a2", "a3"), ("I0", "I1"))
"""They need two, three and four currents."""

_DIFFERENT_VELOCITY = 1.2
"""Peak velocities count as different where they are this factor apart."""

_DIFFERENT_CURRENT = 0.02
"""Currents [A] count as different where they are this far apart."""

SURE = 0.25
"""A shape parameter is determined where its standard error is below this part of its range."""

_INDEPENDENT = 1e-4
"""A column of the Jacobian is independent where this part of it is orthogonal to the others."""


def varied_parameters(speeds: Sequence[float], currents: Sequence[float]) -> frozenset[str]:
    """Names of the parameters that these peak velocities [m/s] and currents [A] could determine."""
    names = set(SCALE_PARAMETER_NAMES)
    if min(speeds) * _DIFFERENT_VELOCITY < max(speeds):
        names.update(VELOCITY_SHAPE)
    different = _count_different(currents)
    for needed, group in enumerate(CURRENT_SHAPE, start=2):
        if different >= needed:
            names.update(group)
    return frozenset(names)


def operating_points_within(windows: Sequence[Window]) -> tuple[list[float], list[float]]:
    """Peak velocities and currents that the windows pass through, also within one window."""
    speeds: list[float] = []
    currents: list[float] = []
    for window in windows:
        peak_velocity = window.motion.peak_velocity
        order = np.argsort(peak_velocity)
        # Rests count for nothing: the samples are weighted by speed.
        travelled = np.cumsum(np.abs(window.motion.velocity[order]))
        places = np.searchsorted(travelled, np.array([0.1, 0.5, 0.9]) * travelled[-1])
        speeds += peak_velocity[order[np.minimum(places, order.size - 1)]].tolist()
        currents += [float(window.current.min()), float(window.current.max())]
    return speeds, currents


def _count_different(currents: Sequence[float]) -> int:
    count, last = 0, -np.inf
    for current in sorted(currents):
        if current - last > _DIFFERENT_CURRENT:
            count, last = count + 1, current
    return count


def determined_parameters(
    jacobian: Array, candidates: frozenset[str], ranges: dict[str, float]
) -> frozenset[str]:
    """Those of the candidates that the samples determine.

    ``jacobian`` (n, 16) or (n, 19) belongs to a residual of unit variance; ``ranges`` are the
    plausible ranges of the shape parameters and of those of the extension. Scale parameters come
    first; another joins, the surest first, while no standard error exceeds a quarter of its range.
    """
    triangular = triangular_factor(jacobian)
    present = EXTENDED_NAMES[: jacobian.shape[1]]
    chosen = [
        name
        for name in present
        if name in SCALE_PARAMETER_NAMES and name in candidates and np.any(_column(jacobian, name))
    ]
    waiting = [name for name in present if name in candidates and name in ranges]
    while waiting:
        doubts = {name: _worst_doubt(triangular, [*chosen, name], ranges) for name in waiting}
        surest = min(waiting, key=lambda name: doubts[name])
        if not doubts[surest] < SURE:
            break
        chosen.append(surest)
        waiting.remove(surest)
    return frozenset(chosen)


def _column(jacobian: Array, name: str) -> Array:
    return np.asarray(jacobian[:, EXTENDED_NAMES.index(name)])


def _worst_doubt(triangular: Array, names: list[str], ranges: dict[str, float]) -> float:
    """Largest standard error over range among the shape parameters in ``names``."""
    errors = standard_errors(triangular, names)
    return max((errors[name] / ranges[name] for name in names if name in ranges), default=0.0)


def standard_errors(triangular: Array, names: Sequence[str]) -> dict[str, float]:
    """Standard errors of the named parameters, the others being given; infinite if undetermined.

    ``triangular`` (r, p): factor R of the Jacobian of a residual of unit variance.
    """
    columns = np.column_stack([_column(triangular, name) for name in names])
    lengths = np.linalg.norm(columns, axis=0)
    if not np.all(lengths > 0.0):
        return dict.fromkeys(names, np.inf)
    _, singular, vt = np.linalg.svd(columns / lengths, full_matrices=False)
    if singular[-1] < _INDEPENDENT * singular[0] or len(singular) < len(names):
        return dict.fromkeys(names, np.inf)
    errors = np.sqrt(np.sum((vt.T / singular) ** 2, axis=1)) / lengths
    return dict(zip(names, errors.tolist(), strict=True))
