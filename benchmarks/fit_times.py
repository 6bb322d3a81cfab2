"""What a fit, an identification and a sample of the inverse cost, in processor time."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
from scipy.optimize import differential_evolution, minimize

from benchmarks.dampers import clean_windows, steady_window
from benchmarks.figure import Figure
from mr_damper_ros.control.inverse_model import InverseModel, Inversion
from mr_damper_ros.emulation.emulator import scaled
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings, generator_keyword
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.misfit import Misfit
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import (
    CONDITIONS,
    LITERATURE,
    PUBLISHED_METHODS,
    find,
    parameters,
)
from mr_damper_ros.models.sigmoid.coefficient_laws import shape_bounds
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES, SCALE_PARAMETER_NAMES, sine_force
from mr_damper_ros.signals.arrays import Array


def cpu_seconds(work: Callable[[], object]) -> float:
    """Processor time [s] of this process for one call; on an idle machine that is wall time.

    Everything measured with it runs on one thread.
    """
    began = time.process_time()
    work()
    return time.process_time() - began


def interleaved_medians(
    works: Sequence[Callable[[], object]], repetitions: Sequence[int]
) -> list[float]:
    """Median :func:`cpu_seconds` of each work, run in turn so that disturbances hit all.

    In each of as many rounds as the smallest number of ``repetitions``, every work runs its
    share of its own number in a row.
    """
    rounds = min(repetitions)
    times: list[list[float]] = [[] for _ in works]
    for _ in range(rounds):
        for place, (work, number) in enumerate(zip(works, repetitions, strict=True)):
            times[place] += [cpu_seconds(work) for _ in range(number // rounds)]
    return [statistics.median(entries) for entries in times]


# -- a warm re-fit of a window against Nelder-Mead over all parameters ----------------------------

REFITTED = ("2.5mm_1Hz_0.0A", "5.0mm_1Hz_1.5A", "5.0mm_3Hz_0.5A", "7.5mm_1Hz_1.0A")
_SAMPLES = 1000
DRIFT = 0.99
RESIDUAL_LIMIT = 1.001
TOLERANCE = 1e-4
"""MATLAB's default TolX and TolFun of fminsearch."""


@dataclass(frozen=True)
class Refit:
    """Processor times [s] of one re-fit, and residuals against the reference's."""

    reference: float
    nelder_mead: float
    least_squares: float
    residual_ratios: tuple[float, float]


def reference_fit(window: Window, start: Array) -> tuple[Array, float]:
    """Parameters (16,) and norm of the residual [N], as the thesis does it.

    SciPy's Nelder-Mead over all sixteen parameters on the norm of the residual (thesis eq. 12),
    with the limits and tolerances that fminsearch has by default.
    """
    m = window.motion

    def norm(trial: Array) -> float:
        predicted = sine_force(trial, m.displacement, m.velocity, m.acceleration, window.current)
        return float(np.linalg.norm(predicted - window.force))

    budget = 200 * start.size
    found = minimize(
        norm,
        start,
        method="Nelder-Mead",
        options={"maxfev": budget, "maxiter": budget, "xatol": TOLERANCE, "fatol": TOLERANCE},
    )
    return found.x, float(found.fun)


def measured_refit(condition_name: str, repetitions: int, samples: int = _SAMPLES) -> Refit:
    """Re-fit of a window of a damper that has lost 1 % of its force since the one before.

    The start is what was fitted to the window before; the reference runs ``repetitions`` times,
    the fits ten times as often.
    """
    condition = find(condition_name)
    truth = parameters(condition)
    before = steady_window(truth, condition, samples=samples, seed=1)
    window = steady_window(scaled(truth, DRIFT), condition, samples=samples, seed=2)
    start = fit_window(MODELS["sigmoid"], before, truth, method="least_squares").parameters
    reference, nelder_mead, least_squares = interleaved_medians(
        (
            lambda: reference_fit(window, start),
            lambda: fit_window(MODELS["sigmoid"], window, start, method="nelder_mead"),
            lambda: fit_window(MODELS["sigmoid"], window, start, method="least_squares"),
        ),
        (repetitions, 10 * repetitions, 10 * repetitions),
    )
    reached = reference_fit(window, start)[1] / np.sqrt(samples)
    ratios = tuple(
        fit_window(MODELS["sigmoid"], window, start, method=method).rmse / reached
        for method in ("nelder_mead", "least_squares")
    )
    return Refit(reference, nelder_mead, least_squares, (ratios[0], ratios[1]))


