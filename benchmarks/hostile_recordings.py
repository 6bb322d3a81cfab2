"""Recordings that nobody should have made: an identification of them ends in a set or a sentence.

Emulated dampers of several laws, in motions that say little (rest, steps, hundredths of a
millimetre, a burst), with currents that change, and with flaws of instruments. What counts as a
failure is anything but a set whose error is a number, or a ValueError of this package: one of a
library tells the user nothing.
"""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

import numpy as np
from scipy import signal

import mr_damper_ros as mr
from benchmarks.figure import Figure
from benchmarks.other_dampers import DAMPERS
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording

Form = Callable[[Array, np.random.Generator], Array]
"""A signal along times (n,) [s], or what a flaw makes of a signal (n,)."""

T = TypeVar("T")

_PACKAGE = Path(mr.__file__).parent

_FINEST = 5e-4
"""Period [s] of the emulation; that of the recording is a multiple of it."""

_PERIODS = (1e-3, 2e-3, 5e-3, 1e-2)
_LENGTHS = (300, 800, 2000)
_NOISE = (0.0, 0.5, 5.0, 30.0)  # [N]
_MOST_RUNS = 3


def _smoothed(values: Array, time: Array, cutoff: float) -> Array:
    sections = signal.butter(4, cutoff, fs=1.0 / (time[1] - time[0]), output="sos")
    return np.asarray(signal.sosfilt(sections, values))


def _random(time: Array, rng: np.random.Generator) -> Array:
    values = _smoothed(rng.normal(size=time.size), time, rng.uniform(1.0, 6.0))
    return 6e-3 * values / np.std(values)


MOTIONS: Mapping[str, Form] = {
    "sine": lambda t, rng: 5e-3 * np.sin(2.0 * np.pi * rng.uniform(0.2, 5.0) * t),
    "slow": lambda t, _: 2e-2 * np.sin(2.0 * np.pi * 0.05 * t),
    "tiny": lambda t, _: 2e-5 * np.sin(2.0 * np.pi * t),
    "random": _random,
    "sweep": lambda t, _: 4e-3 * np.sin(2.0 * np.pi * (0.2 + 2.0 * t / t[-1]) * t),
    "steps": lambda t, _: _smoothed(5e-3 * np.sign(np.sin(4.4 * t)), t, 5.0),
    "rest at first": lambda t, _: 6e-3 * np.sin(9.4 * t) * (t > 0.6 * t[-1]),
    "burst": lambda t, _: 2e-2 * np.sin(19.0 * t) * np.exp(-10.0 * t / t[-1]),
    "ramp": lambda t, _: 1e-2 * t / t[-1] + 1e-3 * np.sin(12.6 * t),
}
"""Displacements [m]."""

CURRENTS: Mapping[str, Form] = {
    "none": lambda t, _: np.zeros_like(t),
    "constant": lambda t, _: np.full_like(t, 0.7),
    "square": lambda t, _: 0.6 + 0.5 * np.sign(np.sin(6.9 * t)),
    "sine": lambda t, _: 0.8 + 0.6 * np.sin(3.1 * t),
    "step": lambda t, _: np.where(t > 0.5 * t[-1], 1.0, 0.2),
    "random": lambda t, rng: np.repeat(rng.uniform(0.0, 2.0, t.size // 200 + 1), 200)[: t.size],
}
"""Of the supply [A]."""


def _stuck(force: Array, _: np.random.Generator) -> Array:
    force = force.copy()
    force[force.size // 3 : force.size // 2] = force[force.size // 3]
    return force


def _spikes(force: Array, rng: np.random.Generator) -> Array:
    force = force.copy()
    force[rng.integers(0, force.size, 5)] += 20.0 * np.std(force)
    return force


FLAWS: Mapping[str, Form] = {
    "sound": lambda f, _: f,
    "clipped": lambda f, _: np.clip(f, -0.5 * np.max(np.abs(f)), 0.5 * np.max(np.abs(f))),
    "stuck": _stuck,
    "uncentred": lambda f, _: f + 3.0 * np.std(f),
    "late": lambda f, rng: np.roll(f, rng.integers(1, 9)),
    "reversed": lambda f, _: -f,
    "in millinewtons": lambda f, _: 1e3 * f,
    "spikes": _spikes,
}
"""Of the force [N]."""


def figures(cases: int = 100, seed: int = 0) -> list[Figure]:
    """``identify_failures``: of so many identifications."""
    ends, failures = campaign(cases, seed)
    return [
        Figure(
            "identify_failures",
            len(failures),
            f"Of {cases} identifications of recordings that say little or are spoilt, those that "
            "ended in anything but a set or a sentence of this package",
            (0.0, 0.0),
            "; ".join([str(dict(ends)), *failures[:3]]),
        )
    ]


def campaign(cases: int, seed: int) -> tuple[Counter[str], list[str]]:
    """How many ended in a set, and in a sentence; and what went wrong."""
    ends: Counter[str] = Counter()
    failures = []
    for number in range(cases):
        rng = np.random.default_rng((seed, number))
        law, levels = _one_of(rng, MODELS), float(rng.choice([0.0, 0.1]))
        told, recordings = _recordings(rng)
        try:
            found = mr.identify(recordings, model=law, level_per_record=levels)
            end = "a set" if np.isfinite(found.parameter_set.nrmse) and str(found) else "no number"
        except Exception as error:  # whatever it is, it is a failure unless ...
            place = Path(traceback.extract_tb(error.__traceback__)[-1].filename)
            ours = isinstance(error, ValueError) and place.is_relative_to(_PACKAGE)
            end = "a sentence" if ours else f"{type(error).__name__}: {error}"
        ends[end if end.startswith("a ") else "failed"] += 1
        if not end.startswith("a "):
            failures.append(f"case {number}, {law}, {told}: {end}")
    return ends, failures


def _recordings(rng: np.random.Generator) -> tuple[str, list[Recording]]:
    damper = DAMPERS[_one_of(rng, DAMPERS)]
    told, recordings = [damper.model], []
    for place in range(rng.integers(1, _MOST_RUNS + 1)):
        period, count = float(rng.choice(_PERIODS)), int(rng.choice(_LENGTHS))
        stride = round(period / _FINEST)
        names = _one_of(rng, MOTIONS), _one_of(rng, CURRENTS), _one_of(rng, FLAWS)
        time: Array = np.arange(count * stride, dtype=float) * _FINEST
        u, i = MOTIONS[names[0]](time, rng), CURRENTS[names[1]](time, rng)
        window = Window.from_samples(u, np.zeros_like(u), i, _FINEST)
        force = damper.law.window_force(window, damper.values)[::stride]
        noise = rng.normal(0.0, float(rng.choice(_NOISE)), count)
        told.append(f"{', '.join(names)} ({count} samples, {1e3 * period:g} ms)")
        recordings.append(
            Recording(
                name=f"recording {place}",
                start_ns=place * 10**12,
                period=period,
                displacement=u[::stride],
                force=FLAWS[names[2]](force + noise, rng),
                current=i[::stride],
            )
        )
    return "; ".join(told), recordings


def _one_of(rng: np.random.Generator, names: Mapping[str, T]) -> str:
    return list(names)[int(rng.integers(len(names)))]
