"""Dampers with laws other than the sixteen-parameter law, and motions for them.

The parameters are invented, of the order of those in the literature; no such damper was measured.
The coil current of each damper lags the command.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from mr_damper_ros.emulation.motions import ChangedMotion, Excitation, SampledMotion, SineMotion
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet

_GRID = 5e-3
"""Sample period [s] of a motion up to about 20 Hz; a spline interpolates the samples."""

_RAMP = 0.5
"""Time [s] in which a random motion grows and fades."""


def _damper(model: str, **values: float) -> ParameterSet:
    names = MODELS[model].parameter_names
    defaults = dict.fromkeys(names, 0.0)
    return ParameterSet(
        np.array([{**defaults, **values}[name] for name in names]), set_id=model, model=model
    )


DAMPERS = {
    # 888 N at 5 mm, 1 Hz, 1.5 A.
    "viscous_tanh": _damper(
        "hyperbolic_tangent",
        c=2600.0,
        c_1=800.0,
        k=1500.0,
        alpha=95.0,
        alpha_1=6.2,
        alpha_2=-0.9,
        beta=110.0,
        delta=0.55,
        coil_time_constant=0.01,
    ),
    # A stiff damper of 1.3 kN, whose loop is rounded by the dashpot in series.
    "modified_bouc_wen": _damper(
        "modified_bouc_wen",
        c0=2500.0,
        c0_1=1.2,
        k0=800.0,
        c1=120e3,
        c1_1=0.5,
        k1=1200.0,
        f0=25.0,
        alpha=150.0,
        alpha_1=5.0,
        alpha_2=-0.5,
        yield_length=4e-4,
        share=0.5,
        n=1.6,
        coil_time_constant=0.02,
    ),
    # A small damper of 400 N with a high gas pressure: stiffness and offset.
    "bouc_wen": _damper(
        "bouc_wen",
        c0=1500.0,
        c0_1=0.8,
        k0=4000.0,
        f0=-40.0,
        alpha=70.0,
        alpha_1=3.0,
        alpha_2=-0.4,
        yield_length=6e-4,
        share=0.45,
        n=1.5,
        coil_time_constant=0.015,
    ),
}
"""The dampers by name."""


def random_motion(rms: float, low: float, high: float, duration: float, seed: int) -> SampledMotion:
    """Gaussian motion of ``rms`` [m] with a flat spectrum from ``low`` to ``high`` [Hz].

    It begins at rest and returns to rest by the end of the ``duration`` [s], because an abrupt stop
    would cause a large force.
    """
    rng = np.random.default_rng(seed)
    tones = 60
    rates = 2.0 * np.pi * (low + (high - low) * (np.arange(tones) + rng.random(tones)) / tones)
    end = duration + _RAMP
    time = np.arange(round(end / _GRID) + 1) * _GRID
    sines, cosines = (rms / math.sqrt(tones) * rng.standard_normal(tones) for _ in range(2))
    angles = np.outer(time, rates)
    ramp = np.sin(0.5 * np.pi * np.clip(np.minimum(time, end - time) / _RAMP, 0.0, 1.0)) ** 2
    return SampledMotion(ramp * (np.sin(angles) @ sines + np.cos(angles) @ cosines), _GRID)


def chirp(top_speed: float, most: float, low: float, high: float, duration: float) -> SampledMotion:
    """A repeated logarithmic sweep from ``low`` to ``high`` [Hz] and back.

    One direction takes a quarter of the ``duration`` [s]. The amplitude keeps the speed at
    ``top_speed`` [m/s], but does not exceed ``most`` [m].
    """
    grid = 1e-3
    time = np.arange(round(duration / grid) + 1) * grid
    way = 4.0 * time / duration
    height = 1.0 - np.abs(way % 2.0 - 1.0)
    frequency = low * (high / low) ** height
    phase = 2.0 * np.pi * np.cumsum(frequency) * grid
    amplitude = np.minimum(top_speed / (2.0 * np.pi * frequency), most)
    return SampledMotion(amplitude * np.sin(phase), grid)


def stairs(amplitude: float, frequency: float, factors: Sequence[float], each: float) -> Excitation:
    """A sine whose amplitude changes every ``each`` [s] to a multiple of ``amplitude`` [m]."""
    motion: Excitation = SineMotion(amplitude * factors[0], frequency)
    for place, (before, after) in enumerate(pairwise(factors), start=1):
        motion = ChangedMotion(motion, place * each, math.inf, 0.1, after / before)
    return motion


def stops(motion: Excitation, moving: float, resting: float, times: int) -> Excitation:
    """The motion with a rest of ``resting`` [s] after each ``moving`` [s]."""
    for place in range(times):
        begin = place * (moving + resting) + moving
        motion = ChangedMotion(motion, begin, begin + resting, 0.1, tempo=0.0)
    return motion
