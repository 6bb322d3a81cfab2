"""How well the force of a damper is known over a range of peak velocity and current.

The law is linearised about a parameter set: the Fisher information of the samples, with what is
plausible of any damper as prior information, gives the covariance of the parameters, and that the
standard error of the force at every phase of a cycle. What the data leave open counts by as much as
it matters for the force, and no more: a parameter that nobody can see hardly does.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mr_damper_ros.estimation.covariance import correlation_length
from mr_damper_ros.estimation.global_search import adapted
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.misfit import Misfit
from mr_damper_ros.signals.arrays import Array

PHASES = 64
"""Samples of the cycle that stands for an operating point."""

FEW = 256
"""So many samples of a window tell what all of them determine."""

_MOST_STEPS = 40
"""Of the search for the most probable parameters, which begins near them."""

_REPETITIONS = 15
"""Identifications again, to tell an error where a covariance may not."""

_DRAWS = 200
"""Draws from what is plausible, of which the prior is made, and from what may be true."""

_SMALLEST_SHARE = 0.1
"""A scale parameter may be wrong by itself, and by what makes this part of the force."""

_ROUNDING = 1e-15
"""Eigenvalues of a balanced matrix are not known better, relative to the largest."""

_LEAST_CURRENT = 1e-6
"""A range of no current is as wide as this [A]: shapes are drawn relative to it."""

_AMPLITUDE = 0.01
"""Amplitude [m] of the cycles of a goal, unless it says another."""


@dataclass(frozen=True)
class ForceGoal:
    """The force, to this relative standard ``error`` at the worst point, over these ranges.

    ``peak_velocity`` [m/s] and ``current`` [A] are pairs (low, high); the error is relative to the
    largest force of the cycle at the same point. The force is looked at in cycles of ``amplitude``
    [m].

    Raises ValueError for a goal that cannot be meant.
    """

    error: float
    peak_velocity: tuple[float, float]
    current: tuple[float, float]
    amplitude: float = _AMPLITUDE
    speeds: int = 5
    currents: int = 6

    def __post_init__(self) -> None:
        if not 0.0 < self.error < 1.0:
            raise ValueError(
                f"the error to be reached is {self.error}: give a part of the force between 0 and 1"
            )
        low, high = self.peak_velocity
        if not 0.0 < low <= high < math.inf:
            raise ValueError(
                f"the peak velocities of the goal are {low:g} to {high:g} m/s: they must be "
                "positive, the lower first"
            )
        low, high = self.current
        if not 0.0 <= low <= high < math.inf:
            raise ValueError(
                f"the currents of the goal are {low:g} to {high:g} A: none may be negative, the "
                "lower comes first"
            )

    @property
    def points(self) -> list[tuple[float, float]]:
        """Operating points (m/s, A) all over the range."""
        speeds = np.unique(np.geomspace(*self.peak_velocity, self.speeds))
        currents = np.unique(np.linspace(*self.current, self.currents))
        return [(v, i) for v in speeds.tolist() for i in currents.tolist()]

    def cycles(self) -> list[Window]:
        """A cycle at each point; its force plays no part."""
        return [
            steady_cycle(self.amplitude, v / (2.0 * math.pi * self.amplitude), i)
            for v, i in self.points
        ]


def steady_cycle(amplitude: float, frequency: float, current: float) -> Window:
    """One cycle of a sine [m], [Hz] at a current [A]; without a force."""
    period = 1.0 / (frequency * PHASES)
    # Half a sample off the reversals, where the sign of the acceleration is a matter of rounding.
    phase = 2.0 * math.pi * (np.arange(PHASES) + 0.5) / PHASES
    return Window.from_samples(amplitude * np.sin(phase), np.zeros(PHASES), current, period)


class Cycles:
    """The force over many cycles at once, and its gradient, of any set of a model."""

    def __init__(self, model: Model, cycles: Sequence[Window]) -> None:
        self.count = len(cycles)
        self._problem = Misfit(model, cycles, [1.0] * len(cycles))

    def force(self, parameters: Array) -> Array:
        """Force (k, phases) [N]."""
        # That of the cycles is zero, so that the residual is the force of the set.
        return self._problem.residual(parameters).reshape(self.count, PHASES)

    def gradient(self, parameters: Array) -> Array:
        """Derivatives (k, phases, p) of the force by the parameters."""
        return self._problem.jacobian(parameters).reshape(self.count, PHASES, parameters.size)


@dataclass(frozen=True, eq=False)
class PointErrors:
    """Relative standard error (k,) of the force at each point, the largest of its cycle.

    ``worst`` is the worst error at all points and phases together that is as likely exceeded as
    not. Where the errors at many points are independent it is larger than any of the standard
    errors: somewhere chance is against one. Where one direction of the parameters dominates, all
    points err together, and it is the median of one error, down to 0.67 of the largest.
    ``bound`` is the worst error that is exceeded in one of twenty cases; NaN = unknown. Both hold
    as far as the damper obeys the law.
    """

    points: Sequence[tuple[float, float]]
    errors: Array
    worst: float
    bound: float = math.nan

    @property
    def sentence(self) -> str:
        """How well the force is known, and with what confidence."""
        if math.isnan(self.bound):
            return f"{self.worst:.2%} at worst, at even odds"
        return f"{self.worst:.2%} at worst, at even odds, and {self.bound:.2%} with 95 % confidence"

    @property
    def worst_point(self) -> tuple[float, float]:
        """Where the standard error is largest (m/s, A)."""
        return self.points[int(np.argmax(self.errors))]


def relative_gradient(cycles: Cycles, parameters: Array) -> Array:
    """Derivatives (k, phases, p) of the force relative to the largest of each cycle."""
    largest = np.max(np.abs(cycles.force(parameters)), axis=1)
    return cycles.gradient(parameters) / np.maximum(largest, 1e-9)[:, None, None]


def point_errors(goal: ForceGoal, gradient: Array, information: Array) -> PointErrors:
    """Errors at the points of a goal; ``gradient`` (k, phases, p) is relative.

    ``information`` (p, p) includes the prior.
    """
    flat = gradient.reshape(-1, gradient.shape[-1])
    draws = np.random.default_rng(0).standard_normal((_DRAWS, flat.shape[1]))
    scale = 1.0 / np.sqrt(np.diagonal(information))
    # Rounding may take a little from what is hardly known, so that no Cholesky factor exists.
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    root = vectors / np.sqrt(np.maximum(values, _ROUNDING * values[-1]))
    missed = np.abs((draws @ root.T * scale) @ flat.T)
    worst, bound = np.quantile(np.max(missed, axis=1), [0.5, 0.95]).tolist()
    return PointErrors(goal.points, cycle_errors(gradient, information[None])[0], worst, bound)


def cycle_errors(gradient: Array, information: Array) -> Array:
    """Largest standard error of each cycle (m, k), for many informations (m, p, p).

    ``gradient`` (k, phases, p) may be relative; so are the errors then.
    """
    count, phases, size = gradient.shape
    flat = gradient.reshape(-1, size)
    # Units differ by many orders of magnitude.
    scale = 1.0 / np.sqrt(np.diagonal(information, axis1=-2, axis2=-1))
    balanced = information * scale[:, :, None] * scale[:, None, :]
    inverse = np.linalg.inv(balanced) * scale[:, :, None] * scale[:, None, :]
    variance = np.sum((flat @ inverse) * flat, axis=-1)
    errors = np.sqrt(np.maximum(variance, 0.0)).reshape(-1, count, phases)
    return np.asarray(errors.max(axis=-1))


def prior_information(model: Model, cycles: Cycles, parameters: Array, goal: ForceGoal) -> Array:
    """What is known (p, p) of any damper before the first run, about ``parameters`` (p,).

    Shape parameters scatter as plausible ones do; a scale parameter may be wrong by all of itself,
    and by what makes a tenth of the force.
    """
    rng = np.random.default_rng(0)
    top_current = max(goal.current[1], _LEAST_CURRENT)
    draws = [model.draw_shape(rng, goal.peak_velocity[1], top_current) for _ in range(_DRAWS)]
    gradient = cycles.gradient(parameters).reshape(-1, parameters.size)
    force = float(np.sqrt(np.mean(cycles.force(parameters) ** 2)))
    lengths = np.sqrt(np.mean(gradient**2, axis=0))
    deviations = np.maximum(
        np.abs(parameters), _SMALLEST_SHARE * force / np.where(lengths > 0.0, lengths, np.inf)
    )
    for place, name in enumerate(model.parameter_names):
        if name in draws[0]:
            values = np.array([draw[name] for draw in draws])
            # The set may lie where no draw does: it may be wrong by all the way to them.
            deviations[place] = math.hypot(
                float(np.std(values)), float(np.mean(values)) - parameters[place]
            )
    return np.diag(1.0 / np.maximum(deviations, 1e-12) ** 2)


def open_sets(
    model: Model,
    windows: Sequence[Window],
    parameters: Array,
    known: Collection[str],
    top: tuple[float, float],
    rng: np.random.Generator,
    count: int,
) -> list[Array]:
    """Sets (p,) that agree with the windows and differ in the shape parameters not ``known``.

    What is linear in the laws follows from the coefficients that the windows have. ``top``: peak
    velocity [m/s] and current [A] of the range. None where no shape is open.
    """
    unknown = set(model.shape_names).difference(known)
    solved = frozenset(model.linear) - unknown
    sets = []
    for _ in range(count if unknown else 0):
        values = np.array(parameters)
        for name, value in model.draw_shape(rng, top[0], max(top[1], _LEAST_CURRENT)).items():
            if name in unknown:
                values[model.parameter_names.index(name)] = value
        sets.append(adapted(model, windows, parameters, values, solved))
    return sets


def window_information(
    model: Model, windows: Iterable[Window], noise: Iterable[float], parameters: Array
) -> Array:
    """Fisher information (p, p) of the samples of windows, with ``noise`` [N] each."""
    total = np.zeros((parameters.size, parameters.size))
    for window, sigma in zip(windows, noise, strict=True):
        few = window.thinned(FEW)
        jacobian = Misfit(model, [few], [sigma]).jacobian(parameters)
        total += (window.sample_count / few.sample_count) * (jacobian.T @ jacobian)
    return total


def most_probable(
    model: Model,
    windows: Sequence[Window],
    noise: Sequence[float],
    prior: Array,
    about: Array,
    start: Array | None = None,
) -> tuple[Array, float]:
    """The most probable parameters (p,), and half of what speaks against them.

    All parameters are free, ``about`` (p,) with the information ``prior`` (p, p, diagonal): what
    the data tell little of moves as far as they tell, and what they do not tell stays. A search
    that holds what it cannot determine well would be wrong by more than it claims. It begins at
    ``start`` (p,), or ``about``.
    """
    from scipy.optimize import least_squares

    problems = [
        Misfit(model, [window], [sigma]) for window, sigma in zip(windows, noise, strict=True)
    ]
    weight = np.sqrt(np.diagonal(prior))

    def residual(values: Array) -> Array:
        parts = [problem.residual(values) for problem in problems]
        return np.concatenate([*parts, weight * (values - about)])

    def jacobian(values: Array) -> Array:
        parts = [problem.jacobian(values) for problem in problems]
        return np.concatenate([*parts, np.diag(weight)])

    low, high = model.bounds
    inside = np.clip(
        about if start is None else start, np.nextafter(low, np.inf), np.nextafter(high, -np.inf)
    )
    found = least_squares(
        residual, inside, jacobian, (low, high), x_scale=1.0 / weight, max_nfev=_MOST_STEPS
    )
    return np.asarray(found.x), float(found.cost)


def repeated_error(
    model: Model,
    windows: Sequence[Window],
    noise: Sequence[float],
    prior: Array,
    parameters: Array,
    cycles: Cycles,
) -> float:
    """Worst relative error of the force that is as likely exceeded as not, by identifying again.

    Windows with the force of ``parameters`` (p,) and new noise are identified, so that it holds
    where the law bends too much for a covariance: a parametric bootstrap (Efron and Tibshirani,
    "An introduction to the bootstrap", 1993). A few samples with less noise stand for all.
    """
    rng = np.random.default_rng(0)
    few = [window.thinned(FEW) for window in windows]
    sizes = [
        sigma * math.sqrt(f.sample_count / w.sample_count)
        for f, w, sigma in zip(few, windows, noise, strict=True)
    ]
    forces = [model.window_force(window, parameters) for window in few]
    deviations = 1.0 / np.sqrt(np.diagonal(prior))
    low, high = model.bounds
    true = cycles.force(parameters)
    largest = np.max(np.abs(true), axis=1, keepdims=True)
    worst = []
    for _ in range(_REPETITIONS):
        again = [
            replace(window, force=force + sigma * rng.standard_normal(force.size))
            for window, force, sigma in zip(few, forces, sizes, strict=True)
        ]
        about = np.clip(parameters + deviations * rng.standard_normal(parameters.size), low, high)
        found, _ = most_probable(model, again, sizes, prior, about, parameters)
        worst.append(float(np.max(np.abs(cycles.force(found) - true) / largest)))
    return float(np.median(worst))


def noise_of(model: Model, window: Window, parameters: Array) -> float:
    """Standard deviation [N] of white noise that would hide as much as what the set leaves does.

    What a law leaves that repeats is no noise that averages out: correlated samples count once.
    """
    residual = model.window_force(window, parameters) - window.force
    length = max(correlation_length(residual), 1)
    return max(math.sqrt(float(np.mean(residual**2)) * length), 1e-9)
