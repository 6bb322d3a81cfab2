"""Faults of the load cell that look like the damper: bursts, and steps within one sample.

A knock or a loose plug raises the measured force for milliseconds; afterwards the damper may lose
force. An amplifier that switches its range, or a tare, changes a factor or an offset at once. Own
and foreign dampers, drawn by the seed, show what is missed and what is refused or named wrongly.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, product, repeat
from typing import NamedTuple

import numpy as np

from benchmarks.dampers import DAMPERS, LAWS, ForeignDamper
from benchmarks.figure import Measured, in_processes
from benchmarks.motions import random_motion
from benchmarks.streams import StreamTrial, TrialResult, TrialSettings, worst_stretch
from mr_damper_ros.emulation.emulator import CurrentSchedule
from mr_damper_ros.emulation.faults import faults_of
from mr_damper_ros.emulation.motions import Excitation, SineMotion
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.validity import DoubtKind

_OWN, _FOREIGN = tuple(DAMPERS), tuple(LAWS)


def _trial(
    name: str, motion: Excitation, current: float, seed: int, rate: float = 1000.0
) -> StreamTrial:
    damper = DAMPERS[name] if name in DAMPERS else ForeignDamper(name)
    block = max(round(0.02 * rate), 1)
    return StreamTrial(
        damper, motion, current, settings=TrialSettings(seed, block, sample_rate=rate)
    )


# -- bursts ----------------------------------------------------------------------------------------

MOTIONS: dict[str, tuple[float, float, float]] = {
    "0.05 Hz": (0.01, 0.05, 64.0),
    "0.2 Hz": (0.008, 0.2, 24.0),
    "1 Hz": (0.005, 1.0, 12.0),
    "5 Hz": (0.0015, 5.0, 12.0),
}
"""Amplitude [m] and frequency [Hz], and the time [s] of the first burst."""

_LOST = 0.3
"""Fraction of the force that is left half a second after the first burst."""

_WRONG = 0.2
"""Error of a wrong force, relative to the peak of the true force that is left."""

_AFTER = 10.0
"""Time [s] for which a stream is observed after the first burst."""


class Bursts(NamedTuple):
    """Bursts of ``size`` [N] and ``width`` [s], one or one ``every`` number of seconds."""

    size: float
    width: float
    every: float

    @property
    def name(self) -> str:
        """The bursts in words."""
        often = f" every {self.every:.2g} s" if self.every < _AFTER else ""
        return f"{1e3 * self.width:.0f} ms of {self.size:.0f} N{often}"

    def texts(self, begin: float) -> list[str]:
        """The bursts as faults."""
        times = begin + np.arange(0.0, _AFTER, self.every)
        return [f"force_offset:{self.size:g}@{at:g}-{at + self.width:g}" for at in times]


def _drawn(rng: np.random.Generator) -> Bursts:
    size = float(rng.choice([-1.0, 1.0]) * np.exp(rng.uniform(*np.log((3e3, 20e3)))))
    width = round(float(np.exp(rng.uniform(*np.log((1e-3, 40e-3))))), 3)
    return Bursts(round(size), width, float(rng.choice([_AFTER, rng.uniform(0.7, 3.3)])))


def _burst_cases(
    job: tuple[str, str], cases: int, seed: int
) -> list[tuple[float, float, float, str]]:
    """Longest and total time of wrong and valid force, and of right force refused for a burst."""
    motion, name = job
    amplitude, frequency, begin = MOTIONS[motion]
    rng = np.random.default_rng((seed, [*MOTIONS].index(motion), len(name)))
    base = _trial(name, SineMotion(amplitude, frequency), 1.2, seed)
    base.advance(begin - 0.5)
    clean = base.branch().run(_AFTER)
    found = []
    for _ in range(cases):
        bursts = _drawn(rng)
        texts = bursts.texts(begin)
        lost = base.branch(faults_of([*texts, f"force_loss:{_LOST}@{begin + 0.5:g}"], seed))
        result = lost.run(_AFTER)
        after = result.time >= begin + 0.6
        error = np.abs(result.predicted - result.true) / np.max(np.abs(result.true[after]))
        wrong = worst_stretch(after & result.valid & (error > _WRONG), result.period)
        sound = base.branch(faults_of(texts, seed)).run(_AFTER)
        refused = clean.valid & sound.right & ~sound.valid & (sound.time >= begin)
        for at in np.arange(0.0, _AFTER, bursts.every) + begin:
            refused &= ~((sound.time >= at - 1e-9) & (sound.time < at + bursts.width))
        count = len(bursts.texts(begin))
        total = float(np.count_nonzero(refused)) * sound.period / count
        found.append((*wrong, total, f"{name}, {motion}, {bursts.name}"))
    return found


def burst_figures(cases: int = 3, dampers: int = 2, seed: int = 0) -> Measured:
    """Run this number of bursts for this number of dampers at each frequency."""
    rng = np.random.default_rng(seed)
    names = [[str(rng.choice(_OWN)), *map(str, rng.choice(_FOREIGN, dampers - 1))] for _ in MOTIONS]
    jobs = [(m, name) for m, drawn in zip(MOTIONS, names, strict=True) for name in drawn]
    found = [*chain(*in_processes(_burst_cases, jobs, repeat(cases), repeat(seed)))]
    longest, total, refused = (max(found, key=lambda each: each[k]) for k in range(3))
    return {
        "burst_wrong_valid_s": (
            [longest[0], total[1]],
            f"{len(found)} cases. Longest: {longest[3]}; most: {total[3]}.",
        ),
        "burst_right_refused_s": (refused[2], f"{refused[3]}."),
    }


# -- steps within one sample -----------------------------------------------------------------------

STEPS = ("force_gain:0.5", "force_gain:2", "force_offset:150", "force_offset:-150")
"""Steps of the load cell."""

REAL = ("force_loss:0.5", "force_loss:0.3", "coil_factor:0", "current", "friction:300")
"""Changes of the damper, of its coil and of its current."""

RATES = (100.0, 200.0, 500.0, 1000.0, 2000.0)
"""Sample rates [Hz] of the changes of the damper."""

_BEGIN, _LASTS, _AGAIN = 12.0, 4.0, 3.0
"""Time of the step [s], until the load cell is back, and after that."""

_MOVED: tuple[Excitation, ...] = (
    SineMotion(0.005, 1.0),
    SineMotion(0.006, 2.0),
    SineMotion(0.002, 5.0),
)


def _motion(rng: np.random.Generator, seed: int) -> Excitation:
    place = int(rng.integers(len(_MOVED) + 1))
    return _MOVED[place] if place < len(_MOVED) else random_motion(4e-3, 0.2, 3.0, 30.0, seed)


class Stepped(NamedTuple):
    """Result of a step of the load cell: the longest time [s] of wrong and valid force.

    ``named`` and ``learnt`` say whether the step was named, and whether a set was taken from it;
    ``valid`` is the share of the last second, after the load cell was back, with valid force, over
    that before the step.
    """

    wrong: float
    named: bool
    learnt: bool
    valid: float
    name: str


def _named(result: TrialResult) -> bool:
    return bool(
        any(each.verdict is Verdict.INSTRUMENT for each in result.reports)
        and (result.doubts == DoubtKind.INSTRUMENT).any()
    )


def _steps(name: str, seed: int) -> list[Stepped]:
    rng = np.random.default_rng((seed, len(name), 1))
    motion = _motion(rng, seed)
    base = _trial(name, motion, 1.2, seed)
    base.advance(_BEGIN - 0.5)
    found = []
    for step in STEPS:
        begin = _BEGIN + round(float(rng.uniform(0.0, 1.0)), 3)
        trial = base.branch(faults_of([f"{step}@{begin:g}-{begin + _LASTS:g}"], seed))
        result = trial.run(0.5 + 1.0 + _LASTS + _AGAIN)
        last, before = result.time >= result.time[-1] - 1.0, result.time < begin
        before &= result.time >= begin - 2.0
        share = float(np.mean(result.valid[last]) / max(np.mean(result.valid[before]), 0.01))
        learnt = any(begin < each.time < begin + _LASTS for each in result.sets)
        wrong = result.wrong_valid(since=begin).longest
        found.append(
            Stepped(
                wrong,
                _named(result),
                learnt,
                share,
                f"{step}@{begin:g} {name} {type(motion).__name__}",
            )
        )
    return found


def _real_changes(job: tuple[str, float], seed: int) -> list[tuple[bool, str]]:
    """Whether each change of a damper was named a step of the load cell."""
    name, rate = job
    rng = np.random.default_rng((seed, len(name), round(rate)))
    motion = _motion(rng, seed)
    base = _trial(name, motion, 1.2, seed, rate)
    base.advance(_BEGIN - 0.5)
    found = []
    for change in REAL:
        begin = _BEGIN + round(float(rng.uniform(0.0, 1.0)), 3)
        if change == "current":
            times = begin + 0.4 * np.arange(6)
            levels = rng.uniform(0.0, 1.5, times.size)
            schedule = CurrentSchedule([0.0, *times], [1.2, *levels])
            trial = base.branch(current=schedule)
        else:
            trial = base.branch(faults_of([f"{change}@{begin:g}"], seed))
        found.append((_named(trial.run(4.0)), f"{change}@{begin:g} {name} {rate:g} Hz"))
    return found


def step_figures(
    stepped: Sequence[str] = (*_OWN, *_FOREIGN[:5]),
    changed: Sequence[str] = (*_OWN, *_FOREIGN),
    seed: int = 0,
) -> Measured:
    """Steps with these dampers, and changes of these dampers at two sample rates each."""
    found = [*chain(*in_processes(_steps, stepped, repeat(seed)))]
    jobs = [
        (name, RATES[(place + seed + turn) % len(RATES)])
        for (place, name), turn in product(enumerate(changed), (0, 2))
    ]
    real = [*chain(*in_processes(_real_changes, jobs, repeat(seed)))]
    worst = max(found, key=lambda each: each.wrong)
    unnamed = [each.name for each in found if not each.named]
    slow = min(found, key=lambda each: each.valid)
    wrongly = [text for named, text in real if named]
    return {
        "range_switch_wrong_s": (worst.wrong, f"{worst.name}."),
        "range_switch_named_percent": (
            100.0 * (1.0 - len(unnamed) / len(found)),
            f"{len(found)} steps. Sets learnt from: {sum(each.learnt for each in found)}. Valid "
            f"again, least: {slow.valid:.0%} ({slow.name}). Not named: {'; '.join(unnamed)}",
        ),
        "real_changes_named_percent": (
            100.0 * len(wrongly) / len(real),
            f"{len(real)} changes. {'; '.join(wrongly)}",
        ),
    }
