"""Blocks of one sample at 1 kHz, as a controller sends them, and what an overload does to them."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np

from benchmarks.figure import Figure
from benchmarks.other_dampers import random_motion
from benchmarks.side_by_side import CURRENT, SideBySide, blocks_of, on_cores
from benchmarks.streaming_load import SETTLED, sine_blocks
from mr_damper_ros.emulation.emulator import EmulatedRig, ModelDamper, RigSettings
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.signals.blocks import SampleBlock
from mr_damper_ros.tracking.validity import ValiditySettings

RATE = 1000.0
DURATION = 60.0
OVERLOAD = 15.0
BUSY = 6
"""Programs that are always busy on the core of the nodes."""

CORES = 2
MAX_AGE = ValiditySettings().max_age
ON_THE_WAY = 0.05
"""Seconds that may pass from the model's judgement to the force's publication: the busy programs
may have the processor in between."""

MOTIONS = ("sine", "random")


@dataclass(frozen=True)
class SingleSamples:
    """What became of the blocks: of model and relay."""

    lost: tuple[int, int]
    p99: tuple[float, float]
    cpu: tuple[float, float]
    valid: float


def stream(motion: str, duration: float) -> list[SampleBlock]:
    """Blocks of one sample of a sine, or of random motion up to 3 Hz."""
    if motion == "sine":
        return sine_blocks(RATE, 1, duration)
    rig = EmulatedRig(
        ModelDamper(ParameterSet(THESIS_28_CELSIUS), 1.0 / RATE),
        random_motion(3e-3, 0.3, 3.0, duration, seed=1),
        CURRENT,
        settings=RigSettings(RATE, seed=1),
    )
    made = rig.next_block(round(duration * RATE))
    return blocks_of(made.displacement, made.force, made.period, 1)


def beside_a_relay(motion: str, duration: float) -> SingleSamples:
    """The model, with the identifier running, and the relay, all on two cores."""
    blocks = stream(motion, duration)
    with on_cores(sorted(os.sched_getaffinity(0))[:CORES]), SideBySide(identifier=True) as both:
        before = both.cpu_seconds
        both.send(blocks)
        model, relay = (
            (now - then) / duration for now, then in zip(both.cpu_seconds, before, strict=True)
        )
        settled = round(SETTLED * RATE)
        first, second = (
            float(np.quantile([x for k, x in route.latencies.items() if k >= settled], 0.99))
            for route in (both.model, both.relay)
        )
        return SingleSamples(
            (both.model.lost, both.relay.lost),
            (first, second),
            (model, relay),
            len(both.model.valid_ones) / len(blocks),
        )


@dataclass(frozen=True)
class Overload:
    """Forces published later than ``max_age``: ``stale_valid`` of them valid, ``stale`` in all.

    ``valid`` forces in all, the age of the ``oldest_valid`` [s], samples ``relay_lost``, and the
    ``relay_age`` [s] of the oldest that it answered.
    """

    stale_valid: int
    stale: int
    oldest_valid: float
    relay_lost: int
    relay_age: float
    valid: int


def overload(duration: float = OVERLOAD, busy: int = BUSY) -> Overload:
    """Model and relay on one core with busy programs; the driver has another."""
    driver, *others = sorted(os.sched_getaffinity(0))
    core = others[:1] or [driver]
    with SideBySide(cores=core, busy=busy, dated=True) as both, on_cores([driver]):
        both.send(stream("random", duration))
        model, relay = both.model, both.relay
        ages, valid = model.ages, model.valid_ones
        stale = {k for k, age in ages.items() if age > MAX_AGE + ON_THE_WAY}
        return Overload(
            len(stale & valid),
            len(stale),
            max((ages[k] for k in valid), default=0.0),
            relay.lost,
            max(relay.ages.values(), default=0.0),
            len(valid),
        )


def figures(duration: float = DURATION, overload_duration: float = OVERLOAD) -> list[Figure]:
    """``single_sample_...`` and ``stale_valid``."""
    found = [beside_a_relay(motion, duration) for motion in MOTIONS]
    what = (
        f"Blocks of one sample at {RATE:g} Hz for {duration:g} s, bridge's place taken by a driver "
        f"that sends each to model and relay in turn, identifier running, {CORES} cores: "
        f"{', '.join(MOTIONS)}"
    )
    heavy = overload(overload_duration)
    return [
        Figure(
            "single_sample_lost",
            [float(each.lost[0]) for each in found],
            f"{what}; samples without a force.",
            (0.0, 0.0),
            f"The relay lost {' and '.join(str(each.lost[1]) for each in found)}; valid "
            f"{' and '.join(f'{each.valid:.1%}' for each in found)}.",
        ),
        Figure(
            "single_sample_p99_ratio",
            [each.p99[0] / each.p99[1] for each in found],
            "99th percentile of the latency there over that of the relay.",
            (0.0, 1.2),
            "; ".join("{:.2f} ms beside {:.2f} ms".format(*(1e3 * np.array(e.p99))) for e in found),
        ),
        Figure(
            "single_sample_cpu_ratio",
            [each.cpu[0] / each.cpu[1] for each in found],
            "Processor time of the model there over that of the relay, which only copies.",
            (0.0, 1.5),
            "; ".join("{:.0%} beside {:.0%} of a core".format(*each.cpu) for each in found),
        ),
        Figure(
            "stale_valid",
            float(heavy.stale_valid),
            f"Forces published more than max_age ({MAX_AGE:g} s) after their sample and "
            f"marked valid: {RATE:g} Hz in blocks of one, random motion, model and relay on one "
            f"core with {BUSY} programs that are always busy; {1e3 * ON_THE_WAY:g} ms are allowed "
            "from the judgement on.",
            (0.0, 0.0),
            f"{heavy.stale} were older, {heavy.valid} valid, of these the oldest "
            f"{heavy.oldest_valid:.2f} s; the relay lost {heavy.relay_lost}, its oldest came after "
            f"{heavy.relay_age:.2f} s.",
        ),
    ]
