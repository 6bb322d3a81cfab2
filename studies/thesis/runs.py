"""The conditions of the thesis, re-synthesised from its published parameter sets.

The recordings behind D. M. D. da Silva, "Comparative study of optimization algorithms for
parameter identification of the sigmoid model in MR dampers", University of Brasília, 2023, were
not published. Its tables 17-40 were; they list 34 conditions, each identified by two methods. A
re-synthesised run is the force of the Nelder-Mead set of a condition for the sinusoid that the
thesis fitted to its motion, with noise of the size that the thesis reports. Its details state that
it is not an original recording.

The thesis does not state two values, which are assumed: 1 ms between samples, and white noise of
1 micrometre on the displacement, the resolution of a laboratory displacement transducer.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from mr_damper_ros.emulation.emulator import (
    THESIS_FORCE_NOISE,
    EmulatedDamper,
    EmulatedRig,
    RigSettings,
)
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.published import (
    CONDITIONS,
    PUBLISHED_METHODS,
    Condition,
    find,
    parameters,
)
from mr_damper_ros.models.sigmoid import law
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording
from studies.thesis.facts import ERRATA, is_clean

SAMPLE_COUNT = 7001
"""Samples 3000 to 10000 of each run were used (appendix D)."""

SAMPLE_RATE = 1000.0
"""Assumed [Hz]; the thesis does not state the sampling period."""

PHASE = 4.481
"""Phase of the fitted sinusoid [rad] (appendix D)."""

DISPLACEMENT_NOISE = 1e-6
"""Assumed standard deviation [m]; the thesis states none."""

PROVENANCE = "re-synthesised from the published parameter sets; not the original recordings"


def recording_name(condition: Condition) -> str:
    """Name of the run of a condition; errata are marked in it."""
    return condition.name if is_clean(condition) else f"{condition.name}_erratum"


def synthesise(condition: Condition, *, seed: int = 0) -> Recording:
    """Run of a condition: 7001 samples; the same condition and seed give the same samples.

    Raises ConditionError if the thesis does not contain the condition.
    """
    values = parameters(condition)
    rig = EmulatedRig(
        EmulatedDamper(values),
        SineMotion(condition.amplitude, condition.frequency, phase=PHASE),
        condition.current,
        settings=RigSettings(
            sample_rate=SAMPLE_RATE,
            force_noise=THESIS_FORCE_NOISE,
            displacement_noise=DISPLACEMENT_NOISE,
            # Each condition has independent noise.
            seed=(seed, CONDITIONS.index(condition)),
        ),
    )
    details = {
        "condition": condition.name,
        "provenance": PROVENANCE,
        "source": "D. M. D. da Silva, University of Brasília, 2023, tables 17-40",
        "method": PUBLISHED_METHODS[0],
        "parameters": ", ".join(
            f"{name}={value}" for name, value in zip(law.PARAMETER_NAMES, values, strict=True)
        ),
        "force_noise_standard_deviation": f"{THESIS_FORCE_NOISE} N",
        "displacement_noise_standard_deviation": f"{DISPLACEMENT_NOISE} m",
        "seed": str(seed),
        "assumed": "1 ms between samples; white noise on the displacement",
    }
    if not is_clean(condition):
        details["erratum"] = ERRATA[condition]
    return rig.record(SAMPLE_COUNT / SAMPLE_RATE, name=recording_name(condition), details=details)


PHASES = 250
"""Phase bins of a cycle: the curvature of the loop within one is far below the noise."""


@lru_cache(maxsize=64)
def recording(name: str, seed: int) -> Recording:
    """Re-synthesised run of a condition."""
    return synthesise(find(name), seed=seed)


@lru_cache(maxsize=64)
def window(name: str, seed: int) -> Window:
    """The same as a window: fitted sine, force, current."""
    run = recording(name, seed)
    return Window.from_samples(run.displacement, run.force, run.current, run.period)


def title(name: str) -> str:
    """Name of a condition for readers: ``2.5 mm, 1 Hz, 0.0 A``."""
    condition = find(name)
    return (
        f"{1e3 * condition.amplitude:.1f} mm, {condition.frequency:g} Hz, {condition.current:.1f} A"
    )


def top_speed(condition: Condition) -> float:
    """Peak velocity [m/s]."""
    return 2.0 * math.pi * condition.frequency * condition.amplitude


def coefficients(parameters: Array, peak_velocity: float, current: float) -> Array:
    """Seven operating-point coefficients (..., 7) of sets (..., 16), with positive f_t."""
    parts = law.operating_point_coefficients(parameters, peak_velocity, current)
    values = np.concatenate(parts, axis=-1)
    values[..., :2] *= law.sign_of_pair(values[..., :1])
    return values


class Loop(NamedTuple):
    """One cycle: displacement [m], velocity [m/s], force [N], each of shape (n,)."""

    displacement: Array
    velocity: Array
    force: Array


def loop(parameters: Array, condition: Condition, points: int = 240) -> Loop:
    """Loop of a parameter set (16,) in a condition, without noise."""
    angle = np.linspace(0.0, 2.0 * np.pi, points)
    u, v = condition.amplitude * np.sin(angle), top_speed(condition) * np.cos(angle)
    a = -((2.0 * np.pi * condition.frequency) ** 2) * u
    return Loop(u, v, law.sine_force(parameters, u, v, a, condition.current))


ACROSS = {"velocity": "Velocity [m/s]", "displacement": "Displacement [mm]"}
"""Labels of the axes over which :func:`draw_loop` draws the force."""


def draw_loop(
    axis: Any, parameters: Array, condition: Condition, against: str = "velocity", **style: Any
) -> None:
    """Draw the loop of a set (16,) against velocity or displacement."""
    turn = loop(parameters, condition)
    x = turn.velocity if against == "velocity" else 1e3 * turn.displacement
    axis.plot(x, turn.force, **style)


class CycleMisfit:
    """Misfit of a steady run as a function of the sixteen parameters, on phase bins.

    In a steady cycle, the samples at one phase differ only by noise. Their mean and number
    therefore contain all information about the model, and the scatter about a line within the bins
    is constant. ``costs`` is the mean square error [N²] over all samples, including that constant.
    ``window`` is the averaged cycle.
    """

    def __init__(self, run: Window, bins: int) -> None:
        sine = run.motion.sine
        if sine is None:
            raise ValueError("the run is no steady sine: it has no phase to average over")
        omega = 2.0 * np.pi * sine.frequency
        phase = np.arctan2(run.motion.displacement * omega, run.motion.velocity)
        bin_of = np.minimum(((phase / (2.0 * np.pi)) % 1.0 * bins).astype(int), bins - 1)
        count = np.bincount(bin_of, minlength=bins)
        used = count > 0
        number = np.maximum(count, 1)

        def mean(values: Array) -> Array:
            return np.asarray(np.bincount(bin_of, values, minlength=bins) / number)

        centre = 2.0 * np.pi / bins * (bin_of + 0.5)
        # Within a bin the phase runs over less than a turn about its centre.
        from_centre = (phase - centre + np.pi) % (2.0 * np.pi) - np.pi
        step = from_centre - mean(from_centre)[bin_of]
        deviation = run.force - mean(run.force)[bin_of]
        slope = mean(step * deviation) / np.maximum(mean(step * step), 1e-300)
        self.within = float(np.mean((deviation - slope[bin_of] * step) ** 2))
        self.force = mean(run.force)[used]
        angle = (2.0 * np.pi / bins * (np.arange(bins) + 0.5) + mean(from_centre))[used]
        self.velocity = sine.amplitude * omega * np.cos(angle)
        self.displacement = sine.amplitude * np.sin(angle)
        self.weight = count[used] / run.sample_count
        self.peak_velocity = sine.amplitude * omega
        self.current = float(run.current[0])
        self.sample_count = run.sample_count
        self.power = float(np.var(run.force))
        u, ones = self.displacement, np.ones(self.force.size)
        motion = Motion(u, self.velocity, -u, self.peak_velocity * ones, sine)
        self.window = Window(motion, self.force, self.current * ones)
        self._forces = MODELS["sigmoid"].window_forces([self.window])

    def residual(self, parameters: Array) -> Array:
        """Model minus mean force [N], shape (..., bins)."""
        (force,) = self._forces.forces(parameters)
        return np.asarray(force - self.force)

    def costs(self, parameters: Array) -> Array:
        """Mean square error [N²] of sets of shape (..., 16)."""
        return np.asarray(np.square(self.residual(parameters)) @ self.weight + self.within)

    def jacobian(self, parameters: Array) -> Array:
        """Derivatives of the residual (bins, 16) for one set."""
        (derivatives,) = self._forces.derivatives(parameters, range(parameters.size))
        return derivatives


@lru_cache(maxsize=64)
def cycle(name: str, seed: int, bins: int = PHASES) -> CycleMisfit:
    """Misfit of a re-synthesised run on phase bins."""
    return CycleMisfit(window(name, seed), bins)
