"""Displacement and force on two topics, by clocks that drift, with jitter and losses.

Each channel is sampled at 1 kHz, 50 ppm fast the one and slow the other, its stamps off by up to
half a period, and a hundredth of the messages never comes. The value of each sample is the time at
which it was taken, so that what is joined shows how far it was apart. All in simulated time.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks.figure import Figure
from mr_damper_ros.signals.stamped_channel import ChannelJoin, StampedChannel

_RATE, _WRONG, _JITTER, _LOSS = 1000.0, 50e-6, 0.5, 0.01
_PART = 60.0
"""Seconds that are made at a time."""

_BEGIN_NS = 1_700_000_000_000_000_000


def _sent(channel: int, duration: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """When samples were taken [s], and their stamps [ns], part by part; the lost ones are NaN."""
    rng = np.random.default_rng(channel)
    period = (1.0 + (_WRONG if channel else -_WRONG)) / _RATE
    begin, first = rng.random() * period, 0
    while first * period < duration:
        count = round(min(_PART, duration) * _RATE)
        taken = begin + (first + np.arange(count)) * period
        stamps = taken + _JITTER * period * (2.0 * rng.random(count) - 1.0)
        lost = rng.random(count) < _LOSS
        first += count
        yield np.where(lost, np.nan, taken), np.round(1e9 * stamps).astype(np.int64) + _BEGIN_NS


def figures(duration: float = 3600.0) -> list[Figure]:
    """Join ``duration`` [s] of two channels."""
    join = ChannelJoin(StampedChannel(0.0), StampedChannel(0.0))
    worst, joined, invented, lost = 0.0, 0, 0, 0
    for (leading, own), (following, others) in zip(
        _sent(0, duration), _sent(1, duration), strict=False
    ):
        lost += int(np.count_nonzero(np.isnan(leading)))
        for place in range(leading.size):
            if leading[place] == leading[place]:
                join.lead(int(own[place]), 0, float(leading[place]))
            if following[place] == following[place]:
                join.follow(int(others[place]), 0, float(following[place]))
            if place % 20:
                continue
            for run in join.take():
                if run.leading[0] > 1.0:
                    worst = max(worst, float(np.abs(run.following - run.leading).max()))
                joined += run.leading.size
                # A sample that was measured has the very value that was sent.
                invented += run.leading.size - np.unique(run.leading).size
    whole = joined + lost + join.without_partner + join.leader.unclear
    return [
        Figure(
            "pairing_error_ms",
            1e3 * worst,
            f"Largest time between the samples of two topics that were joined, of {joined} in "
            f"{duration:g} s, at 50 ppm, half a period of jitter and 1 % lost; after the first "
            "second, in which the clocks are found.",
            (0.0, 0.1),
        ),
        Figure(
            "pairing_invented",
            float(invented),
            "Joined samples that nobody had sent.",
            (0.0, 0.0),
        ),
        Figure(
            "pairing_miscounted",
            float(abs(join.leader.lost - lost)),
            f"Difference between the losses that were counted and the {lost} that there were.",
            (0.0, 5.0),
        ),
        Figure(
            "pairing_joined",
            joined / whole,
            "Part of the samples of the force that were joined; the others were lost, had lost a "
            "partner, or lay unclear next to a loss.",
        ),
    ]
