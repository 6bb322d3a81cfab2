"""What a sample of the inverse of the law costs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.figure import Figure
from benchmarks.timing import cpu_seconds
from mr_damper_ros.control.inverse_model import InverseModel, Inversion
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import CONDITIONS, PUBLISHED_METHODS, parameters
from mr_damper_ros.signals.arrays import Array

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


def figures() -> list[Figure]:
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
