"""The hysteretic benchmark of Noël and Schoukens: a mass on a spring and a Bouc-Wen hysteresis.

J. P. Noël and M. Schoukens, Hysteretic benchmark with a dynamic nonlinearity, Workshop on Nonlinear
System Identification Benchmarks, Brussels, 2016. Equations, parameters, steps and signals follow
its public descriptions. Its files are not needed, because this module simulates everything:

    m y'' + c y' + k y + z = u,    z' = alpha y' - beta (gamma |y'| z + delta y' |z|)

The integration uses Newmark's method with constant average acceleration, and the trapezoidal rule
for z. As in the benchmark, a sample of 1/750 s has 20 steps. Filtering and decimation then keep the
frequencies below half the sample rate.

First, a law of this package predicts the total force of spring, damper and hysteresis from the
displacement, as a load cell between these elements and the mass would measure it. The identified
set then replaces these elements under the mass, and the displacement under an external force is
simulated. Finally, the parameters of the true equations are estimated.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet, start_set
from mr_damper_ros.processes.files import json_ready
from mr_damper_ros.report import document
from mr_damper_ros.signals.arrays import Array
from studies.drawing import chapter
from studies.program import Campaign
from studies.recordings import rms
from studies.truth.records import QUICK_LAWS

PERIOD = 1.0 / 750.0
"""Sample period [s]."""

STEPS = 20
"""Simulation steps per sample."""

COUNT = 8192
"""Samples in a period of a multisine."""

BAND = (5.0, 150.0)
"""Band of a multisine [Hz]."""

FORCE_RMS = 50.0
"""Root mean square force of a multisine [N]."""

OUTPUT_NOISE = 8e-6
"""Standard deviation [m] of the displacement noise in the estimation of a model."""

_SWEEP_FORCE, _SWEEP_FROM, _SWEEP_TO, _SWEEP_RATE = 40.0, 20.0, 50.0, 10.0 / 60.0

_THINNING = (2, 2, 5)
"""Decimation factors from the simulation steps to the samples."""

_CLOSE = 1e-12
"""A step has converged if the velocity changes by less than this fraction of its magnitude."""

_MOST_ROUNDS = 20


@dataclass(frozen=True)
class HystereticOscillator:
    """Mass [kg], damping [N s/m], stiffness [N/m] and the hysteresis; the defaults are the truth.

    ``alpha`` [N/m] is the stiffness of the hysteresis at rest. ``with_speed`` is beta gamma and
    ``with_motion`` is beta delta [1/m]: only these products are identifiable.
    """

    mass: float = 2.0
    damping: float = 10.0
    stiffness: float = 5e4
    alpha: float = 5e4
    with_speed: float = 1e3 * 0.8
    with_motion: float = 1e3 * -1.1

    def rate(self, velocity: float, z: float) -> float:
        """Derivative of z [N/s]."""
        return (
            self.alpha * velocity
            - self.with_speed * abs(velocity) * z
            - self.with_motion * velocity * abs(z)
        )

    def simulate(self, force: Array, step: float) -> Response:
        """Response from rest to a force (n,) [N] given every ``step`` [s]."""
        m, c, k = self.mass, self.damping, self.stiffness
        half = 0.5 * step
        held = 2.0 * m / step + c + k * half
        y = v = z = rate = 0.0
        a = float(force[0]) / m
        rows = [(y, v, a, z)]
        for u in force[1:].tolist():
            known = u - k * (y + half * v) + m * (2.0 * v / step + a)
            fast, begun = v + step * a, z + half * rate
            late = z
            for _ in range(_MOST_ROUNDS):
                late = begun + half * self.rate(fast, late)
                found = (known - late) / held
                change, fast = found - fast, found
                if abs(change) <= _CLOSE * abs(found):
                    break
            y += half * (v + fast)
            a = 2.0 * (fast - v) / step - a
            v, z = fast, late
            rate = self.rate(v, z)
            rows.append((y, v, a, z))
        return Response(*np.array(rows).T)


class Response(NamedTuple):
    """Displacement [m], velocity [m/s], acceleration [m/s²], hysteretic force [N]; each (n,)."""

    displacement: Array
    velocity: Array
    acceleration: Array
    hysteretic: Array


TRUTH = HystereticOscillator()


def multisine(seed: int, count: int = COUNT, steps: int = STEPS) -> Array:
    """One period (count * steps,) [N] of a random-phase multisine at the simulation steps."""
    lines = np.fft.rfftfreq(count, PERIOD)
    chosen = np.flatnonzero((lines >= BAND[0]) & (lines <= BAND[1]))
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * math.pi, chosen.size)
    spectrum = np.zeros(count * steps // 2 + 1, dtype=complex)
    spectrum[chosen] = np.exp(1j * phases)
    signal = np.fft.irfft(spectrum, count * steps)
    return np.asarray(FORCE_RMS * signal / np.sqrt(np.mean(signal**2)))


def sine_sweep(duration: float = math.inf, steps: int = STEPS) -> Array:
    """A sweep (n,) [N] of 40 N from 20 to 50 Hz at 10 Hz per minute, or the beginning of it."""
    longest = (_SWEEP_TO - _SWEEP_FROM) / _SWEEP_RATE
    time = np.arange(0.0, min(duration, longest), PERIOD / steps)
    return np.asarray(
        _SWEEP_FORCE * np.sin(2.0 * math.pi * (_SWEEP_FROM * time + 0.5 * _SWEEP_RATE * time**2))
    )


def thinned(signal: Array, steps: int = STEPS) -> Array:
    """A simulated signal decimated to the samples, after an anti-aliasing filter."""
    from scipy.signal import decimate  # here: see mr_damper_ros.entry_points

    for factor in _THINNING:
        if steps % factor == 0:
            signal = decimate(signal, factor, ftype="fir")
            steps //= factor
    return np.asarray(signal)


def settled(oscillator: HystereticOscillator, period: Array, steps: int = STEPS) -> Response:
    """Steady-state response at the samples to a periodic force: the second of two periods.

    A third period is simulated after them, so that the decimation filters have no edge effect.
    """
    half = period.size // 2
    force = np.concatenate((period, period, period[:half]))
    answer = oscillator.simulate(force, PERIOD / steps)
    count = period.size // steps
    return Response(*(thinned(part, steps)[count : 2 * count] for part in answer))


# -- the laws of this package, and the true equations estimated ------------------------------------

_ESTIMATION, _TEST, _NOISE = 0, 1, 2
"""Seeds of the signals."""

_LAW_STEPS = 5
"""Simulation steps per sample with a law under the mass."""

_ROUNDS = 2
_SHOWN = 400

QUICK = {"count": 1024, "steps": 5, "sweep": 10.0}
"""Arguments of :func:`estimate_oscillator` in the short variant."""

_NEEDS_PEAKS = ("sigmoid", "sigmoid_lag")
"""Laws that depend on the peak velocity, which is known only after the motion of the mass."""


def judge_on_oscillator(law: str, count: int) -> dict[str, Any]:
    """Task: identify a law from displacement to force, and evaluate it on a second multisine.

    Both have ``count`` samples. Returns the NRMSE [1] of the force on the multisine of the
    identification (``identified``) and on the ``other``, the RMS error ``missed`` [m] of the
    displacement under the other (NaN if the law was not put under the mass), and a ``loop`` (3, n):
    displacement [m], true and predicted force [N].
    """
    began = time.process_time()
    model = MODELS[law]
    known, other = (_window(seed, count) for seed in (_ESTIMATION, _TEST))
    fit = identify_global(model, [known], start_set(law).values, EvolutionSettings())
    found = fit.parameter_set
    predicted = found.window_force(other)
    counted = found.settled(other)
    residual = (predicted - other.force)[counted]
    missed = math.nan
    if law not in _NEEDS_PEAKS:
        answer = _moved(found, multisine(_TEST, count, _LAW_STEPS))
        missed = rms(answer - settled(TRUTH, multisine(_TEST, count)).displacement)
    loop = np.stack([other.motion.displacement, other.force, predicted])[:, -_SHOWN:]
    return {
        "identified": float(fit.nrmse[0]),
        "other": rms(residual) / float(np.std(other.force[counted])),
        "missed": missed,
        "loop": loop,
        "seconds": time.process_time() - began,
    }


def _window(seed: int, count: int) -> Window:
    """Displacement and force of the elements under the mass, without noise, at zero current."""
    answer = settled(TRUTH, multisine(seed, count))
    force = (
        TRUTH.damping * answer.velocity + TRUTH.stiffness * answer.displacement + answer.hysteretic
    )
    return Window.from_samples(answer.displacement, force, 0.0, PERIOD)


def _moved(found: ParameterSet, period: Array) -> Array:
    """Steady-state displacement [m] at the samples: a law under the mass, a periodic force."""
    step, count = PERIOD / _LAW_STEPS, period.size // _LAW_STEPS
    half, mass = 0.5 * step, TRUTH.mass
    current, state = np.zeros(1), None
    y = v = a = 0.0
    rows = []
    for u in np.concatenate((period, period, period[: period.size // 2])).tolist():
        fast = v + step * a
        for _ in range(_ROUNDS):
            place, speed, rate = np.array([[y + half * (v + fast)], [fast], [a]])
            motion = Motion(place, speed, rate, np.abs(speed), None)
            force, after = found.law.follow(found.values, motion, current, step, state)
            late = (u - float(force[0])) / mass
            fast = v + half * (a + late)
        y += half * (v + fast)
        v, a = fast, late
        state = after
        rows.append(y)
    return thinned(np.array(rows), _LAW_STEPS)[count : 2 * count]


def estimate_oscillator(count: int, steps: int, sweep: float) -> dict[str, Any]:
    """Task: estimate six parameters from force and noisy displacement, test them on other forces.

    The estimation minimises the squared error of the simulated displacement and starts from the
    best linear oscillator. It uses only the form of the true equations. ``count`` samples of a
    multisine are simulated with ``steps`` each (the truth always with its own number), and a sweep
    of a duration [s]. Returns the ``values`` and standard ``errors`` (6,), the number of
    simulations, and RMS errors [m]: ``multisine``, ``sweep``, and that of the ``linear`` start.
    """
    from scipy.optimize import least_squares  # here: see mr_damper_ros.entry_points

    began = time.process_time()
    noise = OUTPUT_NOISE * np.random.default_rng(_NOISE).standard_normal(count)
    measured = settled(TRUTH, multisine(_ESTIMATION, count)).displacement + noise
    force = multisine(_ESTIMATION, count, steps)
    mass, damping, stiffness = _linear(force[::steps], measured)
    bend = 0.1 / float(np.std(measured))
    start = np.array([mass, abs(damping), 0.5 * stiffness, 0.5 * stiffness, bend, bend])

    def residual(values: Array) -> Array:
        answer = settled(HystereticOscillator(*values), force, steps)
        return (answer.displacement - measured) / OUTPUT_NOISE

    with np.errstate(over="ignore", invalid="ignore"):
        fit = least_squares(residual, start, x_scale=start)
    found = HystereticOscillator(*fit.x.tolist())
    straight = HystereticOscillator(mass, damping, stiffness, 0.0, 0.0, 0.0)
    other = multisine(_TEST, count, steps)
    truth = settled(TRUTH, multisine(_TEST, count)).displacement
    swept, true = (
        thinned(each.simulate(sine_sweep(sweep, fine), PERIOD / fine)[0], fine)
        for each, fine in ((found, steps), (TRUTH, STEPS))
    )
    return {
        "values": fit.x.tolist(),
        "errors": np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac))).tolist(),
        "simulations": fit.nfev * (1 + start.size),
        "multisine": rms(settled(found, other, steps).displacement - truth),
        "linear": rms(settled(straight, other, steps).displacement - truth),
        "sweep": rms(swept - true),
        "seconds": time.process_time() - began,
    }


def _linear(force: Array, displacement: Array) -> tuple[float, float, float]:
    """Mass, damping and stiffness that satisfy (m s² + c s + k) Y = U at the multisine lines."""
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


_PUBLISHED = {
    "quadratic terms": (-85.32, 34),
    "degrees 2 and 3": (-90.35, 64),
    "degrees 2 to 5": (-94.87, 172),
    "degrees 2 to 7": (-97.96, 364),
    "degrees 3, 5 and 7": (-98.32, 217),
}
"""RMS error on the test multisine [dB of 1 m] and number of parameters of black-box models.

