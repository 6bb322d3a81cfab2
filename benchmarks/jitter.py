"""Streams with stamp jitter and lost samples, compared with the same streams without them.

There are two kinds of jitter: uniform sampling with inaccurate stamps (clock), and non-uniform
sampling at the times of the stamps (sampling). The identification and the prediction are not told
the kind. Everything runs in one process, on the time of the stamps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.figure import Measured
from benchmarks.other_dampers import DAMPERS, random_motion
from mr_damper_ros.emulation.emulator import (
    THESIS_FORCE_NOISE,
    EmulatedDamper,
    EmulatedRig,
    RigSettings,
)
from mr_damper_ros.emulation.motions import Excitation, SineMotion
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.signals.blocks import NANOSECONDS, RigBlock, SampleBlock
from mr_damper_ros.tracking.engine import Engine, EngineSettings
from mr_damper_ros.tracking.tracker import TrackerSettings

JITTER = 0.5
"""Largest error of a stamp, as a fraction of a sample period; uniformly distributed."""

LOSS = 0.01
DURATION = 30.0
SETTLED = 10.0
"""Time [s] after which the forces are evaluated."""

_FINE = 10
"""Samples of the rig per sample period, which allow non-uniform sampling."""

_CURRENT = 1.0
_SETS = {"thesis": ParameterSet(THESIS_28_CELSIUS), "viscous_tanh": DAMPERS["viscous_tanh"]}


@dataclass(frozen=True)
class Way:
    """Sampling and transmission of the samples; ``kind`` is clean, clock or sampling."""

    rate: float
    block_size: int
    kind: str


def made(damper: ParameterSet, motion: Excitation, rate: float, duration: float) -> RigBlock:
    """Signals of a rig without noise."""
    fine = rate * _FINE
    settings = RigSettings(fine, force_noise=0.0)
    rig = EmulatedRig(EmulatedDamper(damper), motion, _CURRENT, settings=settings)
    return rig.next_block(round(duration * fine))


def sent(rig: RigBlock, way: Way) -> list[SampleBlock]:
    """The resulting blocks."""
    rng = np.random.default_rng(0)
    count = rig.force.size // _FINE
    size, period = way.block_size, 1.0 / way.rate
    noise = THESIS_FORCE_NOISE * rng.standard_normal(count)
    noise_of_position = 1e-6 * rng.standard_normal(count)
    blocks = []
    for first in range(0, count - size, size):
        late = rng.uniform(-JITTER, JITTER) if way.kind != "clean" else 0.0
        lost = way.kind != "clean" and rng.random() < LOSS
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


def followed(rig: RigBlock, way: Way) -> tuple[float, float]:
    """Percentage of the sent samples with valid force, and NRMSE against the force of the rig."""
    # Least squares finds the minima of the default method in a tenth of the time.
    engine = Engine(EngineSettings(tracking=TrackerSettings(method="least_squares")))
    valid, errors, truths = [], [], []
    grid = np.arange(rig.force.size) * rig.period
    for block in sent(rig, way):
        stamp_ns = rig.start_ns + round(block.sequence * block.period * NANOSECONDS)
        engine.add_current(stamp_ns - 100_000_000, _CURRENT)
        prediction = engine.predict(block)
        if block.sequence * block.period < SETTLED:
            continue
        known = prediction.valid_samples
        valid.append(float(np.mean(known)))
        # With uniform sampling, the count gives the time more accurately than the stamp.
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
    return 100.0 * float(np.mean(valid)), float(np.sqrt(np.mean(error**2)) / np.std(truth))


def figures(
    duration: float = DURATION,
    blocks: Sequence[int] = (1, 10),
    rates: Sequence[float] = (200.0, 1000.0),
) -> Measured:
    """Worst of two dampers in a sine of the thesis and in random motion, from a cold start."""
    motions: dict[str, Excitation] = {
        "sine": SineMotion(0.005, 1.0),
        "random": random_motion(0.003, 0.3, 3.0, duration, seed=1),
    }
    valid, shares, ratios = [], [], []
    for name, damper in _SETS.items():
        for moved, motion in motions.items():
            for rate in rates:
                rig = made(damper, motion, rate, duration)
                for size in blocks:
                    clean, clean_nrmse = followed(rig, Way(rate, size, "clean"))
                    for kind in ("clock", "sampling"):
                        share, nrmse = followed(rig, Way(rate, size, kind))
                        what = f"{name}, {moved}, {rate:g} Hz in blocks of {size}, {kind}"
                        told = f"{what}: {share:.1f} %, clean {clean:.1f} %"
                        valid.append((share, told))
                        shares.append((100.0 * share / clean if clean else 0.0, told))
                        ratios.append((nrmse / clean_nrmse, what))
    return {
        "jitter_valid": min(valid),
        "jitter_valid_of_clean": min(shares),
        "jitter_nrmse_ratio": max(ratios),
    }
