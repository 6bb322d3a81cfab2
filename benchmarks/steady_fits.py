"""Cost of fits and inverses in processor time, and kinematics, on runs of the thesis' damper."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from benchmarks.figure import Measured
from mr_damper_ros.api.replay import replay
from mr_damper_ros.control.inverse_model import InverseModel
from mr_damper_ros.emulation.emulator import EmulatedDamper, EmulatedRig, RigSettings, scaled
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import (
    CONDITIONS,
    LITERATURE,
    PUBLISHED_METHODS,
    Condition,
    find,
    parameters,
)
from mr_damper_ros.models.sigmoid.law import sine_force
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording
from studies.recordings import window_of
from studies.thesis.facts import is_clean
from studies.thesis.runs import DISPLACEMENT_NOISE, PHASE, synthesise

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


# -- streamed kinematics against exact ones --------------------------------------------------------


def stream_figures(runs: int | None = None, seed: int = 0) -> Measured:
    """Error of the predicted force on all clean runs, or on the first few."""
    errors = []
    for condition in [c for c in CONDITIONS if is_clean(c)][:runs]:
        run = synthesise(condition, seed=seed)
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


# -- the cost of a warm re-fit of a window, and of one set for thirty runs -------------------------

REFITTED = ("2.5mm_1Hz_0.0A", "5.0mm_1Hz_1.5A", "5.0mm_3Hz_0.5A", "7.5mm_1Hz_1.0A")


def refit_figures(repetitions: int = 50) -> Measured:
    """Fit a window of 1000 samples again after the damper has lost 1 % of its force.

    The start is the fit to the previous window. Medians of the repetitions, then of the conditions.
    """
    times = []
    for condition in map(find, REFITTED):
        truth = parameters(condition)
        before = steady_window(truth, condition, samples=1000, seed=1)
        window = steady_window(scaled(truth, 0.99), condition, samples=1000, seed=2)
        start = fit_window(_LAW, before, truth, method="least_squares").parameters
        refit = partial(fit_window, _LAW, window, start, method="nelder_mead")
        times.append(statistics.median(cpu_seconds(refit) for _ in range(repetitions)))
    return {"window_nm_ms": 1e3 * float(np.median(times))}


def global_figures(repetitions: int = 10) -> Measured:
    """Identify one set of 16 parameters from all runs."""
    windows = [window_of(run) for run in clean_runs()]
    identify = partial(identify_global, _LAW, windows, LITERATURE, EvolutionSettings())
    return {"global_s": statistics.median(cpu_seconds(identify) for _ in range(repetitions))}


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
