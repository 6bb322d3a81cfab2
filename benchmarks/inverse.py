"""The inverse of the law: by how much a wanted force is missed, and what a sample costs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.figure import Figure
from benchmarks.timing import cpu_seconds
from mr_damper_ros.control.inverse_model import InverseModel, Inversion
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL, ParameterSet
from mr_damper_ros.models.published import CONDITIONS, PUBLISHED_METHODS, parameters
from mr_damper_ros.signals.arrays import Array
from studies import recordings

POINTS = 100_000
BLOCK = 10
HIGHEST_CURRENT = 2.0

_ROUNDING = 1e-9
"""Of the force: where the current hardly changes it, its rounding is more than 1e-6 of the span."""


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


def largest_miss(parameters_of: ParameterSet, count: int, rng: np.random.Generator) -> float:
    """Largest miss [1] of random wanted forces, as a part of the span of the attainable."""
    law, values = parameters_of.law, parameters_of.values
    # Where the set was not identified the law is that of the ends of its range.
    motion = random_motion(count, rng).held_within(*parameters_of.peak_velocity_range)
    forces = law.response(values, motion, 1e-3, None).force(np.linspace(0.0, HIGHEST_CURRENT, 401))
    least, most = forces.min(axis=1), forces.max(axis=1)
    span = most - least
    wanted = rng.uniform(least - 0.3 * span, most + 0.3 * span)
    inverse = InverseModel(parameters_of, 0.0, HIGHEST_CURRENT)
    size = np.maximum(np.maximum(np.abs(least), np.abs(most)), 1.0)
    allowed = np.maximum(span, _ROUNDING / 1e-6 * size)
    misses = []
    # The nodes of several samples are looked at together.
    for block in (BLOCK, count):
        parts = [slice(first, first + block) for first in range(0, count, block)]
        found = [inverse.currents(motion.part(part), wanted[part]).current for part in parts]
        force = law.force(values, motion, np.concatenate(found), 1e-3)
        further = np.abs(force - wanted) - np.abs(np.clip(wanted, least, most) - wanted)
        misses.append(np.max(further / allowed) if np.isfinite(force).all() else np.inf)
    return float(max(misses))


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
    """``inverse_miss_of_span`` and ``inverse_us_per_sample``."""
    sets = [ParameterSet(parameters(c, m)) for c in CONDITIONS for m in PUBLISHED_METHODS]
    place = recordings.folder()
    note = "Without a set of recordings: there are none." if place is None else ""
    if place is not None:
        model = MODELS[DEFAULT_MODEL]
        windows = recordings.processed_windows(place)
        found = identify_global(model, windows, model.initial_values()[0], EvolutionSettings())
        sets.append(found.parameter_set)
    rng = np.random.default_rng(0)
    each = POINTS // len(sets) + 1
    return [
        Figure(
            "inverse_miss_of_span",
            max(largest_miss(chosen, each, rng) for chosen in sets),
            "Largest |F(inverse) - attainable| over the span of what 0 to 2 A give [1]: 1e5 "
            "random wanted forces and motions, in blocks of ten and together, of all published "
            "sets and one of the recordings.",
            (-np.inf, 1e-6),
            note,
        ),
        Figure(
            "inverse_us_per_sample",
            1e6 * seconds_per_sample(sets[:: max(len(sets) // 8, 1)], 200),
            "Processor time [µs] of a sample of the inverse in blocks of ten; every eighth set.",
            (0.0, 50.0),
        ),
    ]
