"""One set for thirty runs, against differential evolution on their samples."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
from scipy.optimize import differential_evolution

from benchmarks.dampers import clean_windows
from benchmarks.figure import Figure
from benchmarks.timing import cpu_seconds
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings, generator_keyword
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.misfit import Misfit
from mr_damper_ros.models.published import LITERATURE
from mr_damper_ros.models.sigmoid.coefficient_laws import shape_bounds
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES, SCALE_PARAMETER_NAMES
from mr_damper_ros.signals.arrays import Array

GENERATIONS = 500
GAIN_RANGE = 100.0
"""Bounds of k2 and k3, those of the identification's own search."""

SCALE_REACH = 3.0
"""Scales are searched up to so many times the size that the identification found."""


@dataclass(frozen=True)
class Contest:
    """Processor times [s] and costs (mean squared weighted residual) of both searches."""

    seconds: float
    cost: float
    reference_seconds: float
    reference_cost: float
    generations: int


def search_bounds(windows: Sequence[Window], found: Array) -> list[tuple[float, float]]:
    """Bounds of the sixteen parameters, no wider than those of the identification itself."""
    bounds = shape_bounds(
        max(float(window.motion.peak_velocity.max()) for window in windows),
        max(float(np.abs(window.current).max()) for window in windows),
    )
    bounds |= dict.fromkeys(("k2", "k3"), (-GAIN_RANGE, GAIN_RANGE))
    for name in SCALE_PARAMETER_NAMES:
        reach = SCALE_REACH * max(abs(float(found[PARAMETER_NAMES.index(name)])), 1e-3)
        bounds[name] = (-reach, reach)
    return [bounds[name] for name in PARAMETER_NAMES]


def reference_search(
    misfit: Misfit,
    bounds: Sequence[tuple[float, float]],
    generations: int,
    after_generation: Callable[[], None],
) -> float:
    """Lowest cost that SciPy's differential evolution finds with the thesis' settings.

    rand/1/bin, F = CR = 0.8, 15 individuals per unknown, all samples; a whole generation is
    evaluated at once.
    """

    def after(*_: object, **__: object) -> None:
        after_generation()

    found = differential_evolution(
        lambda individuals: misfit.population_cost(individuals.T),
        bounds,
        strategy="rand1bin",
        mutation=0.8,
        recombination=0.8,
        maxiter=generations,
        tol=0.0,
        polish=False,
        vectorized=True,
        updating="deferred",
        callback=after,
        **{generator_keyword(): np.random.default_rng(0)},
    )
    return float(found.fun)


def contest(windows: Sequence[Window], generations: int, repetitions: int) -> Contest:
    """Identify from the windows, then let the reference try; both know the same bounds.

    The identification is timed between generations of the reference, which takes minutes: so a
    busy spell of the machine hits both.
    """

    def identify() -> Array:
        return identify_global(
            MODELS["sigmoid"], windows, LITERATURE, EvolutionSettings()
        ).parameter_set.values

    found = identify()
    times: list[float] = []
    generation = count(1)

    def time_identification() -> None:
        if next(generation) % max(generations // repetitions, 1) == 0:
            times.append(cpu_seconds(identify))

    noise = [
        fit_window(MODELS["sigmoid"], window, LITERATURE, method="least_squares").rmse
        for window in windows
    ]
    misfit = Misfit(MODELS["sigmoid"], windows, noise)
    costs: list[float] = []
    bounds = search_bounds(windows, found)
    both = cpu_seconds(
        lambda: costs.append(reference_search(misfit, bounds, generations, time_identification))
    )
    seconds, reference = statistics.median(times), both - sum(times)
    return Contest(seconds, misfit.mean_square(found), reference, costs[0], generations)


def figures(
    generations: int = GENERATIONS,
    repetitions: int = 10,
    windows: Sequence[Window] | None = None,
) -> list[Figure]:
    """``global_speedup`` and ``global_s``."""
    windows = clean_windows() if windows is None else windows
    result = contest(windows, generations, repetitions)
    note = (
        f"The reference took {result.reference_seconds:.0f} s for {generations} generations and "
        f"reached a cost of {result.reference_cost:.4g}, the identification {result.cost:.4g}."
    )
    if generations != GENERATIONS:
        note += f" NOT THE FULL FIGURE: {generations} generations instead of {GENERATIONS}."
    return [
        Figure(
            "global_speedup",
            result.reference_seconds / result.seconds
            if result.cost <= result.reference_cost
            else None,
            f"Sixteen parameters from {len(windows)} runs of 7001 samples: processor time against "
            "SciPy's differential_evolution on all samples, with the same cost function and "
            "bounds, vectorised over the population.",
            (200.0, float("inf")),
            note,
        ),
        Figure(
            "global_s",
            result.seconds,
            "Processor time of that identification, from windows to parameters with standard "
            "errors [s].",
            (0.0, 2.0),
        ),
    ]