Polynomial nonlinear state-space models of J. P. Noël, A. F. Esfahani, G. Kerschen and J. Schoukens,
A nonlinear state-space approach to hysteresis identification, Mechanical Systems and Signal
Processing 84, 2017 (arXiv 1610.09138).
"""

_NUMBERS = (
    ("m", "mass", "kg"),
    ("c", "damping", "N s/m"),
    ("k", "stiffness", "N/m"),
    ("α", "alpha", "N/m"),
    ("βγ", "with_speed", "1/m"),
    ("βδ", "with_motion", "1/m"),
)


def oscillator_part(campaign: Campaign) -> Iterator[document.Chapter]:
    """Results from motion to force, and from force to motion."""
    laws = QUICK_LAWS if campaign.quick else tuple(MODELS)
    task = QUICK if campaign.quick else {"count": COUNT, "steps": STEPS, "sweep": math.inf}
    name = "laws on the benchmark"
    found = campaign.each(name, judge_on_oscillator, laws, count=task["count"])
    name = "estimation of the benchmark"
    estimation = campaign.each(name, estimate_oscillator, [()], **task)[()]
    truths = [float(getattr(TRUTH, name)) for _, name, _ in _NUMBERS]
    numbers = [
        (symbol, name, unit, truth, value, error)
        for (symbol, name, unit), truth, value, error in zip(
            _NUMBERS, truths, estimation["values"], estimation["errors"], strict=True
        )
    ]
    campaign.figures["oscillator"] = {
        "laws": {
            law: {
                "force_nrmse_identified": result["identified"],
                "force_nrmse_other": result["other"],
                "motion_rms_error": json_ready(result["missed"]),
                "seconds": result["seconds"],
            }
            for law, result in found.items()
        },
        "estimation": {
            name: {"truth": truth, "value": value, "standard_error": error, "unit": unit}
            for _, name, unit, truth, value, error in numbers
        },
        **{f"{key}_rms_error": estimation[key] for key in ("multisine", "sweep", "linear")},
        "estimation_s": estimation["seconds"],
    }
    yield _chapter(found, estimation, numbers)


def _chapter(
    found: Mapping[str, Any], estimation: Mapping[str, Any], numbers: list[tuple[Any, ...]]
) -> document.Chapter:
    best = min(found, key=lambda law: found[law]["other"])
    off = max(abs(value / truth - 1.0) for _, _, _, truth, value, _ in numbers)
    own = [
        ("true equations, estimated", 6, *_missed(estimation["multisine"])),
        ("linear oscillator, estimated", 3, *_missed(estimation["linear"])),
        *(
            (f"published, black box: {name}", count, 1e6 * 10.0 ** (error / 20.0), error)
            for name, (error, count) in _PUBLISHED.items()
        ),
    ]
    return chapter(
        "oscillator",
        "The hysteretic benchmark",
        f"the six parameters of the true equations are estimated to within {off:.1%}, and the "
        f"motion to {1e6 * estimation['multisine']:.2g} µm; of the laws, which describe dampers "
        f"that yield, {best} is best with an NRMSE of {found[best]['other']:.0%}.",
        "Noël and Schoukens (2016): m y'' + c y' + k y + z = u with z' = α y' − β (γ |y'| z + δ y' "
        "|z|), m = 2 kg, c = 10 N s/m, k = α = 50 kN/m, β = 1000, γ = 0.8, δ = −1.1 (ν = 1), "
        "excited by a random-phase multisine of 50 N RMS from 5 to 150 Hz. As published, it is "
        "simulated with Newmark's method at 15 000 steps per second and sampled at 750 Hz. The "
        "signals are generated by the published method; they are not the files of the benchmark.",
        "Motion to force: the laws predict the total force of spring, damper and hysteresis from "
        "the displacement. Here γ + δ is negative, so the hysteresis hardens under load and never "
        "yields. In the laws bouc_wen and modified_bouc_wen, as in any MR damper, the hysteresis "
        "yields. No law therefore contains the true system, and a model error remains. Their share "
        "and sharpness end at a bound.",
        document.Table(
            "oscillator_laws",
            "Each law was identified from the displacement under one multisine and evaluated on "
            "another: NRMSE of the force in percent; RMS error of the displacement with the set "
            "under the mass, also in dB of 1 m. –: the law needs the peak velocity, which is "
            "unknown here.",
            "law | parameters | force, identified | force, other | motion (µm) | motion (dB)",
            [
                (
                    *(law, len(MODELS[law].parameters)),
                    *(100.0 * result["identified"], 100.0 * result["other"]),
                    *_missed(result["missed"]),
                )
                for law, result in found.items()
            ],
        ),
        _loops(found),
        "Force to motion: the parameters of the true equations are estimated by least squares of "
        "the displacement, starting from the best linear oscillator. One of β, γ and δ is "
        "redundant: only their products are identifiable.",
        document.Table(
            "oscillator_numbers",
            "The six parameters, estimated from one multisine and the displacement with "
            f"{1e6 * OUTPUT_NOISE:g} µm of noise, in {estimation['simulations']} simulations and "
            f"{estimation['seconds']:.0f} s.",
            "| truth | estimate ± standard error | unit | error (%)",
            [
                (symbol, truth, document.with_error(value, error), unit, 100 * (value / truth - 1))
                for symbol, _, unit, truth, value, error in numbers
            ],
        ),
        document.Table(
            "oscillator_errors",
            "RMS error of the simulated displacement under a multisine that was not used in the "
            "estimation, without noise. The published models do not use the equations (black box) "
            "and were evaluated on the multisine of the benchmark: Noël, Esfahani, Kerschen and "
            "Schoukens, Mech. Syst. Signal Process. 84, 2017 (arXiv 1610.09138). Under a sweep "
            "from 20 to 50 Hz with 40 N, the error of the equations estimated here is "
            f"{1e6 * estimation['sweep']:.2g} µm.",
            "model | parameters | error (µm) | error (dB of 1 m)",
            own,
        ),
    )


def _loops(found: Mapping[str, Any]) -> document.Picture:
    chosen = sorted(found, key=lambda law: found[law]["other"])[:3]
    picture, axes = document.chart(
        "oscillator",
        "Loops of the three best laws in half a second of the other multisine.",
        (1, len(chosen), 6.8, 2.8),
        sharey=True,
    )
    for axis, law in zip(axes[0], chosen, strict=True):
        displacement, truth, predicted = found[law]["loop"]
        axis.plot(1e3 * displacement, truth, color=document.GREY, linewidth=2.0, label="truth")
        axis.plot(1e3 * displacement, predicted, label="law", color=document.INK[1], linewidth=0.8)
        axis.set(xlabel="displacement (mm)", title=law)
    axes[0, 0].set(ylabel="force (N)")
    document.legend_above(axes[0, 0], 2)
    return picture


def _missed(error: float) -> tuple[float | None, float | None]:
    """An error [m] in µm and in dB."""
    if not math.isfinite(error):
        return None, None
    return 1e6 * error, 20.0 * float(np.log10(error))
