"""The hysteretic benchmark for our laws, and estimated in its own form.

A law gets the displacement and answers with the force that the spring, the damper and the
hysteresis give together, which is what a load cell between them and the mass would read; then its
set takes their place under the mass, and answers a force with a displacement.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet, start_set
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.study.hysteretic_oscillator import (
    BAND,
    OUTPUT_NOISE,
    PERIOD,
    STEPS,
    TRUTH,
    HystereticOscillator,
    multisine,
    settled,
    sine_sweep,
    thinned,
)

_ESTIMATION, _TEST, _NOISE = 0, 1, 2
"""Seeds."""

_LAW_STEPS = 5
"""Steps to a sample where a law stands under the mass."""

_ROUNDS = 2
_SHOWN = 400


@dataclass(frozen=True)
class OscillatorTrial:
    """A law; ``count`` samples of a multisine. ``moves``: whether it is put under the mass too."""

    law: str
    count: int
    moves: bool


@dataclass(frozen=True, eq=False)
class OscillatorResult:
    """NRMSE [1] of the force on the multisine it was identified from and on another.

    ``missed`` [m]: RMS error of the displacement under another multisine, NaN where the law was not
    put under the mass; ``loop`` (3, n): displacement [m], true and predicted force [N].
    """

    parameter_set: ParameterSet
    identified: float
    other: float
    missed: float
    loop: Array
    seconds: float


@dataclass(frozen=True)
class EstimationTrial:
    """``count`` samples of a multisine, and seconds of a sweep.

    ``steps``: of the estimation to a sample; the truth always has all of its own.
    """

    count: int
    steps: int
    sweep: float


@dataclass(frozen=True, eq=False)
class EstimationResult:
    """The oscillator estimated, with standard errors (6,); RMS errors [m] under other forces.

    ``linear``: mass, damping and stiffness of the best linear oscillator, where it began;
    ``linear_error`` [m] its RMS error on the other multisine.
    """

    found: HystereticOscillator
    standard_errors: Array
    multisine_error: float
    sweep_error: float
    linear: tuple[float, float, float]
    linear_error: float
    evaluations: int
    seconds: float


def judge_on_oscillator(task: OscillatorTrial) -> OscillatorResult:
    """Identify a law from displacement to force, and judge it on another multisine."""
    began = time.process_time()
    model = MODELS[task.law]
    known, other = (_window(seed, task.count) for seed in (_ESTIMATION, _TEST))
    fit = identify_global(model, [known], start_set(task.law).values, EvolutionSettings())
    found = fit.parameter_set
    held = other.held_within(*found.peak_velocity_range)
    predicted = model.window_force(held, found.values)
    counted = model.settled(held, found.values)
    residual = (predicted - other.force)[counted]
    missed = math.nan
    if task.moves:
        answer = _moved(found, multisine(_TEST, task.count, _LAW_STEPS))
        truth = settled(TRUTH, multisine(_TEST, task.count))
        missed = _rms(answer - truth.displacement)
    shown = slice(-_SHOWN, None)
    return OscillatorResult(
        found,
        float(fit.nrmse[0]),
        _rms(residual) / float(np.std(other.force[counted])),
        missed,
        np.stack([other.motion.displacement[shown], other.force[shown], predicted[shown]]),
        time.process_time() - began,
    )


def _window(seed: int, count: int) -> Window:
    """Displacement and force of what holds the mass, without noise, at no current."""
    answer = settled(TRUTH, multisine(seed, count))
    force = (
        TRUTH.damping * answer.velocity + TRUTH.stiffness * answer.displacement + answer.hysteretic
    )
    return Window.from_samples(answer.displacement, force, 0.0, PERIOD)


def _moved(found: ParameterSet, period: Array) -> Array:
    """Displacement [m] at the samples of the mass on a law, under a force that goes on for ever."""
    step, count = PERIOD / _LAW_STEPS, period.size // _LAW_STEPS
    half, mass = 0.5 * step, TRUTH.mass
    current, state = np.zeros(1), None
    y = v = a = 0.0
    rows = []
    for u in np.concatenate((period, period, period[: period.size // 2])).tolist():
        fast = v + step * a
        for _ in range(_ROUNDS):
            motion = _one(y + half * (v + fast), fast, a)
            force, after = found.law.follow(found.values, motion, current, step, state)
            late = (u - float(force[0])) / mass
            fast = v + half * (a + late)
        y += half * (v + fast)
        v, a = fast, late
        state = after
        rows.append(y)
    return thinned(np.array(rows), _LAW_STEPS)[count : 2 * count]


def _one(displacement: float, velocity: float, acceleration: float) -> Motion:
    return Motion(
        np.array([displacement]),
        np.array([velocity]),
        np.array([acceleration]),
        np.array([abs(velocity)]),
        None,
    )


def estimate_oscillator(task: EstimationTrial) -> EstimationResult:
    """Estimate the six numbers from force and noisy displacement, and judge them on other forces.

    Least squares of the simulated displacement, from the best linear oscillator on; nothing of the
    truth is used but the form of its equations.
    """
    from scipy.optimize import least_squares  # here: see mr_damper_ros.entry_points

    began = time.process_time()
    noise = OUTPUT_NOISE * np.random.default_rng(_NOISE).standard_normal(task.count)
    measured = settled(TRUTH, multisine(_ESTIMATION, task.count)).displacement + noise
    force = multisine(_ESTIMATION, task.count, task.steps)
    linear = _linear(force[:: task.steps], measured)
    mass, damping, stiffness = linear
    bend = 0.1 / float(np.std(measured))
    start = np.array([mass, abs(damping), 0.5 * stiffness, 0.5 * stiffness, bend, bend])

    def residual(values: Array) -> Array:
        answer = settled(HystereticOscillator(*values), force, task.steps)
        return (answer.displacement - measured) / OUTPUT_NOISE

    with np.errstate(over="ignore", invalid="ignore"):
        fit = least_squares(residual, start, x_scale=start)
    found = HystereticOscillator(*fit.x.tolist())
    errors = np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac)))
    straight = HystereticOscillator(mass, damping, stiffness, 0.0, 0.0, 0.0)
    other = multisine(_TEST, task.count, task.steps)
    truth = settled(TRUTH, multisine(_TEST, task.count)).displacement
    on_other = (
        _rms(settled(each, other, task.steps).displacement - truth) for each in (found, straight)
    )
    multisine_error, linear_error = on_other
    return EstimationResult(
        found,
        errors,
        multisine_error,
        _sweep_error(found, task),
        linear,
        linear_error,
        fit.nfev * (1 + start.size),
        time.process_time() - began,
    )


def _sweep_error(found: HystereticOscillator, task: EstimationTrial) -> float:
    answers = [
        thinned(oscillator.simulate(sine_sweep(task.sweep, steps), PERIOD / steps)[0], steps)
        for oscillator, steps in ((found, task.steps), (TRUTH, STEPS))
    ]
    return _rms(answers[0] - answers[1])


def _linear(force: Array, displacement: Array) -> tuple[float, float, float]:
    """Mass, damping and stiffness with (m s² + c s + k) Y = U at the lines of the multisine."""
    frequencies = np.fft.rfftfreq(force.size, PERIOD)
    lines = (frequencies >= BAND[0]) & (frequencies <= BAND[1])
    s = 2j * math.pi * frequencies[lines]
    spectrum = np.fft.rfft(displacement)[lines]
    terms = np.stack([s * s * spectrum, s * spectrum, spectrum], axis=1)
    drive = np.fft.rfft(force)[lines]
    solution = np.linalg.lstsq(
        np.concatenate((terms.real, terms.imag)),
        np.concatenate((drive.real, drive.imag)),
        rcond=None,
    )[0]
    mass, damping, stiffness = solution.tolist()
    return mass, damping, stiffness


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
