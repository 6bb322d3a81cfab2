"""Random motion with random current at 100 Hz: the law that made it, and the mass before it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import mr_damper_ros as mr
from benchmarks.dampers import ForeignDamper
from benchmarks.figure import Measured
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.peak_velocity import peak_velocity_of_period
from mr_damper_ros.kinematics.periodic_motion import MotionKind, PeriodicMotion
from mr_damper_ros.signals.arrays import Array
from studies.recordings import rms

FOREIGN = {
    "hyperbolic_tangent": "herschel_bulkley",
    "bouc_wen": "gas_bouc_wen",
    "modified_bouc_wen": "gas_bouc_wen",
    "series_springs": "gas_bouc_wen",
    "sigmoid": "herschel_bulkley",
    "sigmoid_lag": "gas_bouc_wen",
}
"""The laws, and the foreign damper from which each gets its true parameters."""

_MASS, _NOISE = 2.0, 0.03
"""Kilograms before the load cell; part of the standard deviation of the force."""

_FINE, _STRIDE, _DURATION = 1e-3, 10, 60.0
_HELD, _TOP = 0.5, 1.2
"""Each current holds for this time [s]; largest current [A]."""

_IDENTIFIED = 0.85


def _driven(duration: float, seed: int) -> tuple[Motion, Array]:
    """Motion up to 12 Hz and current, sampled finely."""
    time: Array = np.arange(round(duration / _FINE), dtype=float) * _FINE
    u, v, a = PeriodicMotion(MotionKind.RANDOM, 0.02, 0.5, 12.0, duration, seed).at(time)
    held = round(_HELD / _FINE)
    current = np.random.default_rng(seed).uniform(0.0, _TOP, time.size // held)
    motion = Motion(u, v, a, peak_velocity_of_period(v, a, _FINE), sine=None)
    return motion, np.repeat(current, held)


def trial(law: str, seed: int = 1) -> tuple[float, float]:
    """RMS error on the last 15 % over the noise, and the mass found over the true one."""
    motion, current = _driven(40.0, seed + 100)
    foreign = ForeignDamper(FOREIGN[law]).force(motion, current, 28.0, _FINE)
    truth = mr.identify(
        displacement=motion.displacement, force=foreign, current=current, period=_FINE, model=law
    ).parameter_set
    motion, current = _driven(_DURATION, seed)
    force, _ = truth.follow(motion, current, _FINE, None, gradual=True)
    force = (force + _MASS * motion.acceleration)[::_STRIDE]
    noise = _NOISE * np.std(force) * np.random.default_rng(seed).standard_normal(force.size)
    run: dict[str, Any] = {
        "displacement": motion.displacement[::_STRIDE],
        "force": force + noise,
        "current": current[::_STRIDE],
    }
    count, period = round(_IDENTIFIED * force.size), _STRIDE * _FINE
    first = {name: values[:count] for name, values in run.items()}
    found = mr.identify(**first, period=period, model=law, fit_mass=True)
    mass = 0.0 if found.mass is None else found.mass.value
    residual = mr.validate(found.parameter_set, **run, period=period, mass=mass).runs[0]
    return rms(residual.comparison.residual[count:]) / rms(noise[count:]), mass / _MASS


def figures(laws: Sequence[str] = tuple(FOREIGN), seed: int = 0) -> Measured:
    """The six laws in turn."""
    found = [trial(law, 1 + seed) for law in laws]
    note = ", ".join(laws)
    return {
        "random_current_error": ([error for error, _ in found], note),
        "random_current_mass": ([mass for _, mass in found], note),
    }
