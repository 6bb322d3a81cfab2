"""Wrong force that is valid where the force changes after some wild samples of the load cell.

The error of the predicted force is judged by the span of the measured one: that must not be the
span of some wild samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from benchmarks.figure import Figure
from benchmarks.healthy import CURRENT
from benchmarks.other_dampers import DAMPERS, random_motion
from benchmarks.stream_trial import StreamTrial, Stretch
from mr_damper_ros.emulation.faults import faults_of
from mr_damper_ros.emulation.motions import Excitation, SineMotion

SPIKES = (3000, 8000, 20_000)
"""Sizes of the wild samples [N], five a second for a second."""

_LOST = 0.3
"""Part of the force that is left when it changes, half a second after the last wild sample."""


class Stream(NamedTuple):
    """A motion, and the time [s] at which the wild samples come."""

    name: str
    motion: Callable[[], Excitation]
    at: float


STREAMS = (
    Stream("0.05 Hz", partial(SineMotion, 0.01, 0.05), 70.0),
    Stream("0.5 Hz", partial(SineMotion, 0.01, 0.5), 14.0),
    Stream("1 Hz", partial(SineMotion, 0.005, 1.0), 12.0),
    Stream("5 Hz", partial(SineMotion, 0.003, 5.0), 12.0),
    Stream("random 0.2-3 Hz", partial(random_motion, 3e-3, 0.2, 3.0, 40.0, 5), 16.0),
)


class Spoilt(NamedTuple):
    """How long wrong force was valid after spikes [N] in a stream."""

    stream: str
    spikes: float
    wrong: Stretch


def measure(streams: Sequence[Stream] = STREAMS, sizes: Sequence[int] = SPIKES) -> list[Spoilt]:
    """These sizes of spikes in these streams."""
    found = []
    for stream in streams:
        base = StreamTrial(DAMPERS["viscous_tanh"], stream.motion(), CURRENT)
        base.advance(stream.at)
        for size in sizes:
            at = stream.at
            faults = (f"force_spikes:{size}@{at:g}-{at + 1:g}", f"force_loss:{_LOST}@{at + 1.5:g}")
            trial = base.branch(faults_of(faults, seed=size))
            found.append(Spoilt(stream.name, size, trial.run(12.0).wrong_valid(since=at)))
    return found


def figures(streams: Sequence[Stream] = STREAMS, sizes: Sequence[int] = SPIKES) -> list[Figure]:
    """``spike_wrong_valid_s``."""
    found = sorted(measure(streams, sizes), key=lambda spoilt: -spoilt.wrong.longest)
    return [
        Figure(
            "spike_wrong_valid_s",
            found[0].wrong.longest,
            f"Wild samples of the load cell, {sizes[0]} to {sizes[-1]} N, then a damper that has "
            f"lost {1.0 - _LOST:.0%} of its force: longest time [s] for which the force is off by "
            f"more than 20 % of its peak and valid; {', '.join(s.name for s in streams)}.",
            (0.0, 0.5),
            "Most: "
            + "; ".join(
                f"{s.stream}, {s.spikes} N: {s.wrong.longest:.2f} s, up to {s.wrong.worst:.0%}"
                for s in found[:4]
            )
            + ".",
        )
    ]
