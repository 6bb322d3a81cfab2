"""Observability: the parameters of a model, and their combinations, that samples determine.

There are two criteria. *Excitation*: a law over current needs as many different currents as it has
unknowns, and a law over peak velocity needs at least two peak velocities. *Information*: the
Jacobian at the solution shows how far each parameter can move without a significant increase of the
misfit.

All changes are measured in *spans*. The span of a shape parameter is its plausible range; the span
of a scale is its own size, or the change that alters the force by a tenth if that is larger. In
these units the singular values of the Jacobian are the inverse standard errors of uncorrelated
combinations of the parameters. A parameter or a combination is determined if its standard error is
below a quarter of a span. See Belsley, Kuh and Welsch,
"Regression Diagnostics", 1980, chapter 3.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.estimation.covariance import (
    DETERMINED,
    SAME_MOTION,
    group_numbers,
    noise_level,
    triangular_factor,
)
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.misfit import Misfit
from mr_damper_ros.models.quantities import CURRENT_READING, NOTICED
from mr_damper_ros.signals.arrays import Array

SURE = 0.25
"""Prior standard deviation of a shape parameter relative to its plausible range. The ends of the
range are then two standard deviations from its middle. A smaller error determines the parameter."""


def varied_parameters(
    model: Model, speeds: Sequence[float], currents: Sequence[float]
) -> frozenset[str]:
    """Names of the parameters that these peak velocities [m/s] and currents [A] could determine."""
    many_speeds = 2 if min(speeds) * (1.0 + SAME_MOTION) < max(speeds) else 1
    many_currents = group_numbers(np.sort(currents)[:, np.newaxis] / CURRENT_READING).max() + 1
    return frozenset(
        parameter.name
        for parameter in model.parameters
        if parameter.peak_velocities <= many_speeds and parameter.currents <= many_currents
    )


def parameter_ranges(model: Model, windows: Sequence[Window]) -> dict[str, tuple[float, float]]:
    """Plausible ranges of the shape parameters for the speeds and currents of the windows."""
    speeds, currents = operating_points_within(windows)
    return model.plausible_ranges(windows, max(speeds), max(map(abs, currents)))


def current_varies(window: Window) -> bool:
    """Whether the current varies within the window."""
    return float(np.ptp(window.current)) > CURRENT_READING


def operating_points_within(windows: Sequence[Window]) -> tuple[list[float], list[float]]:
    """Peak velocities and currents that the windows cover, also within one window."""
    speeds: list[float] = []
    currents: list[float] = []
    for window in windows:
        speeds += window.covered_speeds
        if current_varies(window):
            currents += window.covered_currents
        currents += [float(window.current.min()), float(window.current.max())]
    return speeds, currents


_PREFER_SHAPE = 1e2
"""Factor by which a shape parameter is preferred to a scale as the leading parameter of a
combination. With a larger factor, one direction would be reported several times."""


@dataclass(frozen=True)
class Combination:
    """A direction in which parameters may move together while the force hardly changes.

    ``weights``: move of each parameter by name in spans; the largest is 1, and the leading
    parameter comes first. ``standard_error``: standard error of this move in spans; infinite if the
    samples contain no information about it. ``words``: the uncertainty in words, for example "f0
    and k2 only as a product".
    """

    weights: Mapping[str, float]
    standard_error: float
    words: str


@dataclass(frozen=True, eq=False)
class Determination:
    """Observable combinations; ``singular_values`` (p,) in 1/``spans`` (p,), largest first.

    ``rank``: number of determined combinations; ``condition``: the largest over the smallest
    singular value, infinite if the smallest is zero up to rounding; ``open``: the p - rank
    undetermined combinations, each with a different leading parameter.
    """

    names: tuple[str, ...]
    spans: Array
    singular_values: Array
    rank: int
    condition: float
    open: tuple[Combination, ...]

    def partners(self, errors: Mapping[str, float]) -> dict[str, tuple[str, ...]]:
        """Parameters that are known only together with others, and these others.

        ``errors``: standard errors by name, valid if all other parameters are held. In an
        undetermined combination a parameter may move by more than this standard error.
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
    model: Model,
    jacobian: Array,
    parameters: Array,
    ranges: Mapping[str, tuple[float, float]],
    places: Sequence[int] | None = None,
) -> Array:
    """Span (f,) of each parameter in its own unit, as defined in the module docstring.

    ``jacobian`` (n, f): derivatives of the residual at ``parameters`` (p,) with respect to those at
    ``places``, by default all; ``ranges``: plausible ranges of the shape parameters.
    """
    chosen = np.arange(parameters.size) if places is None else np.asarray(places)
    lengths, values = np.linalg.norm(jacobian, axis=0), parameters[chosen]
    # The force is proportional to the gain parameters together.
    strong = np.isin(chosen, model.strength_indices)
    force = float(np.linalg.norm(jacobian[:, strong] @ values[strong]))
    spans = np.maximum(np.abs(values), NOTICED * force / np.where(lengths > 0.0, lengths, np.inf))
    for k, place in enumerate(chosen.tolist()):
        if (name := model.parameter_names[place]) in ranges:
            spans[k] = ranges[name][1] - ranges[name][0]
    return np.asarray(np.where(spans > 0.0, spans, 1.0))