def refit_figures(
    repetitions: int = 5, conditions: tuple[str, ...] = REFITTED, samples: int = _SAMPLES
) -> list[Figure]:
    """``window_nm_speedup``, ``window_nm_ms``, ``window_ls_speedup``: medians over conditions."""
    refits = [measured_refit(name, repetitions, samples) for name in conditions]
    worst = [max(refit.residual_ratios[which] for refit in refits) for which in (0, 1)]
    shared = (
        f"Warm re-fit of {samples} samples after a drift of 1 %, median over "
        f"{len(refits)} conditions; processor time against SciPy's Nelder-Mead over all 16 "
        f"parameters from the same start (maxfev = maxiter = 3200, tolerances {TOLERANCE:g})."
    )

    def speedup(key: str, which: int, bar: float) -> Figure:
        ratios = [
            refit.reference / (refit.nelder_mead, refit.least_squares)[which] for refit in refits
        ]
        valid = worst[which] <= RESIDUAL_LIMIT
        return Figure(
            key,
            statistics.median(ratios) if valid else None,
            shared,
            (bar, float("inf")),
            f"Single conditions: {', '.join(f'{ratio:.0f}' for ratio in ratios)}. Largest residual "
            f"against the reference's: {worst[which]:.5f} (limit {RESIDUAL_LIMIT}).",
        )

    return [
        speedup("window_nm_speedup", 0, 20.0),
        Figure(
            "window_nm_ms",
            1e3 * statistics.median(refit.nelder_mead for refit in refits),
            "Processor time of that Nelder-Mead re-fit, covariance included [ms].",
            (0.0, 10.0),
        ),
        speedup("window_ls_speedup", 1, 100.0),
    ]


# -- one set for thirty runs against differential evolution ---------------------------------------

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


def global_figures(
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


# -- the inverse ----------------------------------------------------------------------------------

BLOCK = 10
HIGHEST_CURRENT = 2.0


def random_motion(count: int, rng: np.random.Generator) -> Motion:
    """Samples up to 0.25 m/s that have nothing to do with each other."""
    velocity = rng.uniform(-0.25, 0.25, count)
    return Motion(
        displacement=rng.normal(0.0, 0.005, count),
        velocity=velocity,
        acceleration=rng.normal(0.0, 5.0, count),
        peak_velocity=np.hypot(velocity, rng.normal(0.0, 0.05, count)),
        sine=None,
    )


def seconds_per_sample(sets: Sequence[ParameterSet], blocks: int) -> float:
    """Mean processor time [s] of a sample in blocks of ten, for random wanted forces."""
    rng = np.random.default_rng(1)
    total = 0.0
    for chosen in sets:
        inverse = InverseModel(chosen, 0.0, HIGHEST_CURRENT)
        motions = [random_motion(BLOCK, rng) for _ in range(blocks)]
        wanted = [_wanted(inverse, motion, rng) for motion in motions]

        def work(
            inverse: InverseModel = inverse,
            motions: Sequence[Motion] = motions,
            wanted: Sequence[Array] = wanted,
        ) -> list[Inversion]:
            pairs = zip(motions, wanted, strict=True)
            return [inverse.currents(motion, forces) for motion, forces in pairs]

        work()
        total += cpu_seconds(work)
    return total / (len(sets) * blocks * BLOCK)


def _wanted(inverse: InverseModel, motion: Motion, rng: np.random.Generator) -> Array:
    found = inverse.currents(motion, np.zeros(motion.velocity.size))
    span = found.most - found.least
    return rng.uniform(found.least - 0.3 * span, found.most + 0.3 * span)


def inverse_figures() -> list[Figure]:
    """``inverse_us_per_sample``."""
    sets = [ParameterSet(parameters(c, m)) for c in CONDITIONS for m in PUBLISHED_METHODS]
    return [
        Figure(
            "inverse_us_per_sample",
            1e6 * seconds_per_sample(sets[:: max(len(sets) // 8, 1)], 200),
            "Processor time [µs] of a sample of the inverse in blocks of ten; every eighth set.",
            (0.0, 50.0),
        )
    ]
