"""What samples determine: which parameters of a model, and how many combinations of them.

Two views. *What was varied*: a law over current needs as many different currents as it has
unknowns, a law over peak velocity at least two. *What the samples say*: the Jacobian at the
solution tells how far each parameter could move before the misfit would notice.

Everything is counted in *spans*: of a shape parameter the range in which it is plausible, of a
scale its own size. In these units the singular values of the Jacobian are the inverse standard
errors of uncorrelated combinations of the parameters. A parameter or a combination is determined
where its standard error is below a quarter of a span. See Belsley, Kuh and Welsch, "Regression
Diagnostics", 1980, chapter 3.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.estimation.covariance import (
    correlation_length,
    triangular_factor,
)
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.misfit import Misfit
from mr_damper_ros.signals.arrays import Array

_DIFFERENT_VELOCITY = 1.2
"""Peak velocities count as different where they are this factor apart."""

_DIFFERENT_CURRENT = 0.02
"""Currents [A] count as different where they are this far apart."""

_SHARES = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
"""A current that varies in a window is looked at after these parts of the way."""

SURE = 0.25
"""A shape parameter is determined where its standard error is below this part of its range."""


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


_SMALLEST_SHARE = 0.1
"""The span of a scale near zero is what would change the force by this part, not itself."""

_NEGLIGIBLE = 0.05
"""Left out of the words: what moves by less than this part of the largest move, and changes the
force by less than this part of the largest change."""

_MOST_WORDS = 5

_AS_A_PRODUCT = 0.1
"""Two parameters are known as a product, or a ratio, where their relative moves agree so far."""

_LEADS_BY = 0.1
"""Relative move of the parameter that leads, for the words."""

_BEYOND_PERCENT = 10.0
"""A relative move larger than this is told in the parameter's unit."""

_ROUNDING = 1e-10
"""A move that the samples notice less than this, of what they may notice, is one they do not."""

_PREFER_SHAPE = 1e2
"""Where a scale trades with a shape parameter, it is the shape that is said to be open; not where
the shape's part is less than a hundredth, or one direction would be told several times."""


@dataclass(frozen=True)
class Combination:
    """A direction in which parameters may move together while the force hardly changes.

    ``weights``: how far each moves, by name, in spans; the largest is 1, the first is that of the
    parameter which leads. ``standard_error``: of the move, in spans; infinite where the samples do
    not notice it at all. ``words``: what is not known, as in "f0 and k2 only as a product".
    """

    weights: Mapping[str, float]
    standard_error: float
    words: str


@dataclass(frozen=True, eq=False)
class Determination:
    """What samples determine: ``singular_values`` (p,) in 1/``spans`` (p,), largest first.

    ``rank``: combinations that are determined; ``condition``: the largest over the smallest
    singular value, infinite where the smallest is zero up to rounding; ``open``: the p - rank
    combinations that are not determined, each led by another parameter.
    """

    names: tuple[str, ...]
    spans: Array
    singular_values: Array
    rank: int
    condition: float
    open: tuple[Combination, ...]

    def partners(self, errors: Mapping[str, float]) -> dict[str, tuple[str, ...]]:
        """The parameters that have no error of their own, and those with which they are known.

        ``errors``: by name the standard errors that hold only where all else is held. A parameter
        may move by more than its own with the others of an open combination.
        """
        found: dict[str, tuple[str, ...]] = {}
        for combination in self.open:
            for name, weight in combination.weights.items():
                others = tuple(other for other in combination.weights if other != name)
                move = abs(weight) * self.spans[self.names.index(name)]
                if others and move > errors.get(name, math.inf):
                    found.setdefault(name, others)
        return found


def parameter_spans(
    model: Model, jacobian: Array, parameters: Array, ranges: Mapping[str, tuple[float, float]]
) -> Array:
    """Span (p,) of each parameter, in its own unit; see the head of this module.

    ``jacobian`` (n, p) is that of the residual at ``parameters`` (p,), ``ranges`` are those of the
    shape parameters.
    """
    lengths = np.linalg.norm(jacobian, axis=0)
    # The force is proportional to the strength of the damper.
    strength = model.strength_indices
    force = float(np.linalg.norm(jacobian[:, strength] @ parameters[strength]))
    spans = np.maximum(
        np.abs(parameters), _SMALLEST_SHARE * force / np.where(lengths > 0.0, lengths, np.inf)
    )
    for place, name in enumerate(model.parameter_names):
        if name in ranges:
            spans[place] = ranges[name][1] - ranges[name][0]
    return np.asarray(np.where(spans > 0.0, spans, 1.0))


def noise_level(misfit: Misfit, parameters: Array) -> float:
    """Standard deviation [1] of the residual that its Jacobian may be divided by.

    Correlated samples count once together, so what a law leaves of the force is not taken for
    noise that averages out.
    """
    residual = misfit.residual(parameters)
    variance = float(np.mean(residual**2)) * max(correlation_length(residual), 1)
    return math.sqrt(max(variance, 1e-300))


