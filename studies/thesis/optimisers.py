"""Comparison of optimisers on the same run, with the same random starts and the same budget.

The problem is that of the thesis: one run (5 mm, 1 Hz, 1.5 A) and sixteen parameters within the
bounds of its tables 10 and 11. A method that ends before the budget is spent starts again from a
new random point, as a user would do. Methods with seven unknowns keep the shape parameters of the
random start. A gradient counts as one evaluation per unknown.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.optimize import basinhopping, dual_annealing, least_squares
from scipy.stats import binomtest

from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.published import find, parameters
from mr_damper_ros.report.document import INK, Block, Chapter, Picture, Table, chart
from mr_damper_ros.signals.arrays import Array
from studies.drawing import chapter, line
from studies.program import Campaign
from studies.thesis import facts
from studies.thesis.runs import CycleMisfit, cycle, loop
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
        self.best = np.full(_LOW.size, np.nan)
        self.best_cost = math.inf
        self.trace: list[tuple[int, float]] = []

    def cost(self, parameters: Array) -> float:
        """Mean square error of one set (16,)."""
        return float(self.costs(parameters[np.newaxis])[0])

    def costs(self, sets: Array) -> Array:
        """Mean square errors of sets (s, 16), clipped to the bounds as the thesis does."""
        inside = np.clip(sets, _LOW, _HIGH)
        values = np.nan_to_num(self.misfit.costs(inside), nan=1e300, posinf=1e300)
        place = int(np.argmin(values))
        self.note(inside[place], float(values[place]), len(values))
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


def _package_fit(method: str) -> Method:
    """The window fit of the package; poor starts compete with starts estimated from the data."""

    def search(meter: EvaluationMeter, rng: np.random.Generator) -> None:
        fit = fit_window(MODELS["sigmoid"], meter.misfit.window, _random(rng), method=method)
        # Its scales have no bounds, and its Jacobians have seven columns.
        cost = float(meter.misfit.costs(fit.parameters))
        meter.note(fit.parameters, cost, fit.evaluations)

    return search


def _evolution(strategy: str) -> Method:
    def search(meter: EvaluationMeter, rng: np.random.Generator) -> None:
        extent = {"generations": meter.budget // POPULATION, "population": POPULATION}
        evolve(meter.costs, _LOW, _HIGH, rng, strategy=strategy, **extent)

    return search


def _cma_es(meter: EvaluationMeter, rng: np.random.Generator) -> None:
    import cma

    while True:
        start, seed = rng.random(_LOW.size), int(rng.integers(1, 2**31))
        options = {"bounds": [0.0, 1.0], "seed": seed, "verbose": -9, "maxfevals": meter.budget}
        search = cma.CMAEvolutionStrategy(start, 0.3, options)
        while not search.stop():
            sets = search.ask()
            costs = meter.costs(_LOW + _SPAN * np.array(sets))
            search.tell(sets, np.log(costs).tolist())


_UNIT = [(0.0, 1.0)] * _LOW.size
_ENDLESS = 10**6
"""Iterations of the two methods below, which end with the budget."""


def _log_cost(meter: EvaluationMeter) -> Callable[[Array], float]:
    return lambda x: math.log(meter.cost(_LOW + _SPAN * x))


def _dual_annealing(meter: EvaluationMeter, rng: np.random.Generator) -> None:
    start, seed = rng.random(_LOW.size), int(rng.integers(2**31))
    limits = {"maxfun": meter.budget, "maxiter": _ENDLESS}
    dual_annealing(_log_cost(meter), _UNIT, seed=seed, x0=start, **limits)


def _basin_hopping(meter: EvaluationMeter, rng: np.random.Generator) -> None:
    start, seed = rng.random(_LOW.size), int(rng.integers(2**31))
    local = {"method": "L-BFGS-B", "bounds": _UNIT}
    options = {"niter": _ENDLESS, "stepsize": 0.2, "minimizer_kwargs": local}
    basinhopping(_log_cost(meter), start, seed=seed, **options)


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


BUDGET, QUICK_BUDGET = 20000, 5000

SUCCESS = 1.05
"""A run succeeds if its RMSE is at most this factor times the residual noise of the true set."""

CHECKPOINTS = 60


def run(method: str, seed: tuple[int, ...], noise_seed: int, budget: int) -> dict[str, Any]:
    """Task: one search from a random start, with new starts until the budget is spent.

    Returns the best ``parameters`` (16,) and its ``rmse`` [N], the ``floor`` [N] of the true set,
    evaluations and ``seconds``, the RMSE after the ``first`` descent, the evaluations with which
    the goal was ``reached`` (NaN: never), and the best RMSE at each checkpoint (NaN: none yet).
    """
    misfit = cycle(CONDITION, noise_seed)
    floor = float(misfit.costs(parameters(find(CONDITION))))
    meter = EvaluationMeter(misfit, budget)
    rng = np.random.default_rng(seed)
    search = METHODS[method][1]
    began, first = time.process_time(), math.nan
    try:
        while not meter.best_cost <= SUCCESS**2 * floor:
            search(meter, rng)
            first = meter.best_cost if math.isnan(first) else first
    except BudgetSpentError:
        first = meter.best_cost if math.isnan(first) else first
    used, costs = np.array(meter.trace).T
    good = costs <= SUCCESS**2 * floor
    places = np.searchsorted(used, _checkpoints(budget), side="right")
    return {
        "parameters": meter.best,
        "rmse": math.sqrt(meter.best_cost),
        "floor": math.sqrt(floor),
        "evaluations": meter.used,
        "seconds": time.process_time() - began,
        "first": math.sqrt(first),
        "reached": float(used[good][0]) if good.any() else math.nan,
        "trace": np.sqrt(np.append(math.nan, costs)[places]),
    }


def _checkpoints(budget: int) -> Array:
    return np.geomspace(10, budget, CHECKPOINTS)


def optimisers_part(campaign: Campaign) -> Iterator[Chapter]:
    """The chapter on the optimisers."""
    budget = QUICK_BUDGET if campaign.quick else BUDGET
    names = available()
    # The same seeds for all methods: the same random starts.
    seeds = campaign.seeds(4)
    keys = [(name, seed) for seed in seeds for name in names]
    common = {"noise_seed": campaign.seed, "budget": budget}
    results = campaign.each("optimisers", run, keys, **common)
    found = {name: _summary([results[name, seed] for seed in seeds]) for name in names}
    floor = results[keys[0]]["floor"]
    missing = [METHODS[name][0] for name in METHODS if name not in names]
    rates = [
        f"{METHODS[name][0]} {100 * found[name]['success']:.0f} %"
        for name in ("nelder_mead_16", "de_0", "cma_es", "least_squares_16", "nelder_mead_7")
        if name in found
    ]
    rows = [
        (
            METHODS[name][0],
            "{:.0f} ({:.0f}–{:.0f})".format(100 * part["success"], *part["interval"]),
            f"{100 * part['first_success']:.0f}",
            "never" if math.isnan(part["reached"]) else round(part["reached"]),
            *(part["seconds"], part["rmse"][1]),
            f"{part['rmse'][0]:.3g}–{part['rmse'][2]:.3g}",
            *(part["parameter_spread"], part["loop_spread"]),
        )
        for name, part in found.items()
    ]
    blocks: list[Block] = [
        "The problem is that of the thesis: the run of 5 mm, 1 Hz, 1.5 A, and sixteen parameters "
        f"within the bounds of tables 10 and 11. Each method has {campaign.runs} runs, with the "
        f"same random starts, of at most {budget} evaluations of the force law over the cycle (250 "
        "phases). Local methods start again from a new random point until they succeed or the "
        "budget is spent; a gradient counts as sixteen evaluations. DE (F = CR = 0.8, "
        f"{POPULATION} individuals) does not restart; the section on repeated differential "
        "evolution uses rand/1 with twice the population and 500 generations. A run succeeds if "
        f"its RMSE is within {100 * (SUCCESS - 1):.0f} % of the residual of the true set, "
        f"{floor:.2f} N.",
        "The problem with seven unknowns is smaller, because the run determines only seven "
        "coefficients. The two methods for it are those of this package. They may start from "
        "values derived from the data, and their scales have no bounds. Times are processor times "
        "on the computer that made this report.",
        *([f"Omitted, because not installed: {', '.join(missing)}."] if missing else []),
        Table(
            "optimisers",
            "Success rate in % with Wilson's 95 % interval, and that of the first descent alone; "
            "median number of evaluations in successful runs; processor time; final RMSE (median, "
            "10–90 % of runs); spread of the parameters (median standard deviation relative to the "
            "width of the bounds) and of the loops.",
            "Method | Success [%] | First descent [%] | Evaluations to success | Time [s] | "
            "RMSE [N] | 10–90 % [N] | Parameter spread [1] | Loop spread [N]",
            rows,
        ),
        _trace_figure(found, _checkpoints(budget), floor),
        _success_figure(found),
    ]
    told = f"success within {budget} evaluations: {', '.join(rates)}."
    yield chapter("optimisers", "Comparison of optimisers", told, *blocks)


def _summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Success rate [1] with its interval [%], medians and spreads over the runs of one method."""
    rmse, first, reached, seconds, traces, sets = (
        np.array([result[key] for result in results])
        for key in ("rmse", "first", "reached", "seconds", "trace", "parameters")
    )
    goal, count = SUCCESS * results[0]["floor"], len(results)
    wins = int(np.sum(rmse <= goal))
    # Wilson, J. Am. Stat. Assoc. 22, 1927
    interval = binomtest(wins, count).proportion_ci(0.95, "wilson")
    loops = np.array([loop(values, find(CONDITION)).force for values in sets])
    known = np.where(np.isnan(traces), np.inf, traces)
    quartiles = np.percentile(known, [25, 50, 75], axis=0, method="nearest")
    return {
        "success": wins / count,
        "interval": (100 * interval.low, 100 * interval.high),
        "first_success": float(np.mean(first <= goal)),
        "reached": float(np.nanmedian(reached)) if wins else math.nan,
        "seconds": float(np.median(seconds)),
        "rmse": np.percentile(rmse, [10, 50, 90]).tolist(),
        "parameter_spread": float(np.median(sets.std(axis=0) / _SPAN)),
        "loop_spread": float(np.sqrt(np.mean(loops.var(axis=0)))),
        "trace": np.where(np.isinf(quartiles), np.nan, quartiles),
    }


