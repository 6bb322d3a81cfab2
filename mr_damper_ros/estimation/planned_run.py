"""Runs of a test machine: what it may do, what it can do, and the first one.

A run is a sine, at one current or at a staircase of currents.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.estimation.force_knowledge import ForceGoal
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording

_SPEEDS = 6
_CURRENTS = 6
"""Peak velocities and currents of the candidates."""

_AMPLITUDES = (1.0, 0.5, 0.25)
"""Parts of the largest amplitude."""

_STAIRS = (2, 3, 4, 6)
"""Currents of a staircase."""

SETTLING = 0.1
"""Seconds after a step of the current that tell nothing: coil and force follow."""

_CURRENT_STEP = 0.05
"""A current that is so far [A] from that of its stretch has not been stepped yet."""

_LEAST_CYCLES = 1.0
"""A stretch at one current holds so many cycles at the least."""


@dataclass(frozen=True)
class MachineLimits:
    """What the test machine may do in a run.

    ``amplitude`` [m] about the centre, ``peak_velocity`` [m/s], ``force`` [N], ``current`` [A],
    ``duration`` [s], ``heat`` [J] that the damper may take up, frequencies (low, high) [Hz],
    ``sample_rate`` [Hz]. ``steps``: whether the current can change within a run, which nobody does
    by hand.

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

    def __post_init__(self) -> None:
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


@dataclass(frozen=True)
class PlannedRun:
    """A sine of ``amplitude`` [m] and ``frequency`` [Hz] for ``duration`` [s].

    The current goes through ``currents`` [A], each for the same time.
    """

    amplitude: float
    frequency: float
    currents: tuple[float, ...]
    duration: float

    @property
    def peak_velocity(self) -> float:
        """[m/s]."""
        return 2.0 * math.pi * self.frequency * self.amplitude

    @property
    def stretch(self) -> float:
        """Time [s] at each current."""
        return self.duration / len(self.currents)

    @property
    def sentence(self) -> str:
        """What to set, in words."""
        amperes = ", ".join(f"{current:.3g}" for current in self.currents)
        each = f", {self.stretch:.3g} s each" if len(self.currents) > 1 else ""
        return (
            f"{1e3 * self.amplitude:.3g} mm at {self.frequency:.3g} Hz for {self.duration:.3g} s "
            f"with {amperes} A{each}"
        )

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
        found = []
        for part in self.parts(recording.period):
            chosen = _settled(part, recording)
            found.append(
                Window.from_samples(
                    recording.displacement[chosen],
                    recording.force[chosen],
                    float(np.median(recording.current[chosen])),
                    recording.period,
                )
            )
        return found


def _settled(part: slice, recording: Recording) -> slice:
    """The samples of a stretch without those before the supply had come to its current."""
    current = recording.current[part]
    off = np.abs(current - np.median(current)) > _CURRENT_STEP
    late = np.flatnonzero(off[: current.size // 2])
    if not late.size:
        return part
    return slice(part.start + int(late[-1]) + 1 + round(SETTLING / recording.period), part.stop)


def first_run(goal: ForceGoal, limits: MachineLimits) -> PlannedRun:
    """The run of a damper of which nothing is known: the gentlest, at two currents.

    Raises ValueError where the machine cannot make it.
    """
    low, high = goal.current
    half = 0.5 * (low + min(high, limits.current))
    currents = (low, half) if limits.steps and half > low else (low,)
    runs = [
        run
        for part in _AMPLITUDES
        for run in _runs(limits, part, goal.peak_velocity[0], [currents, currents[:1]])
    ]
    if not runs:
        raise ValueError(
            f"the machine cannot make a run of {limits.duration:g} s at a peak velocity of "
            f"{goal.peak_velocity[0]:g} m/s that holds a cycle: allow longer runs"
        )
    return max(runs, key=lambda run: len(run.currents))


def candidate_runs(goal: ForceGoal, limits: MachineLimits) -> list[PlannedRun]:
    """All runs that the machine can make within a goal, from which a plan chooses."""
    low, high = goal.peak_velocity
    speeds = np.unique(np.geomspace(low, min(high, limits.peak_velocity), _SPEEDS))
    bottom, top = goal.current[0], min(goal.current[1], limits.current)
    currents = np.unique(np.linspace(bottom, top, _CURRENTS)).tolist()
    stairs: list[tuple[float, ...]] = [(current,) for current in currents]
    for count in _STAIRS if limits.steps else ():
        for start in range(len(currents)):
            for stride in range(1, len(currents)):
                chosen = tuple(currents[start::stride][:count])
                if len(chosen) == count and chosen not in stairs:
                    stairs.append(chosen)
    found: dict[PlannedRun, None] = {}
    for speed in speeds.tolist():
        for part in _AMPLITUDES:
            found.update(dict.fromkeys(_runs(limits, part, speed, stairs)))
    return list(found)


def _runs(
    limits: MachineLimits, part: float, speed: float, stairs: Sequence[tuple[float, ...]]
) -> list[PlannedRun]:
    """Runs of an amplitude and a peak velocity that the machine can make, in round numbers."""
    amplitude = _round_down(part * limits.amplitude)
    frequency = _round_down(speed / (2.0 * math.pi * amplitude))
    if not limits.frequency[0] <= frequency <= limits.frequency[1]:
        return []
    runs = [
        PlannedRun(amplitude, frequency, tuple(map(_round, s)), limits.duration) for s in stairs
    ]
    return [
        run
        for run in runs
        if (run.stretch - SETTLING * (len(run.currents) > 1)) * frequency >= _LEAST_CYCLES
    ]


def _round(value: float) -> float:
    return float(f"{value:.3g}")


def _round_down(value: float) -> float:
    """Two digits, never more than the value: limits hold."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.floor(value / unit + 1e-9) * unit:.6g}")
