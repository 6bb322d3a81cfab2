"""Streams with stamp jitter and lost samples, compared with the same streams without them.

There are two kinds of jitter: uniform sampling with inaccurate stamps (clock), and non-uniform
sampling at the times of the stamps (sampling). The identification and the prediction are not told
the kind. Everything runs in one process, on the time of the stamps.
"""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from benchmarks.dampers import DAMPERS
from benchmarks.figure import Measured, some_of
from benchmarks.motions import random_motion
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
from studies.recordings import rms

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


def sent(rig: RigBlock, rate: float, size: int, kind: str, seed: int) -> list[SampleBlock]:
    """The signals of a fine rig in blocks of ``size``; ``kind`` is clean, clock or sampling."""
    rng = np.random.default_rng(seed)
    count, period = rig.force.size // _FINE, 1.0 / rate
    noise = THESIS_FORCE_NOISE * rng.standard_normal(count)
    noise_of_position = 1e-6 * rng.standard_normal(count)
    blocks = []
    for first in range(0, count - size, size):
        late = rng.uniform(-JITTER, JITTER) if kind != "clean" else 0.0
        if kind != "clean" and rng.random() < LOSS and first > 0:
            continue
        shift = round(late * _FINE) if kind == "sampling" else 0
        late = shift / _FINE if kind == "sampling" else late
        places = np.maximum((first + np.arange(size)) * _FINE + shift, 0)
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


def followed(rig: RigBlock, rate: float, size: int, kind: str, seed: int) -> tuple[float, float]:
    """Percentage of the sent samples with valid force, and NRMSE against the force of the rig."""
    # Least squares finds the minima of the default method in a tenth of the time.
    engine = Engine(EngineSettings(tracking=TrackerSettings(method="least_squares")))
    valid, errors, truths = [], [], []
    grid = np.arange(rig.force.size) * rig.period
    for block in sent(rig, rate, size, kind, seed):
        begin = block.sequence * block.period
        stamp_ns = rig.start_ns + round(begin * NANOSECONDS)
        engine.add_current(stamp_ns - 100_000_000, _CURRENT)
        prediction = engine.predict(block)
        if begin < SETTLED:
            continue
        known = prediction.valid_samples
        valid.append(float(np.mean(known)))
        # With uniform sampling, the count gives the time more accurately than the stamp.
        if kind == "sampling":
            begin = (prediction.start_ns - rig.start_ns) / NANOSECONDS
        at = begin + np.arange(prediction.force.size) * block.period
        truth = np.interp(at, grid, rig.force)[known]
        errors.append(prediction.force[known] - truth)
        truths.append(truth)
    if not any(valid):
        return 0.0, math.inf
    nrmse = rms(np.concatenate(errors)) / float(np.std(np.concatenate(truths)))
    return 100.0 * float(np.mean(valid)), nrmse


def figures(every: int = 1, seed: int = 0) -> Measured:
    """Worst of two dampers in a sine of the thesis and in random motion, from a cold start.

    The figures are those of all these streams, or of one in ``every``.
    """
    motions: dict[str, Excitation] = {
        "sine": SineMotion(0.005, 1.0),
        "random": random_motion(0.003, 0.3, 3.0, DURATION, 1 + seed),
    }
    valid, shares, ratios = [], [], []
    streams = list(product(_SETS, motions, (200.0, 1000.0)))
    for name, moved, rate in some_of(streams, every, seed):
        settings = RigSettings(rate * _FINE, force_noise=0.0)
        source = EmulatedRig(
            EmulatedDamper(_SETS[name]), motions[moved], _CURRENT, settings=settings
        )
        rig = source.next_block(round(DURATION * rate * _FINE))
        for size in (1, 10):
            clean, clean_nrmse = followed(rig, rate, size, "clean", seed)
            for kind in ("clock", "sampling"):
                share, nrmse = followed(rig, rate, size, kind, seed)
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
