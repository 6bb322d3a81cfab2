"""Three buildings in three earthquakes: the weighted inverse against passive-on and bang-bang."""

from __future__ import annotations

import math

from benchmarks.figure import Figure
from mr_damper_ros.processes.process_pool import ProcessPool, Tell
from studies.control.buildings import (
    CASES,
    LAG,
    WEIGHTED,
    BuildingResult,
    BuildingRun,
    Buildings,
    cases_won,
    simulate,
    tasks,
)


def figures(longest: float = math.inf, workers: int = 2) -> list[Figure]:
    """``building_cases_won`` and ``building_reversals_per_second``."""
    runs = [task for task in tasks(longest) if task.coil_time_constant == LAG]
    with ProcessPool(workers) as pool:
        results = pool.map(_simulated, runs)
    found = Buildings(
        {run: result for run, result in zip(runs, results, strict=True) if result is not None},
        longest,
    )
    about = (
        f"{len(CASES)} cases (El Centro and two invented earthquakes in place of Kobe and Maule), "
        "coil lag 10 ms"
    )
    return [
        Figure(
            "building_cases_won",
            float(cases_won(found)),
            f"{about}: those in which the weighted inverse is better than passive-on and bang-bang "
            "clipped-optimal in RMS displacement and acceleration of the roof.",
            (float(len(CASES)), math.inf),
        ),
        Figure(
            "building_reversals_per_second",
            max(found.of(WEIGHTED, case, LAG).reversals for case in CASES),
            f"{about}: most reversals of its current in a second.",
            (0.0, 20.0),
        ),
    ]


def _simulated(run: BuildingRun, tell: Tell) -> BuildingResult:
    return simulate(run)
