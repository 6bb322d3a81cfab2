"""Hundred runs of differential evolution on one run, as in section 4.6 of the thesis."""

from __future__ import annotations

import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np

from benchmarks.figure import Figure
from mr_damper_ros.models.published import find
from studies.thesis.de import evolve
from studies.thesis.facts import SEARCH_HIGH, SEARCH_LOW
from studies.thesis.runs import cycle

CONDITION = "5.0mm_1Hz_0.0A"
RUNS, ITERATIONS, WORKERS = 100, 500, 2


def one_run(seed: int, iterations: int) -> tuple[float, float]:
    """Best mean square error [N²] of one search over sixteen parameters, and its time [s]."""
    began = time.process_time()
    misfit = cycle(find(CONDITION).name, 0)
    rng = np.random.default_rng(seed)
    found = evolve(misfit.costs, SEARCH_LOW, SEARCH_HIGH, rng, generations=iterations)
    return found.cost, time.process_time() - began


def all_runs(runs: int, iterations: int, workers: int) -> list[tuple[float, float]]:
    """The same with ``runs`` seeds; the costs do not depend on the number of workers."""
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        return list(pool.map(one_run, range(runs), [iterations] * runs))


def figures(runs: int = RUNS, iterations: int = ITERATIONS, workers: int = WORKERS) -> list[Figure]:
    """``de100_s``."""
    began = time.perf_counter()
    costs, seconds = zip(*all_runs(runs, iterations, workers), strict=True)
    wall = time.perf_counter() - began
    note = (
        f"Residuals: {np.sqrt(min(costs)):.3f} to {np.sqrt(max(costs)):.3f} N. On the wall it took "
        f"{wall:.1f} s, start of the processes and all else on this machine included."
    )
    if (runs, iterations) != (RUNS, ITERATIONS):
        note += f" NOT THE FULL FIGURE: {runs} runs of {iterations} iterations."
    return [
        Figure(
            "de100_s",
            sum(seconds) / workers,
            f"Processor time per process of {RUNS} runs of differential evolution (rand/1/bin, "
            f"F = CR = 0.8, 160 individuals, {ITERATIONS} iterations, 16 parameters) "
            "on the 7001 samples of one run, "
            f"averaged over the cycle, by {WORKERS} processes: the wall time on idle cores [s].",
            (0.0, 60.0),
            note,
        )
    ]