def _trace_figure(found: dict[str, Any], x: Array, floor: float) -> Picture:
    picture, axes = chart(
        "optimisers",
        "Best RMSE over the number of evaluations: median and quartiles over the random starts. A "
        "population counts as a whole, and so does a fit of seven unknowns, whose line therefore "
        "begins at the noise. 5 mm, 1 Hz, 1.5 A, re-synthesised.",
        (1, 2, 7.4, 3.6),
        *("Evaluations [1]", "Best RMSE so far [N]"),
        sharey=True,
    )
    thesis = [n for n in found if n.startswith("de_") or n == "nelder_mead_16"]
    halves = (thesis, [n for n in found if n not in thesis])
    for a, names in zip(axes[0], halves, strict=True):
        for number, name in enumerate(names):
            low, middle, high = found[name]["trace"]
            a.fill_between(x, low, high, color=INK[number], alpha=0.10, lw=0)
            style = {**line(number, marked=True), "markevery": (4 + 2 * number, 12)}
            a.loglog(x, middle, label=METHODS[name][0], **style)
        a.axhline(floor, color="0.3", lw=0.7)
        a.legend(loc="upper right", fontsize=7)
    axes[0, 0].text(x[0], 0.93 * floor, "noise", va="top", color="0.3", fontsize=7)
    return picture


def _success_figure(found: dict[str, Any]) -> Picture:
    names = list(found)[::-1]
    picture, ((a,),) = chart(
        "optimiser_success",
        "Success rate within the budget (dot) with Wilson's 95 % interval (bar), and success rate "
        "of the first descent alone (tick).",
        (1, 1, 6.0, 0.5 + 0.24 * len(names)),
        "Success [%]",
    )
    for place, name in enumerate(names):
        part = found[name]
        a.plot(part["interval"], [place, place], color="0.55", lw=2.2)
        a.plot(100 * part["success"], place, "o", color=INK[0], ms=4.5)
        a.plot(100 * part["first_success"], place, "|", color=INK[1], ms=9, mew=1.6)
    a.set_yticks(range(len(names)), [METHODS[name][0] for name in names])
    a.set_xlim(-3, 103)
    a.grid(axis="x", color="0.9", lw=0.6)
    return picture
