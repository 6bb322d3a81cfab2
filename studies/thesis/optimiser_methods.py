"""The compared optimisers; each searches from a random start until the budget is spent.

A gradient counts as one evaluation per unknown. Methods with seven unknowns keep the shape
parameters of the random start.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import basinhopping, dual_annealing, least_squares

from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES
from mr_damper_ros.signals.arrays import Array
from studies.thesis import facts
from studies.thesis.runs import CycleMisfit, window
from studies.thesis.searches import STRATEGIES, evolve, fminsearch

CONDITION = "5.0mm_1Hz_1.5A"
POPULATION = 80

_LOW, _HIGH = facts.SEARCH_LOW, facts.SEARCH_HIGH
_SPAN = _HIGH - _LOW


class BudgetSpentError(Exception):
    """No further evaluation is allowed."""


class EvaluationMeter:
    """Counts evaluations of a misfit and records the best set and its evaluation number."""

    def __init__(self, misfit: CycleMisfit, budget: int) -> None:
        self.misfit = misfit
        self.budget = budget
        self.used = 0
        self.best = np.full(len(PARAMETER_NAMES), np.nan)
        self.best_cost = math.inf
        self.trace: list[tuple[int, float]] = []

    def cost(self, parameters: Array) -> float:
        """Mean square error of one set (16,), clipped to the bounds as the thesis does."""
        inside = np.clip(parameters, _LOW, _HIGH)
        value = float(self.misfit.costs(inside))
        self.note(inside, value, 1)
        return value if math.isfinite(value) else 1e300

    def costs(self, sets: Array) -> Array:
        """Mean square errors of sets (s, 16)."""
        values = self.misfit.costs(np.clip(sets, _LOW, _HIGH))
        place = int(np.nanargmin(values))
        self.note(np.clip(sets[place], _LOW, _HIGH), float(values[place]), len(values))
        return values

    def note(self, parameters: Array, cost: float, evaluations: int) -> None:
        """Count the evaluations that led to this set; raises BudgetSpentError."""
        if self.used + evaluations > self.budget:
            raise BudgetSpentError
        self.used += evaluations
        if cost < self.best_cost:
            self.best, self.best_cost = np.array(parameters), cost
            self.trace.append((self.used, cost))


Method = Callable[[EvaluationMeter, np.random.Generator], None]


def _random(rng: np.random.Generator) -> Array:
    return np.asarray(_LOW + _SPAN * rng.random(_LOW.size))


def _simplex_16(meter: EvaluationMeter, rng: np.random.Generator) -> None:
    fminsearch(lambda p: math.sqrt(meter.cost(p)), _random(rng), meter.budget)


def _least_squares_16(meter: EvaluationMeter, rng: np.random.Generator) -> None:
    misfit, root = meter.misfit, np.sqrt(meter.misfit.weight)

    def residual(p: Array) -> Array:
        values = misfit.residual(p) * root
        meter.note(p, float(values @ values) + misfit.within, 1)
        return np.asarray(values)

    def jacobian(p: Array) -> Array:
        meter.note(p, math.inf, p.size)
        return np.asarray(misfit.jacobian(p) * root[:, np.newaxis])

    start = np.clip(_random(rng), _LOW + 1e-6 * _SPAN, _HIGH - 1e-6 * _SPAN)
    least_squares(residual, start, jac=jacobian, bounds=(_LOW, _HIGH), x_scale=_SPAN)


def _phases(misfit: CycleMisfit) -> Window:
    """The averaged cycle as a window for the fit of the package."""
    sine = window(CONDITION, 0).motion.sine
    count = misfit.force.size
    motion = Motion(
        displacement=misfit.displacement,
        velocity=misfit.velocity,
        acceleration=-misfit.displacement,
        peak_velocity=np.full(count, misfit.peak_velocity),
        sine=sine,
    )
    return Window(motion, misfit.force, np.full(count, misfit.current))


def _package_fit(method: str) -> Method:
    """The window fit of the package; poor starts compete with starts estimated from the data."""

    def search(meter: EvaluationMeter, rng: np.random.Generator) -> None:
        fit = fit_window(MODELS["sigmoid"], _phases(meter.misfit), _random(rng), method=method)
        # Its scales have no bounds, and its Jacobians have seven columns.
        cost = float(meter.misfit.costs(fit.parameters))
        meter.note(fit.parameters, cost, fit.evaluations)

    return search


def _evolution(strategy: str) -> Method:
    def search(meter: EvaluationMeter, rng: np.random.Generator) -> None:
        generations = meter.budget // POPULATION
        evolve(
            meter.costs,
            _LOW,
            _HIGH,
            rng,
            strategy=strategy,
            generations=generations,
            population=POPULATION,
        )

    return search


def _cma_es(meter: EvaluationMeter, rng: np.random.Generator) -> None:
    import cma

    while True:
        start = rng.random(_LOW.size)
        options = {
            "bounds": [0.0, 1.0],
            "seed": int(rng.integers(1, 2**31)),
            "verbose": -9,
            "maxfevals": meter.budget,
        }
        search = cma.CMAEvolutionStrategy(start, 0.3, options)
        while not search.stop():
            sets = search.ask()
            costs = meter.costs(_LOW + _SPAN * np.array(sets))
            search.tell(sets, np.log(costs).tolist())


def _dual_annealing(meter: EvaluationMeter, rng: np.random.Generator) -> None:
    start = rng.random(_LOW.size)
    dual_annealing(
        lambda x: math.log(meter.cost(_LOW + _SPAN * x)),
        [(0.0, 1.0)] * _LOW.size,
        maxfun=meter.budget,
        maxiter=10**6,
        seed=int(rng.integers(2**31)),
        x0=start,
    )


def _basin_hopping(meter: EvaluationMeter, rng: np.random.Generator) -> None:
    basinhopping(
        lambda x: math.log(meter.cost(_LOW + _SPAN * x)),
        rng.random(_LOW.size),
        niter=10**6,
        stepsize=0.2,
        minimizer_kwargs={"method": "L-BFGS-B", "bounds": [(0.0, 1.0)] * _LOW.size},
        seed=int(rng.integers(2**31)),
    )


METHODS: dict[str, tuple[str, Method]] = {
    "nelder_mead_16": ("Nelder–Mead, 16 unknowns", _simplex_16),
    **{
        f"de_{number}": (f"DE {strategy}", _evolution(strategy))
        for number, strategy in enumerate(STRATEGIES)
    },
    "cma_es": ("CMA-ES", _cma_es),
    "dual_annealing": ("dual annealing", _dual_annealing),
    "basin_hopping": ("basin hopping (L-BFGS-B)", _basin_hopping),
    "least_squares_16": ("least squares, 16 unknowns", _least_squares_16),
    "nelder_mead_7": ("Nelder–Mead, 7 unknowns", _package_fit("nelder_mead")),
    "least_squares_7": ("least squares, 7 unknowns", _package_fit("least_squares")),
}


def available() -> list[str]:
    """Names of the methods that can run here: CMA-ES needs the package cma."""
    from importlib.util import find_spec

    return [name for name in METHODS if name != "cma_es" or find_spec("cma") is not None]
