"""Runs of a test machine: its limits, the runs themselves, and the candidate runs for a goal.

A run is a sine, a swept sine or a random motion at one current or at a staircase of currents.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from mr_damper_ros.kinematics.peak_velocity import peak_velocity_of_period
from mr_damper_ros.kinematics.periodic_motion import PHASES, MotionKind, PeriodicMotion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.quantities import SAME_CURRENT
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording

_MOST_HARMONICS = 100.0
"""Largest number of harmonics of a random motion; a longer motion repeats."""

SETTLING = 0.1
"""Time [s] after a current step that is excluded, because current and force still change."""


@dataclass(frozen=True)
class ForceGoal:
    """Goal: a relative standard ``error`` of the force at the worst point of the given ranges.

    ``peak_velocity`` [m/s] and ``current`` [A] are pairs (low, high), divided into ``speeds`` and
    ``currents`` points. The error is relative to the largest force in a cycle of ``amplitude`` [m]
    at the same point.

    Raises ValueError for an impossible goal.
    """

    error: float
    peak_velocity: tuple[float, float]
    current: tuple[float, float]
    amplitude: float = 0.01
    speeds: int = 5
    currents: int = 6

    def __post_init__(self) -> None:
        if not 0.0 < self.error < 1.0:
            raise ValueError(
                f"the error of the goal is {self.error}: give a fraction of the force, 0 to 1"
            )
        low, high = self.peak_velocity
        if not 0.0 < low <= high < math.inf:
            raise ValueError(
                f"the peak velocities of the goal are {low:g} to {high:g} m/s: give two "
                "positive values, the lower one first"
            )
        low, high = self.current
        if not 0.0 <= low <= high < math.inf:
            raise ValueError(
                f"the currents of the goal are {low:g} to {high:g} A: give the lower one first, "
                "and none below 0"
            )

    @property
    def points(self) -> list[tuple[float, float]]:
        """Operating points (m/s, A) that cover the range."""
        speeds = np.unique(np.geomspace(*self.peak_velocity, self.speeds))
        currents = np.unique(np.linspace(*self.current, self.currents))
        return [(v, i) for v in speeds.tolist() for i in currents.tolist()]

    def cycles(self) -> list[Window]:
        """A cycle at each point; its force is zero and is not used."""
        return [
            steady_cycle(self.amplitude, v / (2.0 * math.pi * self.amplitude), i)
            for v, i in self.points
        ]


def steady_cycle(amplitude: float, frequency: float, current: float) -> Window:
    """One cycle of a sine (amplitude [m], frequency [Hz]) at a current [A]; its force is zero."""
    period = 1.0 / (frequency * PHASES)
    # Samples are half a period away from the reversals, where rounding would decide the sign of the
    # acceleration.
    phase = 2.0 * math.pi * (np.arange(PHASES) + 0.5) / PHASES
    return Window.from_samples(amplitude * np.sin(phase), np.zeros(PHASES), current, period)


@dataclass(frozen=True)
class MachineLimits:
    """Limits of the test machine for a run.

    ``amplitude`` [m] about the centre, ``peak_velocity`` [m/s], ``force`` [N], ``current`` [A],
    ``duration`` [s], ``heat`` [J] that the damper may absorb, frequencies (low, high) [Hz],
    ``sample_rate`` [Hz]. ``steps``: whether the current can be stepped within a run, which is not
    possible by hand. ``motions``: the available motions; a machine set by hand makes only sines.

    Raises ValueError for impossible values.
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
        # Names are accepted as well.
        object.__setattr__(self, "motions", motions_of(self.motions))
        if MotionKind.SINE not in self.motions:
            raise ValueError(
                f"the machine's motions are {', '.join(kind.value for kind in self.motions)}: "
                "sine must be one of them"
            )
        for name in ("amplitude", "peak_velocity", "force", "duration", "heat", "sample_rate"):
            value = getattr(self, name)
            if not value > 0.0 or (math.isinf(value) and name not in ("force", "heat")):
                raise ValueError(
                    f"the machine's largest {name.replace('_', ' ')} is {value}: it must be "
                    "positive and finite"
                )
        if not 0.0 <= self.current < math.inf:
            raise ValueError(f"the machine's largest current is {self.current}: give it in amperes")
        if not 0.0 < self.frequency[0] < self.frequency[1]:
            raise ValueError(
                f"the machine's frequencies are {self.frequency[0]:g} to {self.frequency[1]:g} Hz: "
                "give two positive values, the lower one first"
            )


