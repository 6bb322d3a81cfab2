"""The searches of the thesis over all sixteen parameters.

They are Nelder-Mead as in MATLAB's fminsearch (thesis appendix D), and differential evolution that
evaluates a whole generation at once (Storn and Price, Journal of Global Optimization 11, 1997;
thesis 2.7.2). Trial values beyond a bound are clipped to it; SciPy draws them anew. Tables 10 and
11 show that the thesis clipped: the variances of nine parameters exceed that of a uniform
distribution over the whole range, so most results lie on the bounds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

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
    most = 200 * start.size if evaluations is None else evaluations
    options = {"xatol": 1e-4, "fatol": 1e-4, "maxfev": most, "maxiter": most}
    result = minimize(
        cost, start, method="Nelder-Mead", options={"initial_simplex": simplex, **options}
    )
    return np.asarray(result.x), float(result.fun), int(result.nfev)


STRATEGIES = ("rand/1", "best/1", "rand-to-best/2", "rand/2")
"""Mutation schemes by the names of the thesis' table 3."""

_MUTATION, _RECOMBINATION = 0.8, 0.8
"""Factor on differences F, and the probability CR that a value is the mutant's; thesis 2.7.2."""


class Evolved(NamedTuple):
    """Best individual (p,), its cost, the evaluations spent."""

    best: Array
    cost: float
    evaluations: int


def evolve(
    cost: Callable[[Array], Array],
    low: Array,
    high: Array,
    rng: np.random.Generator,
    *,
    strategy: str = "rand/1",
    generations: int = 500,
    population: int = 160,
) -> Evolved:
    """Minimise ``cost``, which takes sets of shape (s, p) and returns (s,), within (p,) bounds.

    Raises ValueError for an unknown strategy or a population below six.
    """
    if strategy not in STRATEGIES:
        raise ValueError(f"strategy '{strategy}' is unknown: use one of {', '.join(STRATEGIES)}")
    if population < 6:
        raise ValueError(f"the population is {population}: at least 6 are needed")
    people = low + (high - low) * rng.random((population, low.size))
    costs = _finite(cost(people))
    for _ in range(generations):
        mutants = _mutants(people, people[np.argmin(costs)], strategy, rng)
        crossed = rng.random(people.shape) < _RECOMBINATION
        crossed[np.arange(population), rng.integers(low.size, size=population)] = True
        trials = np.clip(np.where(crossed, mutants, people), low, high)
        trial_costs = _finite(cost(trials))
        better = trial_costs <= costs
        people[better] = trials[better]
        costs[better] = trial_costs[better]
    place = int(np.argmin(costs))
    return Evolved(people[place].copy(), float(costs[place]), population * (generations + 1))


def _finite(costs: Array) -> Array:
    return np.nan_to_num(costs, nan=1e300, posinf=1e300)


def _mutants(people: Array, best: Array, strategy: str, rng: np.random.Generator) -> Array:
    """Mutants (s, p); partners are drawn by rotating a permutation, so they differ."""
    count = people.shape[0]
    order = rng.permutation(count)
    turns = rng.choice(np.arange(1, count), size=4, replace=False)
    one, two, three, four, five = (people[np.roll(order, turn)] for turn in (0, *turns))
    if strategy == "rand/1":
        return np.asarray(one + _MUTATION * (two - three))
    if strategy == "best/1":
        return np.asarray(best + _MUTATION * (one - two))
    if strategy == "rand-to-best/2":
        return np.asarray(people + _MUTATION * (best - people + one - two))
    return np.asarray(one + _MUTATION * (two - three + four - five))
