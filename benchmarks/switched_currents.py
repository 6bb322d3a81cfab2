"""Correct force that is refused where the current switches, for dampers of foreign laws.

Every pattern of the current meets every quality of the supply's channel twice. A seed distributes
laws, motions and sizes over these combinations.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np

from benchmarks.dampers import LAWS, ForeignDamper
from benchmarks.figure import Measured, in_processes, some_of
from benchmarks.foreign_dampers import FOLLOWING, GOOD, asked
from benchmarks.motions import (
    CURRENTS,
    HIGHEST_CURRENT,
    MOTIONS,
    scheduled,
    skyhook_car,
)
from benchmarks.streams import StreamTrial, TrialResult, TrialSettings, WorseSet, worse_sets
from mr_damper_ros.emulation.emulator import CurrentSchedule
from mr_damper_ros.emulation.faults import faults_of
from mr_damper_ros.emulation.motions import Excitation
from mr_damper_ros.tracking.validity import DoubtKind

DURATION, SETTLING = 20.0, 6.0
"""Duration of a trial, and time [s] after its start from which refused force counts."""

CAR = "quarter car"

_MOVES = ("sine 0.4 Hz", "sine 2 Hz", "random 0.2-3 Hz", "random 0.5-8 Hz", CAR)

_SIZES = (0.5, 1.0, 2.0)

_HIGH = 1.2
"""Upper current [A] of the patterns of two levels."""


def _pulses(frequency: float, duty: Callable[[float], float]) -> CurrentSchedule:
    """Pulses of the supply; ``duty`` is the part of a period with current as function of time."""
    starts = np.arange(round((DURATION + 1.0) * frequency)) / frequency
    ends = [start + duty(start) / frequency for start in starts.tolist()]
    times = np.stack([starts, np.array(ends)]).T.ravel()
    return scheduled(times, np.tile([_HIGH, 0.0], starts.size))


def _pwm(seed: int) -> CurrentSchedule:
    """Pulse-width modulation at 8 to 25 Hz with a slowly changing duty."""
    phase = np.random.default_rng(seed).uniform(0.0, 2.0 * math.pi)
    return _pulses((8.0, 15.0, 25.0)[seed % 3], lambda t: 0.5 + 0.3 * math.sin(1.3 * t + phase))


def _held(seed: int) -> CurrentSchedule:
    """Steps to random currents, each held for 1 to 3 s."""
    rng = np.random.default_rng(seed)
    times = np.concatenate([[0.0], np.cumsum(rng.uniform(1.0, 3.0, 30))])
    return scheduled(times, rng.uniform(0.0, HIGHEST_CURRENT, times.size))


@cache
def _car(seed: int) -> tuple[Excitation, CurrentSchedule]:
    return skyhook_car(seed)


PATTERNS: dict[str, Callable[[Excitation, int], CurrentSchedule]] = {
    "bang-bang": CURRENTS["bang-bang"],
    "skyhook": lambda _, seed: _car(seed)[1],
    "PWM": lambda _, seed: _pwm(seed),
    "5 Hz": lambda _, __: _pulses(5.0, lambda _: 0.5),
    "steps": lambda _, seed: _held(seed),
}
"""Patterns of the current by name, made from a motion and a seed."""


@dataclass(frozen=True)
class Channel:
    """The supply's channel: time between readings [s], step [A] of a reading at once, and faults.

    ``{}`` in a fault stands for a time [s] that depends on the combination.
    """

    period: float = 0.1
    step: float = 0.005
    faults: str = ""


CHANNELS = {
    "at once": Channel(),
    "every block": Channel(0.01, math.inf),
    "late": Channel(faults="current_delay:{}"),
    "stamped late": Channel(faults="supply_clock:{}"),
    "slow": Channel(math.nan, math.inf),
    "hum": Channel(0.01, math.inf, "current_hum:0.06 current_noise:0.02"),
}
"""Qualities of the channel by name; a period of NaN depends on the combination."""

_DELAYS = (0.005, 0.01, 0.02, 0.035, 0.05)
_READINGS = (0.02, 0.05, 0.1)


@dataclass(frozen=True)
class Combination:
    """One combination: names from the tables, and the ``size`` of the damper [1]."""

    number: int
    pattern: str
    channel: str
    law: str
    motion: str
    size: float
    delay: float
    reading: float

    @property
    def name(self) -> str:
        """The combination in words."""
        of_channel = {
            "late": f" {1e3 * self.delay:g} ms",
            "stamped late": f" {1e3 * self.delay:g} ms",
            "slow": f" {1.0 / self.reading:g} Hz",
        }.get(self.channel, "")
        motion = CAR if self.pattern == "skyhook" else self.motion
        return (
            f"{self.number}: {self.pattern}, {self.channel}{of_channel}, {self.law} "
            f"x{self.size:g}, {motion}"
        )

    def trial(self) -> StreamTrial:
        """The trial of the combination."""
        motion = MOTIONS[self.motion](self.number)
        if self.pattern == "skyhook":
            motion = _car(self.number)[0]
        channel = CHANNELS[self.channel]
        period = self.reading if math.isnan(channel.period) else channel.period
        faults = [f"{text}@0" for text in channel.faults.format(self.delay).split()]
        return StreamTrial(
            ForeignDamper(self.law, self.size),
            motion,
            PATTERNS[self.pattern](motion, self.number),
            faults=faults_of(faults, self.number),
            settings=TrialSettings(
                self.number,
                force_noise=5.0 * self.size,
                supply_period=period,
                supply_step=channel.step,
            ),
        )


def combinations(seed: int = 0) -> tuple[Combination, ...]:
    """All combinations; their numbers, which seed motions and noise, depend on the seed."""
    rng = np.random.default_rng(50 + seed)
    pairs = [*product(PATTERNS, CHANNELS)] * 2
    order = rng.permutation(len(pairs))
    columns = [
        [values[place] for place in rng.permutation(np.arange(len(pairs)) % len(values))]
        for values in (tuple(LAWS), _MOVES, _SIZES, _DELAYS, _READINGS)
    ]
    return tuple(
        Combination(number, *pairs[place], *entries)  # type: ignore[arg-type]
        for number, (place, entries) in enumerate(
            zip(order.tolist(), zip(*columns, strict=True), strict=True),
            start=1000 + seed * len(pairs),
        )
    )


@dataclass(frozen=True)
class Outcome:
    """Result of a combination; times in s, fractions of the time in motion after settling.

    ``right`` is the fraction with correct force, ``refused`` that with correct force that was
    refused, and ``refused_for`` gives its parts by DoubtKind.
    """

    combination: Combination
    wrong_valid: float
    longest: float
    right: float
    refused: float
    refused_for: dict[str, float]
    worse_sets: list[WorseSet]


def judged(given: Combination, result: TrialResult) -> Outcome:
    """The outcome of the result of a combination."""
    moving = asked(result) & (result.time >= SETTLING)
    right = moving & result.right
    refused = right & ~result.valid
    kinds = np.bincount(result.doubts[refused & (result.doubts >= 0)], minlength=1)
    wrong, count = result.wrong_valid(), max(int(np.count_nonzero(moving)), 1)
    identified = len(result.sets) > 1
    return Outcome(
        given,
        wrong.total,
        wrong.longest,
        float(np.count_nonzero(right)) / count,
        # Nothing identified: all of it counts against it.
        float(np.count_nonzero(refused)) / count if identified else 1.0,
        {
            DoubtKind(kind).name: float(kinds[kind]) / count
            for kind in np.argsort(-kinds)
            if kinds[kind]
        },
        worse_sets(result, [(0.0, FOLLOWING)], GOOD),
    )


def run(given: Combination) -> Outcome:
    """Run a combination."""
    return judged(given, given.trial().run(DURATION))


def figures(every: int = 1, seed: int = 0) -> Measured:
    """Run all combinations, or one in ``every``."""
    outcomes = in_processes(run, some_of(combinations(seed), every, seed))
    refused = 100.0 * np.array([outcome.refused for outcome in outcomes])
    wrong = np.array([outcome.wrong_valid for outcome in outcomes])
    causes: Counter[str] = Counter()
    for outcome in outcomes:
        causes.update(outcome.refused_for)
    told = [
        f"{name} {np.median(shares):.0f}"
        for kind in ("pattern", "channel")
        for name, shares in _by(kind, outcomes, refused).items()
    ]
    return {
        "switched_right_refused_percent": (
            [float(np.median(refused)), float(np.quantile(refused, 0.9))],
            f"{len(outcomes)} combinations. Medians: "
            + ", ".join(told)
            + ". By cause, mean: "
            + ", ".join(
                f"{kind} {100.0 * share / len(outcomes):.1f}"
                for kind, share in causes.most_common()
            ),
        ),
        "switched_wrong_valid_s": (
            [
                float(np.median(wrong)),
                float(np.quantile(wrong, 0.95)),
                max(outcome.longest for outcome in outcomes),
            ],
            "; ".join(
                f"{o.combination.name} ({o.wrong_valid:.2f} s)"
                for o in sorted(outcomes, key=lambda each: -each.wrong_valid)[:3]
            ),
        ),
        "switched_worse_sets": (
            float(sum(len(outcome.worse_sets) for outcome in outcomes)),
            "; ".join(
                f"{o.combination.number}: {each.set_id} {each.before:.0%} to {each.after:.0%}"
                for o in outcomes
                for each in o.worse_sets
            ),
        ),
    }


def _by(kind: str, outcomes: list[Outcome], values: np.ndarray) -> dict[str, list[float]]:
    """Values of the outcomes by an entry of their combination."""
    found: dict[str, list[float]] = {}
    for outcome, value in zip(outcomes, values.tolist(), strict=True):
        found.setdefault(getattr(outcome.combination, kind), []).append(value)
    return found
