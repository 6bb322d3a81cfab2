"""Streams with stamps that jitter and samples that are lost, against the same streams clean.

Two kinds of jitter: samples taken evenly whose time was read unevenly (clock), and samples that
were taken when their stamps say (sampling). Nothing tells the identification or the prediction
which it is. Everything runs in one process, by the data's stamps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.figure import Figure
from benchmarks.other_dampers import DAMPERS, random_motion
from mr_damper_ros.emulation.emulator import (
    THESIS_FORCE_NOISE,
    EmulatedRig,
    ModelDamper,
    RigSettings,
)
from mr_damper_ros.emulation.motions import Excitation, SineMotion
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.tracking.engine import Engine, EngineSettings
from mr_damper_ros.tracking.tracker import TrackerSettings

JITTER = 0.5
"""Stamps are off by up to this part of a sample period, evenly distributed."""

LOSS = 0.01
DURATION = 30.0
SETTLED = 10.0
"""Seconds after which the forces count."""

_FINE = 10
"""The rig makes so many samples a period, so that some can be taken in between."""

_CURRENT = 1.0
_SETS = {"thesis": ParameterSet(THESIS_28_CELSIUS), "viscous_tanh": DAMPERS["viscous_tanh"]}


@dataclass(frozen=True, eq=False)
class Fine:
    """Displacement [m] and force [N] of a rig, ``period`` [s] apart, and its first stamp."""

    period: float
    start_ns: int
    displacement: Array
    force: Array


@dataclass(frozen=True)
class Way:
    """How the samples are taken and sent: ``kind`` is clean, clock or sampling."""

    rate: float
    block_size: int
    kind: str
    loss: float = LOSS
    seed: int = 0


def made(damper: ParameterSet, motion: Excitation, rate: float, duration: float) -> Fine:
    """What a rig does, without noise."""
    fine = rate * _FINE
    rig = EmulatedRig(
        ModelDamper(damper, 1.0 / fine),
        motion,
        _CURRENT,
        settings=RigSettings(fine, force_noise=0.0),
    )
    block = rig.next_block(round(duration * fine))
    return Fine(1.0 / fine, block.start_ns, block.displacement, block.force)


def sent(rig: Fine, way: Way) -> list[SampleBlock]:
    """The blocks that come of it."""
    rng = np.random.default_rng(way.seed)
    count = rig.force.size // _FINE
    size, period = way.block_size, 1.0 / way.rate
    noise = THESIS_FORCE_NOISE * rng.standard_normal(count)
    noise_of_position = 1e-6 * rng.standard_normal(count)
    blocks = []
    for first in range(0, count - size, size):
        late = rng.uniform(-JITTER, JITTER) if way.kind != "clean" else 0.0
        lost = rng.random() < way.loss and way.kind != "clean"
        if lost and first > 0:
            continue
        shift = round(late * _FINE) if way.kind == "sampling" else 0
        places = np.maximum((first + np.arange(size)) * _FINE + shift, 0)
        late = shift / _FINE if way.kind == "sampling" else late
        part = slice(first, first + size)
        blocks.append(
            SampleBlock(
                start_ns=rig.start_ns + round((first + late) * period * NANOSECONDS),
                sequence=first,
                period=period,
                displacement=rig.displacement[places] + noise_of_position[part],
                force=rig.force[places] + noise[part],
            )
        )
    return blocks


def followed(rig: Fine, blocks: list[SampleBlock], way: Way) -> tuple[float, float]:
    """Share of the samples sent whose force is valid, and NRMSE against the rig's force."""
    # Least squares leads to the minima of the default method, in a tenth of the time.
    engine = Engine(EngineSettings(tracking=TrackerSettings(method="least_squares")))
    valid, errors, truths = [], [], []
    grid = np.arange(rig.force.size) * rig.period
    for block in blocks:
        stamp_ns = rig.start_ns + round(block.sequence * block.period * NANOSECONDS)
        engine.add_current(stamp_ns - 100_000_000, _CURRENT)
        prediction = engine.predict(block)
        if block.sequence * block.period < SETTLED:
            continue
        known = prediction.valid_samples
        valid.append(float(np.mean(known)))
        # Where the samples were taken evenly, the count tells when better than the stamp.
        begin = (
            (prediction.start_ns - rig.start_ns) / NANOSECONDS
            if way.kind == "sampling"
            else prediction.sequence * block.period
        )
        at = begin + np.arange(prediction.force.size) * block.period
        truth = np.interp(at, grid, rig.force)
        errors.append((prediction.force - truth)[known])
        truths.append(truth[known])
    if not any(valid):
        return 0.0, math.inf
    error, truth = np.concatenate(errors), np.concatenate(truths)
    return float(np.mean(valid)), float(np.sqrt(np.mean(error**2)) / np.std(truth))


def motions(duration: float) -> dict[str, Excitation]:
    """A sine of the thesis, and a random motion."""
    return {
        "sine": SineMotion(0.005, 1.0),
        "random": random_motion(0.003, 0.3, 3.0, duration, seed=1),
    }


def figures(
    duration: float = DURATION,
    blocks: tuple[int, ...] = (1, 10),
    rates: tuple[float, ...] = (200.0, 1000.0),
) -> list[Figure]:
    """``jitter_valid``, ``jitter_valid_of_clean`` and ``jitter_nrmse_ratio``."""
    worst_valid, worst_share, worst_ratio = (np.inf, ""), (np.inf, ""), (0.0, "")
    for name, damper in _SETS.items():
        for moved, motion in motions(duration).items():
            for rate in rates:
                rig = made(damper, motion, rate, duration)
                for size in blocks:
                    way = Way(rate, size, "clean")
                    clean_valid, clean = followed(rig, sent(rig, way), way)
                    for kind in ("clock", "sampling"):
                        jittered = replace(way, kind=kind)
                        valid, nrmse = followed(rig, sent(rig, jittered), jittered)
                        what = f"{name}, {moved}, {rate:g} Hz in blocks of {size}, {kind}"
                        clean_too = f"{what}: {valid:.1%}, clean {clean_valid:.1%}"
                        worst_valid = min(worst_valid, (100.0 * valid, clean_too))
                        share = 100.0 * valid / clean_valid if clean_valid else 0.0
                        worst_share = min(worst_share, (share, clean_too))
                        worst_ratio = max(worst_ratio, (nrmse / clean, what))
    what_is_measured = (
        f"stamps off by up to {JITTER:.0%} of a period and {LOSS:.0%} of the blocks lost, the time "
        f"read or the samples taken unevenly, {' and '.join(f'{rate:g}' for rate in rates)} Hz, "
        f"blocks of {' and '.join(map(str, blocks))}, a sine and random motion, the thesis' damper "
        "and a viscous one with a tanh, from a cold start"
    )
    return [
        Figure(
            "jitter_valid",
            worst_valid[0],
            f"Blocks with a valid force [%] of those that come, {what_is_measured}; the worst.",
            (98.0, math.inf),
            f"{worst_valid[1]}.",
        ),
        Figure(
            "jitter_valid_of_clean",
            worst_share[0],
            f"The same share over that of the clean stream [%], {what_is_measured}; the worst: "
            "where the law does not hold, the force is in doubt without jitter too.",
            (98.0, math.inf),
            f"{worst_share[1]}.",
        ),
        Figure(
            "jitter_nrmse_ratio",
            worst_ratio[0],
            f"NRMSE of the predicted force against the measured one over that of the clean "
            f"stream, {what_is_measured}; the worst.",
            (0.0, 1.2),
            f"{worst_ratio[1]}.",
        ),
    ]