def determination_of(misfit: Misfit, windows: Sequence[Window], parameters: Array) -> Determination:
    """The combinations of parameters that windows determine, linearised about a set (p,).

    ``misfit`` may hold thinned windows, which may lack the extremes of ``windows``.
    """
    model = misfit.model
    jacobian = misfit.jacobian(parameters) / noise_level(misfit.residual(parameters))
    spans = parameter_spans(model, jacobian, parameters, parameter_ranges(model, windows))
    return determination(model, jacobian, spans, parameters)


def determination(model: Model, jacobian: Array, spans: Array, parameters: Array) -> Determination:
    """Determined combinations for a Jacobian (n, p) of a residual of unit variance."""
    triangular = triangular_factor(jacobian) * spans
    _, values, rows = np.linalg.svd(triangular, full_matrices=True)
    names = model.parameter_names
    singular = np.zeros(len(names))
    singular[: values.size] = values
    loose = singular * SURE <= 1.0
    largest, smallest = float(singular[0]), float(singular[-1])
    return Determination(
        names=names,
        spans=spans,
        singular_values=singular,
        rank=int(np.sum(~loose)),
        condition=largest / smallest if smallest > DETERMINED * largest else math.inf,
        open=_combinations(model, rows[loose], triangular, parameters, spans),
    )


def _combinations(
    model: Model, directions: Array, triangular: Array, values: Array, spans: Array
) -> tuple[Combination, ...]:
    """A basis of the rows (d, p) in which each vector has a different leading parameter.

    It is computed by Gauss-Jordan elimination with complete pivoting, because singular vectors
    would mix unrelated parameters.
    """
    names, basis = model.parameter_names, np.array(directions)
    preference = np.where(np.isin(names, model.scale_names), 1.0, _PREFER_SHAPE)
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
        # A message omits moves, and changes of the force, that are small beside the largest.
        told = (np.abs(move) >= NOTICED) | (
            change > max(NOTICED * change.max(), DETERMINED * largest)
        )
        told[lead] = True
        weights = {names[k]: float(move[k]) for k in order if told[k]}
        noticed = float(np.linalg.norm(triangular @ move))
        error = 1.0 / noticed if noticed > DETERMINED * largest else math.inf
        moves = {names[k]: (values[k], move[k] * spans[k]) for k in order if told[k]}
        combinations.append(Combination(weights, error, _words(moves, model.units)))
    return tuple(combinations)


def _words(moves: Mapping[str, tuple[float, float]], units: Mapping[str, str]) -> str:
    """The uncertainty in words, from (value, move) of each parameter, the leading one first.

    Two parameters are known only as a product or a ratio if their relative moves agree within
    :data:`NOTICED`. The text describes a relative move of the leading one by the same part.
    """
    lead, *others = moves
    if not others:
        return lead
    relative = {name: move / value if value else math.inf for name, (value, move) in moves.items()}
    if len(others) == 1:
        ratio = relative[lead] / relative[others[0]]
        if abs(ratio + 1.0) < NOTICED:
            return f"{lead} and {others[0]} only as a product"
        if abs(ratio - 1.0) < NOTICED:
            return f"{lead} and {others[0]} only as a ratio"
    _, move = moves[lead]
    step = NOTICED if math.isinf(relative[lead]) else NOTICED / abs(relative[lead])
    # The linearisation does not hold beyond the plausible range, so the move is limited to it.
    step = math.copysign(min(step, 1.0), move)
    changes = [
        _change(name, step * moves[name][1], moves[name][0], units[name])
        for name in (lead, *others)
    ]
    listed = ", ".join(others[:-1]) + f" and {others[-1]}" if len(others) > 1 else others[0]
    together = f"{lead} and {listed}" if len(others) == 1 else f"{lead}, {listed}"
    return f"{together} only together: as {changes[0]}, {', '.join(changes[1:])}"


def _change(name: str, move: float, value: float, unit: str) -> str:
    part = move / value if value else math.inf
    if abs(part) > 1.0:
        way = "rises" if move > 0.0 else "falls"
        return f"{name} {way} by {abs(move):.2g}{'' if unit == '1' else f' {unit}'}"
    # For a negative value, growth means a larger magnitude.
    return f"{name} {'grows' if part > 0.0 else 'shrinks'} by {100.0 * abs(part):.2g} %"