def determination(model: Model, jacobian: Array, spans: Array, parameters: Array) -> Determination:
    """What a Jacobian (n, p), of a residual of unit variance at ``parameters`` (p,), determines."""
    triangular = triangular_factor(jacobian) * spans
    _, values, rows = np.linalg.svd(triangular, full_matrices=True)
    names = model.parameter_names
    singular = np.zeros(len(names))
    singular[: values.size] = values
    scales = [name in model.scale_names for name in names]
    loose = singular * SURE <= 1.0
    return Determination(
        names=names,
        spans=spans,
        singular_values=singular,
        rank=int(np.sum(~loose)),
        condition=_condition(singular),
        open=_combinations(rows[loose], triangular, model, np.array(scales), (parameters, spans)),
    )


def _condition(singular: Array) -> float:
    largest, smallest = float(singular[0]), float(singular[-1])
    return largest / smallest if smallest > _ROUNDING * largest else math.inf


def _combinations(
    directions: Array,
    triangular: Array,
    model: Model,
    scales: np.ndarray,
    values_and_spans: tuple[Array, Array],
) -> tuple[Combination, ...]:
    """A basis of the span of the rows (d, p) in which each row is led by another parameter.

    Gauss-Jordan elimination, complete pivoting: singular vectors mix what has nothing to do with
    each other.
    """
    names, (values, spans) = model.parameter_names, values_and_spans
    basis = np.array(directions)
    preference = np.where(scales, 1.0, _PREFER_SHAPE)
    leads: list[int] = []
    for step in range(len(basis)):
        sizes = np.abs(basis[step:]) * preference
        sizes[:, leads] = 0.0
        row, lead = divmod(int(np.argmax(sizes)), len(names))
        basis[[step, step + row]] = basis[[step + row, step]]
        basis[step] /= basis[step, lead]
        others = np.arange(len(basis)) != step
        basis[others] -= np.outer(basis[others, lead], basis[step])
        leads.append(lead)
    largest = float(np.linalg.norm(triangular, 2))
    lengths = np.linalg.norm(triangular, axis=0)
    combinations = []
    for lead, move in sorted(zip(leads, basis, strict=True), key=lambda led: led[0]):
        move = move / np.max(np.abs(move))
        order = [lead, *(place for place in np.argsort(-np.abs(move)) if place != lead)]
        change = np.abs(move) * lengths
        told = (np.abs(move) >= _NEGLIGIBLE) | (
            change > max(_NEGLIGIBLE * change.max(), _ROUNDING * largest)
        )
        told[lead] = True
        weights = {names[k]: float(move[k]) for k in order if told[k]}
        noticed = float(np.linalg.norm(triangular @ move))
        error = 1.0 / noticed if noticed > _ROUNDING * largest else math.inf
        moves = {names[k]: (values[k], move[k] * spans[k]) for k in order if told[k]}
        combinations.append(Combination(weights, error, _words(moves, model.units)))
    return tuple(combinations)


def _words(moves: Mapping[str, tuple[float, float]], units: Mapping[str, str]) -> str:
    """What is open, for value and move of each parameter, that which leads first."""
    lead, *others = moves
    if not others:
        return lead
    relative = {name: move / value if value else math.inf for name, (value, move) in moves.items()}
    if len(others) == 1:
        ratio = relative[lead] / relative[others[0]]
        if abs(ratio + 1.0) < _AS_A_PRODUCT:
            return f"{lead} and {others[0]} only as a product"
        if abs(ratio - 1.0) < _AS_A_PRODUCT:
            return f"{lead} and {others[0]} only as a ratio"
    _, move = moves[lead]
    step = _LEADS_BY if math.isinf(relative[lead]) else _LEADS_BY / abs(relative[lead])
    # No further than anything may plausibly move: the law is linear over no more.
    step = math.copysign(min(step, 1.0), move)
    changes = [
        _change(name, step * moves[name][1], moves[name][0], units[name])
        for name in (lead, *others[:_MOST_WORDS])
    ]
    more = " and others move" if len(others) > _MOST_WORDS else ""
    listed = ", ".join(others[:-1]) + f" and {others[-1]}" if len(others) > 1 else others[0]
    together = f"{lead} and {listed}" if len(others) == 1 else f"{lead}, {listed}"
    return f"{together} only together: as {changes[0]}, {', '.join(changes[1:])}{more}"


def _change(name: str, move: float, value: float, unit: str) -> str:
    part = move / value if value else math.inf
    if abs(part) > _BEYOND_PERCENT:
        way = "rises" if move > 0.0 else "falls"
        return f"{name} {way} by {abs(move):.2g}{'' if unit == '1' else f' {unit}'}"
    # Of a negative number it is the size that grows or shrinks.
    return f"{name} {'grows' if part > 0.0 else 'shrinks'} by {100.0 * abs(part):.2g} %"
