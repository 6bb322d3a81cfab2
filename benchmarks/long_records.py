"""Long records: whether the set identified from one represents all of its samples.

Each record is a sine of an integer or another frequency, a sweep, or random motion, of a damper of
one of the eight laws, or of a foreign law. The reference is a fit to samples at random places. Both
sets are judged on other samples at random places.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

import mr_damper_ros as mr
from benchmarks.dampers import ForeignDamper
from benchmarks.figure import Measured, in_processes, some_of
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import error_of_set, identify_global
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.peak_velocity import peak_velocity_of_period
from mr_damper_ros.kinematics.periodic_motion import MotionKind, PeriodicMotion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet

LAWS = tuple(MODELS)

_NOISE, _DISPLACEMENT_NOISE = 0.005, 1e-6
"""Noise of the force, relative to its standard deviation, and of the displacement [m]."""

_FITTED, _JUDGED = 20_000, 100_000
"""Samples of the reference fit, and samples on which both sets are judged."""

_STRETCHES, _DRIVEN = 20, 20.0
"""A law with memory is judged in this number of stretches, each driven by the motion in the time
[s] before it."""

_FEWEST_PER_CYCLE = 20
_RATES = (200.0, 500.0, 1000.0, 2000.0, 5000.0)
"""Sample rates [Hz], and the smallest number of samples per cycle."""

_MOST_DISPLACEMENT, _MOST_SPEED = 10e-3, 0.2
"""Largest amplitude [m] and peak velocity [m/s] of a sine."""

_KINDS = ("integer", "other", "integer", "sweep", "random")
"""Kinds of motion: sines of integer and other frequencies, and two others."""

_FOREIGN = ("stribeck", "shim_valves", "leakage", "remanence")
"""Laws of foreign dampers, each for one of 16 records that are short enough."""

_PIECES = 200

_LONGEST_FOREIGN = 500_000
"""Largest number of samples of a foreign damper, which takes 10 µs for each."""


@dataclass(frozen=True)
class LongRecord:
    """One record: its damper and law, motion, sample ``rate`` [Hz] and number of samples.

    ``foreign``: the foreign law of the damper; empty for a damper of the ``law``.
    """

    number: int
    law: str
    foreign: str
    motion: PeriodicMotion
    rate: float
    count: int
    current: float

    @property
    def name(self) -> str:
        """The record in words."""
        return (
            f"{self.number}: {self.law}{' of ' * bool(self.foreign)}{self.foreign}, "
            f"{self.motion.sentence}, {self.count} samples at {self.rate:g} Hz, {self.current:g} A"
        )

    def made(self) -> dict[str, Any]:
        """Displacement [m], force [N], current [A] and period [s]."""
        period, rng = 1.0 / self.rate, np.random.default_rng(self.number)
        # Piece by piece, because all tones at all samples would need gigabytes.
        times = np.array_split(np.arange(self.count, dtype=np.float64) * period, _PIECES)
        u, v, a = np.hstack([self.motion.at(piece) for piece in times])
        if self.motion.kind is MotionKind.SINE:
            v_m = np.full(self.count, 2.0 * math.pi * self.motion.frequency * self.motion.amplitude)
        else:
            v_m = peak_velocity_of_period(v, a, period)
        motion, current = Motion(u, v, a, v_m, sine=None), np.full(self.count, self.current)
        if self.foreign:
            force = ForeignDamper(self.foreign).force(motion, current, 28.0, period)
        else:
            damper = _damper(self.law)
            held = damper.held(motion)
            force = damper.law.window_force(Window(held, 0.0 * u, current, period), damper.values)
        noise = _NOISE * float(np.std(force)) * rng.standard_normal(self.count)
        return {
            "displacement": u + _DISPLACEMENT_NOISE * rng.standard_normal(self.count),
            "force": force + noise,
            "current": self.current,
            "period": period,
        }


def _damper(law: str) -> ParameterSet:
    """A damper of the law, with the set that fits a foreign damper in random motion."""
    period, duration = 2e-3, 30.0
    motion = PeriodicMotion(MotionKind.RANDOM, 0.02, 0.5, 12.0, duration, 7)
    u, v, a = motion.at(np.arange(round(duration / period), dtype=np.float64) * period)
    moved = Motion(u, v, a, peak_velocity_of_period(v, a, period), sine=None)
    current = np.full(u.size, 0.8)
    force = ForeignDamper("gas_bouc_wen").force(moved, current, 28.0, period)
    return mr.identify(
        displacement=u, force=force, current=current, period=period, model=law
    ).parameter_set


def records(seed: int = 0) -> list[LongRecord]:
    """Sixty records of all laws in turn, with motions of 0.1 to 50 Hz sampled at 0.2 to 5 kHz."""
    rng = np.random.default_rng(seed)
    made = []
    for number in range(60):
        frequency = 0.1 * 500.0 ** rng.random()
        rates = [rate for rate in _RATES if rate > _FEWEST_PER_CYCLE * frequency]
        rate, count = float(rng.choice(rates)), round(2e5 * 20.0 ** rng.random())
        kind = _KINDS[number // len(LAWS) % len(_KINDS)]
        if kind == "integer":
            # Frequency and number of samples as a person gives them.
            frequency = max(round(frequency), 1) if frequency > 0.7 else round(frequency, 1)
            count = round(count, -5)
        amplitude = min(_MOST_DISPLACEMENT, _MOST_SPEED / (2.0 * math.pi * frequency))
        if kind in ("integer", "other"):
            motion = PeriodicMotion(MotionKind.SINE, amplitude, frequency)
        else:
            band = frequency / 5.0, frequency
            period = max(125.0 / frequency, 20.0)
            motion = PeriodicMotion(MotionKind(kind), amplitude, *band, period, number)
        foreign = ""
        if number % 4 == 1 and count <= _LONGEST_FOREIGN:
            foreign = _FOREIGN[number // 4 % len(_FOREIGN)]
        current = float(rng.choice((0.3, 0.8, 1.2)))
        law = LAWS[number % len(LAWS)]
        made.append(LongRecord(number, law, foreign, motion, rate, count, current))
    return made


def _at_random(window: Window, law: str, seed: int, count: int) -> list[Window]:
    """Samples at random places; for a law with memory in other motion than a sine, stretches."""
    rng, whole = np.random.default_rng(seed), window.sample_count
    if window.steady or not MODELS[law].needs_past(window):
        return [window.part(np.sort(rng.choice(whole, min(count, whole // 2), replace=False)))]
    each, before = count // _STRETCHES, round(_DRIVEN / window.period)
    begins = rng.integers(0, whole - before - each, _STRETCHES).tolist()
    driven = [window.stretch(begin, before + each) for begin in begins]
    return [stretch.part(slice(before, None)) for stretch in driven]


class Outcome(NamedTuple):
    """Result of a record.

    NRMSE [1] of the identified set and of the reference on other samples; ``success`` and message
    of the identification, and its processor time [s].
    """

    record: LongRecord
    nrmse: float
    reference: float
    success: bool
    message: str
    seconds: float

    @property
    def ratio(self) -> float:
        """NRMSE over that of the reference."""
        return self.nrmse / self.reference


def judged(record: LongRecord) -> Outcome:
    """Identify the record, and compare the set with the reference."""
    made = record.made()
    began = time.process_time()
    found = mr.identify(**made, model=record.law)
    seconds = time.process_time() - began
    window, model = found.runs[0].measured.longest, MODELS[record.law]
    fitted = _at_random(window, record.law, 1, _FITTED)
    start = model.initial_values()[0]
    reference = identify_global(model, fitted, start, EvolutionSettings()).parameter_set
    unseen = _at_random(window, record.law, 2, _JUDGED)
    left = [error_of_set(each, unseen).nrmse for each in (found.parameter_set, reference)]
    return Outcome(record, left[0], left[1], found.success, found.message, seconds)


def figures(every: int = 5, seed: int = 0) -> Measured:
    """One in ``every`` record; five leaves twelve with all laws and kinds of motion."""
    outcomes = in_processes(judged, some_of(records(seed), every, seed))
    worst = max(outcomes, key=lambda outcome: outcome.ratio)
    failed = [outcome.record.name for outcome in outcomes if not outcome.success]
    return {
        "thinned_nrmse_ratio": (
            worst.ratio,
            f"{len(outcomes)} records, worst: {worst.record.name}. Processor time of all "
            f"identifications: {sum(outcome.seconds for outcome in outcomes):.0f} s. No success: "
            f"{'; '.join(failed) or 'none'}.",
        )
    }
