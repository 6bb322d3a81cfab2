"""Dampers of laws unlike the sixteen, and motions for them.

The parameters are invented, in the size of the literature's: no such damper was measured. The
coil of each lags.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from mr_damper_ros.emulation.motions import (
    EnvelopedMotion,
    Excitation,
    SampledMotion,
    SineMotion,
    WarpedMotion,
)
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet

_GRID = 5e-3
"""Period [s] of the samples of a motion of up to some 20 Hz; a spline goes through them."""

_RAMP = 0.5
"""Seconds in which a random motion begins and ends."""


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
    # A stiff one of 1.3 kN, rounded by the damper in series.
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
    # A small one of 400 N with much gas: stiffness and offset.
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
"""By name."""


def random_motion(rms: float, low: float, high: float, duration: float, seed: int) -> SampledMotion:
    """Gaussian motion of ``rms`` [m], of a flat spectrum from ``low`` to ``high`` [Hz].

    It begins at rest, and comes to rest after the ``duration`` [s]: a machine that stops at once
    would tear at the damper.
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
    """A sine from ``low`` to ``high`` [Hz] and back, again and again, evenly in their logarithm.

    One way takes a quarter of the ``duration`` [s]. The amplitude keeps the ``top_speed`` [m/s],
    but is ``most`` [m] at most.
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
    """A sine whose amplitude is so many times ``amplitude`` [m] for ``each`` [s] in turn."""
    motion: Excitation = SineMotion(amplitude * factors[0], frequency)
    for place, (before, after) in enumerate(pairwise(factors), start=1):
        motion = EnvelopedMotion(motion, after / before, place * each, math.inf, 0.1)
    return motion


def stops(motion: Excitation, moving: float, resting: float, times: int) -> Excitation:
    """The motion, standing still for ``resting`` [s] after each ``moving`` [s]."""
    for place in range(times):
        begin = place * (moving + resting) + moving
        motion = WarpedMotion(motion, 0.0, begin, begin + resting, 0.1)
    return motion
