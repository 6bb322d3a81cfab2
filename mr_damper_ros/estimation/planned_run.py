"""Runs of a test machine, and what it may do.

A run is a sine, a swept sine or random motion, at one current or at a staircase of currents.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from mr_damper_ros.kinematics.peak_velocity import peak_velocity_of_period
from mr_damper_ros.kinematics.periodic_motion import MotionKind, PeriodicMotion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording

_MOST_HARMONICS = 100.0
"""Random motion has no more of them: where the run lasts longer, it repeats."""

SETTLING = 0.1
"""Seconds after a step of the current that tell nothing: coil and force follow."""

_CURRENT_STEP = 0.05
"""A current that is so far [A] from that of its stretch has not been stepped yet."""


@dataclass(frozen=True)
class MachineLimits:
    """What the test machine may do in a run.

    ``amplitude`` [m] about the centre, ``peak_velocity`` [m/s], ``force`` [N], ``current`` [A],
    ``duration`` [s], ``heat`` [J] that the damper may take up, frequencies (low, high) [Hz],
    ``sample_rate`` [Hz]. ``steps``: whether the current can change within a run, which nobody does
    by hand. ``motions``: how it can move; a press that is set by hand makes sines alone.

    Raises ValueError for values that no machine has.
    """

    amplitude: float
    peak_velocity: float
    force: float
    current: float
    duration: float
    heat: float = math.inf
    frequency: tuple[float, float] = (0.1, 20.0)
    sample_rate: float = 1000.0
    steps: bool = True
    motions: tuple[MotionKind, ...] = (MotionKind.SINE,)

    def __post_init__(self) -> None:
        if MotionKind.SINE not in self.motions:
            raise ValueError(
                f"the machine's motions are {', '.join(kind.value for kind in self.motions)}: "
                "sine must be one of them"
            )
        for name in ("amplitude", "peak_velocity", "force", "duration", "heat", "sample_rate"):
            if not getattr(self, name) > 0.0:
                raise ValueError(
                    f"the machine's largest {name.replace('_', ' ')} is {getattr(self, name)}: it "
                    "must be positive"
                )
        if not 0.0 <= self.current < math.inf:
            raise ValueError(f"the machine's largest current is {self.current}: give it in ampere")
        if not 0.0 < self.frequency[0] < self.frequency[1]:
            raise ValueError(
                f"the machine's frequencies are {self.frequency[0]:g} to {self.frequency[1]:g} Hz: "
                "they must be positive, the lower first"
            )


def motions_of(words: Iterable[str]) -> tuple[MotionKind, ...]:
    """The motions named, each once. Raises ValueError for a word that is none."""
    known = {kind.value: kind for kind in MotionKind}
    found = dict.fromkeys(words)
    for word in found:
        if word not in known:
            raise ValueError(f"the motion '{word}' is unknown: use {', '.join(known)}")
    return tuple(kind for kind in MotionKind if kind.value in found)


@dataclass(frozen=True)
class PlannedRun:
    """A motion of ``amplitude`` [m] for ``duration`` [s].

    The current goes through ``currents`` [A], each for the same time. ``kind`` tells the motion: a
    sine of ``frequency`` [Hz], or a swept sine or random motion (of this ``seed``) from
    ``frequency`` to ``highest_frequency`` [Hz].
    """

    amplitude: float
    frequency: float
    currents: tuple[float, ...]
    duration: float
    kind: MotionKind = MotionKind.SINE
    highest_frequency: float = 0.0
    seed: int = 0

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> PlannedRun:
        """The run that ``asdict`` wrote, as JSON gives it back. Raises ValueError or TypeError."""
        given = dict(document)
        kind = MotionKind(given.pop("kind", MotionKind.SINE))
        return cls(**given | {"currents": tuple(given["currents"]), "kind": kind})

    @property
    def motion(self) -> PeriodicMotion:
        """How the machine moves. Raises ValueError where that makes no sense."""
        return _motion(replace(self, currents=()))

    @property
    def peak_velocity(self) -> float:
        """Largest speed [m/s]."""
        return self.motion.peak_velocity

    @property
    def span(self) -> float:
        """Half the way [m] from the lowest to the highest displacement."""
        return self.motion.span

    @property
    def stretch(self) -> float:
        """Time [s] at each current."""
        return self.duration / len(self.currents)

    @property
    def sentence(self) -> str:
        """What to set, in words."""
        amperes = ", ".join(f"{current:.3g}" for current in self.currents)
        each = f", {self.stretch:.3g} s each" if len(self.currents) > 1 else ""
        return f"{self.motion.sentence} for {self.duration:.3g} s with {amperes} A{each}"

    def current_at(self, time: Array) -> Array:
        """Current [A] at the times [s], shape (n,)."""
        step = np.floor(time / self.stretch + 1e-9).astype(int)
        return np.asarray(self.currents)[np.clip(step, 0, len(self.currents) - 1)]

    def parts(self, period: float) -> list[slice]:
        """The samples of each stretch in a recording of this period [s], once all is settled."""
        count = round(self.stretch / period)
        settling = round(SETTLING / period)
        return [
            slice(place * count + settling * (place > 0), (place + 1) * count)
            for place in range(len(self.currents))
        ]

    def windows(self, recording: Recording) -> list[Window]:
        """A window of each stretch of a recording of the run, at the current measured there."""
        parts = [_settled(part, recording) for part in self.parts(recording.period)]
        currents = [float(np.median(recording.current[part])) for part in parts]
        displacement, force = recording.displacement, recording.force
        if self.kind is MotionKind.SINE:
            return [
                Window.from_samples(displacement[part], force[part], current, recording.period)
                for part, current in zip(parts, currents, strict=True)
            ]
        amperes = np.array(recording.current)
        for part, current in zip(parts, currents, strict=True):
            amperes[part] = current
        whole = Window.from_samples(displacement, force, amperes, recording.period)
        return [with_motion_before(whole).part(part) for part in parts]


def with_motion_before(period: Window) -> Window:
    """A window of one period of a motion that had gone on before, as its peak velocity shows."""
    motion = period.motion
    if motion.sine is not None:
        return period
    peak = peak_velocity_of_period(motion.velocity, motion.acceleration, period.period)
    return replace(period, motion=replace(motion, peak_velocity=peak))


@lru_cache(maxsize=256)
def _motion(run: PlannedRun) -> PeriodicMotion:
    period = run.duration
    if run.kind is MotionKind.RANDOM:
        period /= math.ceil(run.duration * run.highest_frequency / _MOST_HARMONICS)
    return PeriodicMotion(
        run.kind, run.amplitude, run.frequency, run.highest_frequency, period, run.seed
    )


def _settled(part: slice, recording: Recording) -> slice:
    """The samples of a stretch without those before the supply had come to its current."""
    current = recording.current[part]
    off = np.abs(current - np.median(current)) > _CURRENT_STEP
    late = np.flatnonzero(off[: current.size // 2])
    if not late.size:
        return part
    return slice(part.start + int(late[-1]) + 1 + round(SETTLING / recording.period), part.stop)
