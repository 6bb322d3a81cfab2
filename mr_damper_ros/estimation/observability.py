"""Which parameters of a model the data determine.

Two views. *What was varied*: a law over current needs as many different currents as it has
unknowns, a law over peak velocity at least two. *What the samples say*: the Jacobian at the
solution tells how far each parameter could move before the misfit would notice. A parameter is
observable where both agree; the others keep the value of the start and have no standard error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mr_damper_ros.estimation.covariance import least_squares_covariance, triangular_factor
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.operating_points import PooledProblem
from mr_damper_ros.signals.arrays import Array

_DIFFERENT_VELOCITY = 1.2
"""Peak velocities count as different where they are this factor apart."""

_DIFFERENT_CURRENT = 0.02
"""Currents [A] count as different where they are this far apart."""

_SHARES = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
"""A current that varies in a window is looked at after these parts of the way."""

SURE = 0.25
"""A shape parameter is determined where its standard error is below this part of its range."""

_NOTICED = 0.1
"""A scale near zero is known as far as it cannot change the force by this part."""

_TRADES = 0.7
"""Two parameters whose correlation is beyond this trade with each other."""

_INDEPENDENT = 1e-4
"""A column of the Jacobian is independent where this part of it is orthogonal to the others."""


def varied_parameters(
    model: Model, speeds: Sequence[float], currents: Sequence[float]
) -> frozenset[str]:
    """Names of the parameters that these peak velocities [m/s] and currents [A] could determine."""
    many_speeds = 2 if min(speeds) * _DIFFERENT_VELOCITY < max(speeds) else 1
    many_currents = _count_different(currents)
    return frozenset(
        parameter.name
        for parameter in model.parameters
        if parameter.peak_velocities <= many_speeds and parameter.currents <= max(many_currents, 1)
    )


def parameter_ranges(model: Model, windows: Sequence[Window]) -> dict[str, tuple[float, float]]:
    """Plausible ranges of the parameters that are no scales, from what the windows span."""
    speeds, _ = operating_points_within(windows)
    top_current = max(float(np.max(np.abs(window.current))) for window in windows)
    return model.plausible_ranges(windows, max(speeds), top_current)


def current_varies(window: Window) -> bool:
    """Whether the current takes different values within the window."""
    return float(np.ptp(window.current)) > _DIFFERENT_CURRENT


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
        if current_varies(window):
            order = np.argsort(window.current)
            travelled = np.cumsum(np.abs(window.motion.velocity[order]))
            places = np.searchsorted(travelled, _SHARES * travelled[-1])
            currents += window.current[order[np.minimum(places, order.size - 1)]].tolist()
        currents += [float(window.current.min()), float(window.current.max())]
    return speeds, currents


def _count_different(currents: Sequence[float]) -> int:
    count, last = 0, -np.inf
    for current in sorted(currents):
        if current - last > _DIFFERENT_CURRENT:
            count, last = count + 1, current
    return count


def determined_parameters(
    model: Model, jacobian: Array, candidates: frozenset[str], ranges: dict[str, float]
) -> frozenset[str]:
    """Those of the candidates that the samples determine.

    ``jacobian`` (n, p) belongs to a residual of unit variance; ``ranges`` are those of the
    parameters that are no scales. The scales come first; another joins, the surest first, while no
    standard error exceeds a quarter of its range.
    """
    triangular = triangular_factor(jacobian)
    present = [name for name in model.parameter_names if name in candidates]
    places = {name: place for place, name in enumerate(model.parameter_names)}
    chosen = [
        name for name in present if name in model.scale_names and np.any(jacobian[:, places[name]])
    ]
    waiting = [name for name in present if name in ranges and name not in chosen]
    while waiting:
        doubts = {
            name: _worst_doubt(triangular, places, [*chosen, name], ranges) for name in waiting
        }
        surest = min(waiting, key=lambda name: doubts[name])
        if not doubts[surest] < SURE:
            break
        chosen.append(surest)
        waiting.remove(surest)
    return frozenset(chosen)


def not_known(
    model: Model,
    misfit: PooledProblem,
    parameters: Array,
    free: frozenset[str],
    ranges: Mapping[str, float],
) -> list[str]:
    """The free parameter of a finished fit that is least known, if it is not; none where all are.

    A shape parameter is known where its error is below a quarter of its range, or of its size where
    that is larger; a scale where it is below its size or below what changes the force by a tenth.
    Where it trades with shape parameters, it is known once one of them is held: these come first,
    or after it if it is a shape parameter itself, the closest first.
    """
    places = [place for place, name in enumerate(model.parameter_names) if name in free]
    names = [model.parameter_names[place] for place in places]
    values = parameters[places]
    jacobian = misfit.jacobian(parameters, places)
    residual = misfit.residual(parameters)
    covariance = least_squares_covariance(jacobian, residual, prior=misfit.prior)
    errors = np.sqrt(np.diag(covariance))
    lengths = np.linalg.norm(jacobian, axis=0)
    strong = np.isin(places, model.strength_indices)
    noticed = _NOTICED * float(np.linalg.norm(jacobian[:, strong] @ values[strong]))
    uses = np.maximum(np.abs(values), noticed / np.where(lengths > 0.0, lengths, np.inf))
    shapes = np.array([name in ranges for name in names])
    plausible = np.array([ranges.get(name, 0.0) for name in names])
    uses = np.where(shapes, SURE * np.maximum(plausible, np.abs(values)), uses)
    doubts = np.nan_to_num(errors / np.where(uses > 0.0, uses, 1e-300), nan=np.inf)
    worst = int(np.argmax(doubts))
    if doubts[worst] < 1.0:
        return []
    trades = np.nan_to_num(np.abs(covariance[worst]) / (errors * errors[worst]))
    others = [
        int(place)
        for place in np.argsort(-trades)
        if shapes[place] and place != worst and trades[place] > _TRADES
    ]
    ordered = [worst, *others] if shapes[worst] else [*others, worst]
    return [names[place] for place in ordered]


def _worst_doubt(
    triangular: Array, places: Mapping[str, int], names: list[str], ranges: Mapping[str, float]
) -> float:
    """Largest standard error over range among those in ``names`` that have a range."""
    errors = standard_errors(triangular[:, [places[name] for name in names]], names)
    return max((errors[name] / ranges[name] for name in names if name in ranges), default=0.0)


def standard_errors(columns: Array, names: Sequence[str]) -> dict[str, float]:
    """Standard errors of the named parameters, the others being given; infinite if undetermined.

    ``columns`` (r, len(names)): theirs of factor R of the Jacobian of a residual of unit variance.
    """
    lengths = np.linalg.norm(columns, axis=0)
    if not np.all(lengths > 0.0):
        return dict.fromkeys(names, np.inf)
    _, singular, vt = np.linalg.svd(columns / lengths, full_matrices=False)
    if singular[-1] < _INDEPENDENT * singular[0] or len(singular) < len(names):
        return dict.fromkeys(names, np.inf)
    errors = np.sqrt(np.sum((vt.T / singular) ** 2, axis=1)) / lengths
    return dict(zip(names, errors.tolist(), strict=True))
