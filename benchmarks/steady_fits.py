"""Fits of steady runs of the thesis' damper: their cost and their distance from the accuracy limit.

The cost is the processor time of one thread.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from scipy.optimize import differential_evolution

from benchmarks.figure import Measured
from mr_damper_ros.api.replay import replay
from mr_damper_ros.control.inverse_model import InverseModel
from mr_damper_ros.emulation.emulator import (
    THESIS_FORCE_NOISE,
    EmulatedDamper,
    EmulatedRig,
    RigSettings,
    scaled,
)
from mr_damper_ros.emulation.motions import SineMotion
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
    Condition,
    find,
    is_clean,
    parameters,
)
from mr_damper_ros.models.sigmoid.law import (
    PARAMETER_NAMES,
    SCALE_PARAMETER_NAMES,
    Coefficients,
    coefficient_jacobian,
    operating_point_coefficients,
    sine_force,
)
from mr_damper_ros.models.sigmoid.sigmoid_model import shape_bounds
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording
from studies.recordings import window_of
from studies.thesis.runs import DISPLACEMENT_NOISE, PHASE, synthesise
from studies.thesis.searches import fminsearch

_LAW = MODELS["sigmoid"]


def steady_window(parameters: Array, condition: Condition, *, samples: int, seed: int) -> Window:
    """Steady run of a damper of known parameters (16,) in a condition, at 1 kHz.

    The noise of force and displacement is that of :mod:`studies.thesis.runs`.
    """
    rig = EmulatedRig(
        EmulatedDamper(parameters),
        SineMotion(condition.amplitude, condition.frequency, phase=PHASE),
        condition.current,
        settings=RigSettings(displacement_noise=DISPLACEMENT_NOISE, seed=seed),
    )
    return window_of(rig.record(samples * rig.settings.period))


def clean_runs() -> list[Recording]:
    """The 30 clean conditions of the thesis, 7001 samples each."""
    return [synthesise(condition) for condition in CONDITIONS if is_clean(condition)]


def cpu_seconds(work: Callable[[], object]) -> float:
    """Processor time [s] of this process for one call, equal to wall time on an idle machine."""
    began = time.process_time()
    work()
    return time.process_time() - began


# -- the limit of Cramér and Rao -------------------------------------------------------------------

_INTERVAL = 1.959964
"""Half width of the 95 % interval of a normal distribution, in standard deviations."""


def noise_figures(realisations: int = 500, samples: int = 2000) -> Measured:
    """Variance of the coefficients relative to the bound, and coverage of their intervals.

    The fits are to one condition with independent noise; seeds are 0, 1, 2 ...
    """
    condition = find("5.0mm_1Hz_1.5A")
    published = parameters(condition)
    speed = 2.0 * np.pi * condition.frequency * condition.amplitude
    truth = np.concatenate(operating_point_coefficients(published, speed, condition.current))
    if truth[0] < 0.0:
        truth[:2] *= -1.0  # the same loop, as fits report it
    errors, claimed = [], []
    for seed in range(realisations):
        window = steady_window(published, condition, samples=samples, seed=seed)
        fit = fit_window(_LAW, window, published, method="least_squares")
        errors.append(fit.coefficients - truth)
        claimed.append(np.sqrt(np.diag(fit.coefficient_covariance)))
    # Smallest variance of unbiased coefficients from samples of the exact motion at 1 kHz.
    motion = SineMotion(condition.amplitude, condition.frequency, phase=PHASE).at(
        np.arange(samples, dtype=np.float64) * 1e-3
    )
    jacobian = coefficient_jacobian(Coefficients(*truth), motion.velocity, motion.acceleration)
    bound = np.diag(THESIS_FORCE_NOISE**2 * np.linalg.inv(jacobian.T @ jacobian))
    ratios = np.mean(np.square(errors), axis=0) / bound
    chance = np.sqrt(2.0 / realisations)
    note = f"Mean of the seven: {ratios.mean():.3f}; standard error of one ratio: {chance:.3f}."
    return {
        "crlb_ratio": (float(ratios.max()), note),
        "coverage_percent": 100.0 * float(np.mean(np.abs(errors) <= _INTERVAL * np.array(claimed))),
    }


# -- streamed kinematics against exact ones --------------------------------------------------------


def stream_figures(runs: int | None = None) -> Measured:
    """Error of the predicted force on all clean runs, or on the first few."""
    errors = []
    for condition in [c for c in CONDITIONS if is_clean(c)][:runs]:
        run = synthesise(condition)
        values = parameters(condition)
        said = replay(run, ParameterSet(values), identify=False)
        time_: Array = np.arange(run.force.size, dtype=float) * run.period
        sine = SineMotion(condition.amplitude, condition.frequency, phase=PHASE)
        exact = sine_force(values, *sine.at(time_), condition.current)
        errors.append(
            [
                np.mean((force - run.force)[said.valid] ** 2) / np.var(run.force)
                for force in (said.predicted, exact)
            ]
        )
    streamed, exact_error = np.mean(errors, axis=0)
    return {"stream_nrmse_ratio": float(np.sqrt(streamed / exact_error))}


# -- a warm re-fit of a window against Nelder-Mead over all parameters -----------------------------

REFITTED = ("2.5mm_1Hz_0.0A", "5.0mm_1Hz_1.5A", "5.0mm_3Hz_0.5A", "7.5mm_1Hz_1.0A")
RESIDUAL_LIMIT = 1.001


def measured_refit(name: str, repetitions: int, samples: int = 1000) -> tuple[Array, Array]:
    """Fit a window again after the damper has lost 1 % of its force since the previous window.

    The start is the fit to the previous window. The reference is the method of the thesis (eq. 12):
    Nelder-Mead over all sixteen parameters, with the limits and tolerances of fminsearch. It runs
    ``repetitions`` times, and the two fits ten times as often, in turn, so that disturbances affect
    all. Returns the median processor times [s] of the reference and of the fits, and the residuals
    of the fits over that of the reference.
    """
    condition = find(name)
    truth = parameters(condition)
    before = steady_window(truth, condition, samples=samples, seed=1)
    window = steady_window(scaled(truth, 0.99), condition, samples=samples, seed=2)
    start = fit_window(_LAW, before, truth, method="least_squares").parameters

    def residual(trial: Array) -> float:
        return float(np.linalg.norm(_LAW.window_force(window, trial) - window.force))

    fits = [
        partial(fit_window, _LAW, window, start, method=method)
        for method in ("nelder_mead", "least_squares")
    ]
    times: list[list[float]] = [[], [], []]
    for _ in range(repetitions):
        times[0].append(cpu_seconds(lambda: fminsearch(residual, start)))
        for entries, fit in zip(times[1:], fits, strict=True):
            entries += [cpu_seconds(fit) for _ in range(10)]
    reached = fminsearch(residual, start)[1] / np.sqrt(samples)
    return np.array([*map(statistics.median, times)]), np.array([f().rmse / reached for f in fits])


def refit_figures(repetitions: int = 5) -> Measured:
    """Medians over conditions; a speed counts only if the residual equals that of the reference."""
    found = [measured_refit(name, repetitions) for name in REFITTED]
    seconds, residuals = map(np.array, zip(*found, strict=True))
    figures: Measured = {"window_nm_ms": 1e3 * float(np.median(seconds[:, 1]))}
    for place, key in ((1, "window_nm_speedup"), (2, "window_ls_speedup")):
        ratios, worst = seconds[:, 0] / seconds[:, place], residuals[:, place - 1].max()
        figures[key] = (
            float(np.median(ratios)) if worst <= RESIDUAL_LIMIT else None,
            f"Single conditions: {', '.join(f'{ratio:.0f}' for ratio in ratios)}. Largest residual "
            f"against the reference's: {worst:.5f} (limit {RESIDUAL_LIMIT}).",
        )
    return figures


# -- one set for thirty runs against differential evolution ----------------------------------------

GENERATIONS = 500

_GAIN_RANGE = 100.0
"""Bounds of k2 and k3, equal to those of the search in the identification."""

_SCALE_REACH = 3.0
"""Upper bound of the scales, as a multiple of the identified values."""


def search_bounds(windows: Sequence[Window], found: Array) -> list[tuple[float, float]]:
    """Bounds of the sixteen parameters, no wider than those of the identification."""
    bounds = shape_bounds(
        max(float(window.motion.peak_velocity.max()) for window in windows),
        max(float(np.abs(window.current).max()) for window in windows),
    )
    bounds |= dict.fromkeys(("k2", "k3"), (-_GAIN_RANGE, _GAIN_RANGE))
    for name in SCALE_PARAMETER_NAMES:
        reach = _SCALE_REACH * max(abs(float(found[PARAMETER_NAMES.index(name)])), 1e-3)
        bounds[name] = (-reach, reach)
    return [bounds[name] for name in PARAMETER_NAMES]


def global_figures(generations: int = GENERATIONS, repetitions: int = 10) -> Measured:
    """Identify one set from all runs, then run the reference with the same bounds.

    The reference is SciPy's differential evolution with the thesis' settings: rand/1/bin, F = CR =
    0.8, 15 individuals per unknown, all samples; a whole generation is evaluated at once.
    """
    windows = [window_of(run) for run in clean_runs()]
    identify = partial(identify_global, _LAW, windows, LITERATURE, EvolutionSettings())
    found = identify().parameter_set.values
    seconds = statistics.median(cpu_seconds(identify) for _ in range(repetitions))
    noise = [
        fit_window(_LAW, window, LITERATURE, method="least_squares").rmse for window in windows
    ]
    misfit = Misfit(_LAW, windows, noise)
    began = time.process_time()
    reference = differential_evolution(
        lambda individuals: misfit.population_cost(individuals.T),
        search_bounds(windows, found),
        strategy="rand1bin",
        mutation=0.8,
        recombination=0.8,
        maxiter=generations,
        tol=0.0,
        polish=False,
        vectorized=True,
        updating="deferred",
        **{generator_keyword(): np.random.default_rng(0)},
    )
    took, cost = time.process_time() - began, misfit.mean_square(found)
    return {
        "global_speedup": (
            took / seconds if cost <= reference.fun else None,
            f"The reference took {took:.0f} s for {generations} generations (the figure is of "
            f"{GENERATIONS}) and reached a cost of {reference.fun:.4g}, the identification "
            f"{cost:.4g}.",
        ),
        "global_s": seconds,
    }


_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_SCRIPT = """
import sys, time
sys.path[:] = {path!r}
import mr_damper_ros as mr
from benchmarks.steady_fits import clean_runs
runs = clean_runs()[::{every}]
began = time.process_time()
mr.identify(*runs, model="sigmoid_lag", generations={generations})
print(time.process_time() - began)
"""


def thread_figures(every: int = 3, generations: int = 100) -> Measured:
    """Identify in a fresh process without the environment variables of BLAS, and in one with them.

    A user calls ``mr.identify`` in Python without setting variables. The default threads of the
    libraries must not cost more than a single thread.
    """
    others = {name: value for name, value in os.environ.items() if name not in _VARIABLES}
    script = _SCRIPT.format(path=sys.path, every=every, generations=generations)
    taken, single = (
        float(
            subprocess.run(
                [sys.executable, "-c", script],
                env={**others, **variables},
                capture_output=True,
                text=True,
                check=True,
            ).stdout
        )
        for variables in ({}, dict.fromkeys(_VARIABLES, "1"))
    )
    return {"threads_cpu_ratio": (taken / single, f"{taken:.1f} s against {single:.1f} s.")}


# -- the inverse -----------------------------------------------------------------------------------

_BLOCK, _BLOCKS = 10, 200


def inverse_figures() -> Measured:
    """Random desired forces, some out of reach, in blocks of ten, for every eighth set."""
    sets = [ParameterSet(parameters(c, m)) for c in CONDITIONS for m in PUBLISHED_METHODS]
    chosen, rng, total = sets[:: len(sets) // 8], np.random.default_rng(1), 0.0
    for known in chosen:
        inverse = InverseModel(known, 0.0, 2.0)
        motions, wanted = [_unrelated(rng) for _ in range(_BLOCKS)], []
        for motion in motions:
            reach = inverse.currents(motion, np.zeros(_BLOCK))
            span = reach.most - reach.least
            wanted.append(rng.uniform(reach.least - 0.3 * span, reach.most + 0.3 * span))
        for _ in range(2):  # the first time warms up
            took = cpu_seconds(partial(list, map(inverse.currents, motions, wanted)))
        total += took
    return {"inverse_us_per_sample": 1e6 * total / (len(chosen) * _BLOCKS * _BLOCK)}


def _unrelated(rng: np.random.Generator) -> Motion:
    """Independent random samples with velocities up to 0.25 m/s."""
    velocity = rng.uniform(-0.25, 0.25, _BLOCK)
    return Motion(
        displacement=rng.normal(0.0, 0.005, _BLOCK),
        velocity=velocity,
        acceleration=rng.normal(0.0, 5.0, _BLOCK),
        peak_velocity=np.hypot(velocity, rng.normal(0.0, 0.05, _BLOCK)),
        sine=None,
    )