def motions_of(words: Iterable[str]) -> tuple[MotionKind, ...]:
    """The motions of these names, each once. Raises ValueError for an unknown name."""
    known = {kind.value: kind for kind in MotionKind}
    found = dict.fromkeys(words)
    for word in found:
        if word not in known:
            raise ValueError(f"the motion '{word}' is unknown: use {', '.join(known)}")
    return tuple(kind for kind in MotionKind if kind.value in found)


@dataclass(frozen=True)
class PlannedRun:
    """A motion of ``amplitude`` [m] for ``duration`` [s].

    The current takes the values ``currents`` [A] one after the other, each for the same time.
    ``kind`` is the motion: a sine of ``frequency`` [Hz], or a swept sine or random motion (with
    this ``seed``) from ``frequency`` to ``highest_frequency`` [Hz].
    """

    amplitude: float
    frequency: float
    currents: tuple[float, ...]
    duration: float
    kind: MotionKind = MotionKind.SINE
    highest_frequency: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "kind", MotionKind(self.kind))

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> PlannedRun:
        """Read the output of ``asdict`` back from JSON. Raises ValueError or TypeError."""
        return cls(**dict(document) | {"currents": tuple(document["currents"])})

    @property
    def motion(self) -> PeriodicMotion:
        """The motion of the machine. Raises ValueError if it is impossible."""
        return _motion(replace(self, currents=()))

    @property
    def peak_velocity(self) -> float:
        """Largest speed [m/s]."""
        return self.motion.peak_velocity

    @property
    def span(self) -> float:
        """Half the distance [m] between the lowest and the highest displacement."""
        return self.motion.span

    @property
    def stretch(self) -> float:
        """Time [s] at each current."""
        return self.duration / len(self.currents)

    @property
    def sentence(self) -> str:
        """The settings of the run in words."""
        amperes = ", ".join(f"{current:.3g}" for current in self.currents)
        each = f", {self.stretch:.3g} s each" if len(self.currents) > 1 else ""
        return f"{self.motion.sentence} for {self.duration:.3g} s with {amperes} A{each}"

    def current_at(self, time: Array) -> Array:
        """Current [A] at the times [s], shape (n,)."""
        step = np.floor(time / self.stretch + 1e-9).astype(int)
        return np.asarray(self.currents)[np.clip(step, 0, len(self.currents) - 1)]

    def parts(self, period: float) -> list[slice]:
        """Samples of each current in a recording with this sample period [s], without settling."""
        count = round(self.stretch / period)
        settling = round(SETTLING / period)
        return [
            slice(place * count + settling * (place > 0), (place + 1) * count)
            for place in range(len(self.currents))
        ]

    def windows(self, recording: Recording) -> list[Window]:
        """A window for each current in a recording of the run, at the median measured current."""
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
    """A window of one period of a motion that began long before, with its peak velocity."""
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
    """Samples of a stretch from the time at which the supply reached its current."""
    current = recording.current[part]
    off = np.abs(current - np.median(current)) > SAME_CURRENT
    late = np.flatnonzero(off[: current.size // 2])
    if not late.size:
        return part
    return slice(part.start + int(late[-1]) + 1 + round(SETTLING / recording.period), part.stop)


_AMPLITUDES = (1.0, 0.5, 0.25)
"""Amplitudes of the candidates, relative to the largest amplitude."""

_RANDOM_BAND = (0.25, 2.0)
"""Frequency band of a random motion, relative to the sine of the same amplitude and peak velocity.
"""

STAIRS = (2, 3, 4, 6)
"""Number of currents of a staircase."""


def first_run(goal: ForceGoal, limits: MachineLimits) -> PlannedRun:
    """The first run of an unknown damper: a gentle motion at a few small currents.

    Raises ValueError if the machine cannot make it.
    """
    low, high = goal.current
    half = 0.5 * (low + min(high, limits.current))
    counts = (1, *STAIRS[:-1]) if limits.steps and half > low else (1,)
    stairs = [tuple(map(round_to, np.linspace(low, half, count))) for count in counts]
    runs = _runs((_sine(limits, part, goal.peak_velocity[0]) for part in _AMPLITUDES), stairs)
    if not runs:
        raise ValueError(
            f"a run of {limits.duration:g} s at a peak velocity of {goal.peak_velocity[0]:g} m/s "
            "is shorter than a cycle: allow longer runs"
        )
    return max(runs, key=lambda run: len(run.currents))


def candidate_runs(goal: ForceGoal, limits: MachineLimits) -> list[PlannedRun]:
    """The runs within the limits of the machine from which a plan selects.

    Motions other than a sine are only offered at the larger peak velocities and amplitudes.
    """
    low, high = goal.peak_velocity
    top = min(high, limits.peak_velocity)
    speeds = np.unique(np.geomspace(low, top, goal.speeds + 1)).tolist()
    sines = [_sine(limits, part, speed) for speed in speeds for part in _AMPLITUDES]
    broad = [
        _broad_run(limits, kind, part, (low, speed), seed)
        for seed, speed in enumerate(speeds[1:][-len(_AMPLITUDES) :])
        for part in _AMPLITUDES[:-1]
        for kind in limits.motions
        if kind is not MotionKind.SINE
    ]
    return _runs([*sines, *broad], _stairs(goal, limits))


def _runs(
    motions: Iterable[PlannedRun | None], stairs: Sequence[tuple[float, ...]]
) -> list[PlannedRun]:
    """Each motion with each of the currents that leave it a whole cycle at every current."""
    runs = [replace(motion, currents=each) for motion in motions if motion for each in stairs]
    return [
        run
        for run in dict.fromkeys(runs)
        if (run.stretch - SETTLING * (len(run.currents) > 1))
        * max(run.frequency, 0.5 * (run.frequency + run.highest_frequency))
        >= 1.0
    ]


def _stairs(goal: ForceGoal, limits: MachineLimits) -> list[tuple[float, ...]]:
    """Currents of the candidate runs: single ones, or several if the machine can step them."""
    bottom, top = goal.current[0], min(goal.current[1], limits.current)
    currents = list(map(round_to, np.unique(np.linspace(bottom, top, max(STAIRS)))))
    strides = [currents[s::d] for s in range(len(currents)) for d in range(1, len(currents))]
    counts = STAIRS if limits.steps else ()
    several = [tuple(each[:count]) for count in counts for each in strides if len(each) >= count]
    return list(dict.fromkeys([*((current,) for current in currents), *several]))


def _sine(limits: MachineLimits, part: float, speed: float) -> PlannedRun | None:
    """A sine of ``part`` of the amplitude with a peak ``speed`` [m/s]; None beyond the limits."""
    amplitude = _rounded(part * limits.amplitude, math.floor)
    frequency = _rounded(speed / (2.0 * math.pi * amplitude), math.floor)
    if not limits.frequency[0] <= frequency <= limits.frequency[1]:
        return None
    return PlannedRun(amplitude, frequency, (0.0,), limits.duration)


def _broad_run(
    limits: MachineLimits, kind: MotionKind, part: float, speeds: tuple[float, float], seed: int
) -> PlannedRun | None:
    """A motion other than a sine within these peak velocities; None if there is none."""
    amplitude = _rounded(part * limits.amplitude, math.floor)
    low, high = (speed / (2.0 * math.pi * amplitude) for speed in speeds)
    if kind is MotionKind.RANDOM:
        low, high = (part * high for part in _RANDOM_BAND)
    low, high = max(low, limits.frequency[0]), min(high, limits.frequency[1])
    try:
        while True:
            run = _banded(PlannedRun(amplitude, low, (0.0,), limits.duration, kind, high, seed))
            excess = run.motion.growing_velocity / speeds[1]
            if excess <= 1.0:
                return run
            # If it is too fast, a sweep ends earlier and a random motion gets a smaller amplitude.
            if kind is MotionKind.SWEEP:
                high = 0.99 * high / excess
            else:
                amplitude = _rounded(amplitude / excess, math.floor)
    except ValueError:  # the band is too narrow for a motion
        return None


def _banded(run: PlannedRun) -> PlannedRun:
    """The run with round frequencies; a swept sine has whole cycles."""
    low, high = _rounded(run.frequency, math.ceil), _rounded(run.highest_frequency, math.floor)
    if run.kind is MotionKind.SWEEP:
        cycles = math.ceil(0.5 * (low + high) * run.duration - 1e-9)
        low = _rounded(max(2.0 * cycles / run.duration - high, low), math.ceil, 6)
    return replace(run, frequency=low, highest_frequency=high)


def round_to(value: float, digits: int = 3) -> float:
    """The value rounded to this number of digits."""
    return float(f"{value:.{digits}g}")


def _rounded(value: float, way: Callable[[float], int], digits: int = 2) -> float:
    """The value rounded by ``way`` (floor or ceil) to this number of digits."""
    unit = 10.0 ** (math.floor(math.log10(value)) + 1 - digits)
    # A rounding error of the quotient must not count as a digit.
    return round_to(way(round(value / unit, 9)) * unit, 6)
