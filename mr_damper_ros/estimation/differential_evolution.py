"""Differential evolution (Storn and Price, 1997) by SciPy, with progress, seed and early stop."""

from __future__ import annotations

import inspect
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.processes.worker import LONGEST_PAUSE
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import Array

STRATEGIES = ("rand1bin", "best1bin", "currenttobest1bin", "rand2bin")
"""SciPy's names of the four schemes in table 3 of the thesis, all with binomial crossover: rand/1;
best/1; x + F (x_best - x + x_1 - x_2), there called rand-to-best/2; rand/2."""

_WORST = 0.1 * math.sqrt(np.finfo(float).max)  # SciPy squares the value


@dataclass(frozen=True)
class EvolutionSettings(CheckedSettings):
    """Settings of differential evolution; the defaults follow the thesis (2.7.2 and 4.6).

    Raises ValueError for values out of range.
    """

    strategy: str = option(
        "rand1bin",
        "Mutation strategy, as SciPy calls it: rand1bin, best1bin, currenttobest1bin or rand2bin.",
        choices=STRATEGIES,
    )
    mutation: float = option(
        0.8, "Differential weight F, between 0 and 2: the step length.", within=(0.01, 1.99)
    )
    recombination: float = option(
        0.8,
        "Crossover probability CR, between 0 and 1: the expected fraction of an individual that "
        "is replaced at once.",
        within=(0.0, 1.0),
    )
    generations: int = option(
        500,
        "Maximum number of generations; the search ends earlier if the population has converged.",
        within=(1, 1_000_000),
    )
    population: int = option(15, "Individuals per unknown parameter.", within=(5, 1000))
    seed: int = option(
        0,
        "Seed of the random numbers; the same seed and data give the same result.",
        within=(0, 2**32 - 1),
    )


@dataclass(frozen=True)
class GlobalProgress:
    """Progress of a long search; ``best_cost`` [1] is the best cost in the present ``stage``.

    ``time_left`` [s] is the estimated remaining time of the whole search. Both are NaN if unknown.
    """

    stage: str
    generation: int
    generations: int
    best_cost: float
    time_left: float


Report = Callable[[GlobalProgress], bool]
"""Callback for progress; returning False stops the search, which then returns the best result."""


class ProgressClock:
    """Counts generations over the stages of a search and estimates the remaining time."""

    def __init__(self, generations: int, report: Report | None) -> None:
        self._total = max(generations, 1)
        self._done = 0
        self._report = report
        self._last_report = self._began = time.monotonic()
        self._stage = ""
        self._evolved = 0
        self._pace = math.nan
        self.stopped = False

    def expect(self, generations: int) -> None:
        """Set the expected number of remaining generations."""
        self._total = max(self._done + generations, 1)

    def tick(self, stage: str, best_cost: float) -> None:
        """Count one generation; the pace is that of the present stage, without its first one."""
        self._done += 1
        if not self._begins(stage):
            self._evolved += 1
            self._pace = (time.monotonic() - self._began) / self._evolved
        self._tell(stage, best_cost)

    def _begins(self, stage: str) -> bool:
        if stage == self._stage:
            return False
        self._stage, self._began, self._evolved = stage, time.monotonic(), 0
        return True

    def _tell(self, stage: str, best_cost: float) -> None:
        if self._report is None or self.stopped:
            return
        self._last_report = time.monotonic()
        left = max(self._total - self._done, 0) * self._pace
        progress = GlobalProgress(stage, self._done, self._total, best_cost, left)
        self.stopped = not self._report(progress)

    def poll(self, stage: str, best_cost: float) -> bool:
        """Report between generations, a few times a second; returns whether to stop."""
        self._begins(stage)
        now = time.monotonic()
        if now - self._last_report >= LONGEST_PAUSE:
            self._tell(stage, best_cost)
        return self.stopped

    def skip(self, generations: int) -> None:
        """Subtract the generations that a stage has saved by ending early."""
        self._done += generations


def evolve(
    cost: Callable[[Array], Array],
    bounds: Sequence[tuple[float, float]],
    settings: EvolutionSettings,
    clock: ProgressClock,
    *,
    stage: str,
    start: Array | None = None,
) -> tuple[Array, int]:
    """Minimise ``cost``, which maps individuals of shape (p, s) to costs (s,).

    Returns the best individual (p,) and the number of evaluations. ``start`` is part of
    the first population. A NaN cost is worse than any other cost.
    """
    best_cost = math.inf
    evaluations = 0

    def safe_cost(individuals: Array) -> Array:
        nonlocal best_cost, evaluations
        # SciPy counts a whole population as one evaluation.
        evaluations += individuals.shape[1]
        costs = np.nan_to_num(cost(individuals), nan=_WORST, posinf=_WORST)
        best_cost = min(best_cost, float(costs.min()))
        return costs

    def follow(best: Array, convergence: float) -> bool:
        clock.tick(stage, best_cost)
        return clock.stopped

    from scipy.optimize import differential_evolution  # imported late: see entry_points

    low, high = (np.array(side, dtype=float) for side in zip(*bounds, strict=True))
    # SciPy rejects a start outside the bounds, even if only rounding has put it there.
    margin = 1e-9 * (high - low)
    # SciPy 1.15 has renamed the argument for the random generator.
    given = inspect.signature(differential_evolution).parameters
    keyword = "rng" if "rng" in given else "seed"
    result = differential_evolution(
        safe_cost,
        list(zip(low, high, strict=True)),
        strategy=settings.strategy,
        mutation=settings.mutation,
        recombination=settings.recombination,
        maxiter=settings.generations,
        popsize=settings.population,
        tol=1e-8,
        polish=False,
        vectorized=True,
        updating="deferred",
        init="latinhypercube",
        x0=None if start is None else np.clip(start, low + margin, high - margin),
        callback=follow,
        **{keyword: np.random.default_rng(settings.seed)},
    )
    clock.skip(settings.generations - result.nit)
    return np.asarray(result.x), evaluations
