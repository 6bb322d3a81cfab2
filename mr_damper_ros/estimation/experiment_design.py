"""Accuracy of the force over an operating range, and the runs that would improve it.

A run is a sine, a swept sine or a random motion at one current or at a staircase of currents.

The law is linearised about a parameter set. The Fisher information of the samples, with the
plausible range of dampers as prior information, gives the covariance of the parameters, and from it
follows the standard error of the force at every phase of a cycle. An uncertain parameter counts
only as far as it affects the force. The repeatable part of the residual is model error, not noise.
The model error grows with the distance from the windows.

Among the runs within the limits of the machine, the plan selects the run that is expected to reduce
the worst error of the force most (G-optimality: Pukelsheim, "Optimal design of experiments", 1993),
or the run that determines all parameters together best (D-optimality). Because the law is
nonlinear, the value of a run is averaged over sets that fit the present data equally well but
differ in the parameters that the data do not determine (Chaloner and Verdinelli, "Bayesian
experimental design: a review", Statistical Science 10, 1995).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import lru_cache
from typing import Any

import numpy as np

from mr_damper_ros.estimation.covariance import (
    SAME_MOTION,
    SIGNIFICANT,
    CyclePhases,
    noise_level,
    prior_root,
    triangular_factor,
)
from mr_damper_ros.estimation.global_fit import with_linear_refitted
from mr_damper_ros.estimation.local_search import LocalSearch, Posterior, Prior
from mr_damper_ros.estimation.observability import SURE, operating_points_within, parameter_spans
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.peak_velocity import peak_velocity_of_period
from mr_damper_ros.kinematics.periodic_motion import PHASES, MotionKind, PeriodicMotion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.misfit import ChosenParameters, Misfit
from mr_damper_ros.models.quantities import NOTICED, SAME_CURRENT, LoopReading
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording

# -- runs of a test machine -----------------------------------------------------------------------

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
        period = self.duration
        if self.kind is MotionKind.RANDOM:
            period /= math.ceil(self.duration * self.highest_frequency / _MOST_HARMONICS)
        band = self.frequency, self.highest_frequency
        return _motion(self.kind, self.amplitude, *band, period, self.seed)

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


_motion = lru_cache(maxsize=256)(PeriodicMotion)
"""A motion from its fields; its limits take long to compute."""


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


# -- accuracy of the force, and the run that improves it most --------------------------------------

_DRAWS = 200
"""Number of random draws: of shape parameters for the prior, and of parameters for the errors."""

_FEWEST_IN_PART = 8
"""Smallest number of samples in a part of a cycle, needed to estimate the noise."""

_GROWTH = 2.0
"""Relative growth of the model error per width of the range, away from the nearest window. With 0,
1, 2 and 2.5, the true error over the claimed one has a 90 % quantile of 1.44, 1.37, 1.27 and 1.14,
and a median of 0.96, 0.94, 0.79 and 0.73 (eleven foreign laws, three choices of runs)."""

_SETS = 8
"""Number of sets that represent the undetermined parameters."""

_ROUNDS = 2
"""Number of rounds, in each of which the noise and then the set is estimated."""

_NORM = 8.0
"""Order of the norm that replaces the maximum over the points, because a single run often does not
change the maximum."""

_PARTS = math.lcm(*STAIRS)
"""Number of parts into which a motion other than a sine is divided; the steps of every staircase
contain a whole number of parts."""

_FEW_PHASES = 4
"""When runs are compared, every fourth phase of a cycle is used."""

_SPEED_STEP = 5.0
"""Largest peak velocity of the next run relative to the fastest run so far."""

_CURRENT_STEP = 0.5
"""Largest increase of the current beyond the largest current so far, as a part of the range."""

_LOOK_AHEAD = 12
"""Number of runs planned ahead to predict whether the goal can be met."""


class Cycles:
    """Force over many cycles at once, and its gradient, for any parameter set of a model."""

    def __init__(self, model: Model, cycles: Sequence[Window]) -> None:
        self._problem = Misfit(model, cycles, [1.0] * len(cycles))
        self._shape = len(cycles), PHASES

    def force(self, parameters: Array) -> Array:
        """Force (k, phases) [N]."""
        # The force of the windows is zero, so the residual is the force of the set.
        return self._problem.residual(parameters).reshape(self._shape)

    def gradient(self, parameters: Array) -> Array:
        """Derivatives (k, phases, p) of the force with respect to the parameters."""
        return self._problem.jacobian(parameters).reshape(*self._shape, -1)

    def relative_gradient(self, parameters: Array) -> Array:
        """:meth:`gradient` relative to the largest force of each cycle."""
        largest = np.max(np.abs(self.force(parameters)), axis=1)
        return self.gradient(parameters) / np.maximum(largest, 1e-9)[:, None, None]


@dataclass(frozen=True, eq=False)
class PointErrors:
    """Relative standard error (k,) of the force at each point: the largest within its cycle.

    ``worst`` is the median and ``bound`` the 95 % quantile (NaN: unknown) of the worst error over
    all points and phases. If the errors at many points are independent, ``worst`` exceeds every
    standard error. If one direction of the parameters dominates, so that the errors are
    proportional, ``worst`` may be as low as 0.67 times the largest standard error. All errors
    include the model error, which is ``model_error`` at the worst point.
    """

    points: Sequence[tuple[float, float]]
    errors: Array
    worst: float
    bound: float = math.nan
    model_error: float = 0.0

    @property
    def sentence(self) -> str:
        """The accuracy of the force and its confidence in words."""
        known = f"{self.worst:.2%} at worst with 50 % confidence"
        if not math.isnan(self.bound):
            known += f", and {self.bound:.2%} with 95 % confidence"
        if self.model_error > 0.0:
            known += f" (of this, {self.model_error:.2%} is model error)"
        return known

    @property
    def worst_point(self) -> tuple[float, float]:
        """The point (m/s, A) with the largest standard error."""
        return self.points[int(np.argmax(self.errors))]


def cycle_errors(gradient: Array, information: Array) -> Array:
    """Largest standard error of each cycle (m, k), for many information matrices (m, p, p).

    If ``gradient`` (k, phases, p) is relative, so are the errors.
    """
    count, phases, size = gradient.shape
    flat = gradient.reshape(-1, size)
    # Units differ by many orders of magnitude.
    scale = 1.0 / np.sqrt(np.diagonal(information, axis1=-2, axis2=-1))
    units = scale[:, :, None] * scale[:, None, :]
    # Without noise in the data, rounding can make the matrix singular or indefinite.
    rounding = size**2 * np.finfo(float).eps * np.eye(size)
    inverse = np.linalg.inv(information * units + rounding) * units
    variance = np.sum((flat @ inverse) * flat, axis=-1)
    errors = np.sqrt(np.maximum(variance, 0.0)).reshape(-1, count, phases)
    return np.asarray(errors.max(axis=-1))


def information_of(covariance: Array) -> Array:
    """Inverse (p, p) of a covariance; without noise in the data, rounding makes it indefinite."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors / np.maximum(values, np.finfo(float).eps * values[-1]) @ vectors.T)


def model_error(model: Model, window: Window, parameters: Array) -> float:
    """Largest repeatable residual of a window beyond noise, relative to its largest force.

    Means over the parts of a cycle separate it from noise. The result is 0 if noise explains the
    means (chi-squared test). The force is the measured one: a law whose force is too large would
    otherwise count as more accurate than it is.
    """
    residual = model.window_force(window, parameters) - window.force
    count = residual.size
    phases = CyclePhases.of(window, most=min(2 * PHASES, count // _FEWEST_IN_PART))
    if phases is not None:
        places = phases.numbers
    else:
        # Only in a steady sine is the past known.
        residual = residual[model.settled(window, parameters)]
        count = residual.size
        cycle = 1.0 / max(LoopReading.of(window).frequency * window.period, 1e-12)
        places = np.arange(count) // max(round(cycle / (2 * PHASES)), _FEWEST_IN_PART)
    counts = np.maximum(np.bincount(places), 1)
    means = np.bincount(places, residual) / counts
    variance = float(np.sum((residual - means[places]) ** 2)) / max(count - means.size, 1)
    parts = counts.size
    power = float(np.sum(counts * means**2)) / max(variance, 1e-300)
    if power <= parts + SIGNIFICANT * math.sqrt(2.0 * parts):
        return 0.0
    # Wiener filter: the means are reduced by the share of noise in their scatter.
    noise = variance / counts
    signal = max(float(np.mean(means**2) - np.mean(noise)), 0.0)
    largest = float(np.max(np.abs(means) * signal / (signal + noise)))
    return largest / max(window.largest_force, 1e-9)


def open_sets(
    model: Model,
    windows: Sequence[Window],
    parameters: Array,
    observable: np.ndarray,
    top: tuple[float, float],
    count: int = _SETS,
) -> list[Array]:
    """Sets (p,) that agree with the windows and differ in the shape parameters not ``observable``.

    The linear parameters follow from the coefficients of the windows. Where these do not give a
    set that describes the windows better than no force, the given set takes its place. ``top``:
    largest peak velocity [m/s] and current [A]. The list is empty if all shape parameters are
    observable.
    """
    known = np.array(model.parameter_names)[observable].tolist()
    rng, unknown = np.random.default_rng(0), set(model.shape_names).difference(known)
    solved = frozenset(model.linear) - unknown
    power = sum(np.mean(window.force**2) for window in windows)
    sets = []
    for _ in range(count if unknown else 0):
        values = np.array(parameters)
        for name, value in model.draw_shape(rng, *top).items():
            if name in unknown:
                values[model.parameter_names.index(name)] = value
        drawn = with_linear_refitted(model, windows, parameters, values, solved)
        with np.errstate(over="ignore", invalid="ignore"):
            left = sum(np.mean((model.window_force(w, drawn) - w.force) ** 2) for w in windows)
        sets.append(drawn if left <= power else parameters)
    return sets


def window_information(
    model: Model, windows: Iterable[Window], noise: Iterable[float], parameters: Array
) -> Array:
    """Fisher information (p, p) of the samples of windows, each with its own ``noise`` [N]."""
    total = np.zeros((parameters.size, parameters.size))
    for window, sigma in zip(windows, noise, strict=True):
        few = window.thinned(4 * PHASES)
        jacobian = Misfit(model, [few], [sigma]).jacobian(parameters)
        total += (window.sample_count / few.sample_count) * (jacobian.T @ jacobian)
    return total


_Piece = tuple[PeriodicMotion, float, float, int]
"""A motion, the duration [s] of its run, a current [A], and the part of the motion, 0 for a sine.
"""


def _window(piece: _Piece) -> Window:
    """A window of a piece of a run; its force is zero."""
    motion, duration, current, part = piece
    if motion.kind is MotionKind.SINE:
        return steady_cycle(motion.amplitude, motion.frequency, current)
    # As for a sine, the peak velocity needs ``PHASES`` samples per shortest cycle.
    stride = math.ceil(motion.highest_frequency * duration / _PARTS)
    size = stride * PHASES
    period = duration / (size * _PARTS)
    u, v, a = motion.at(np.arange(size * _PARTS, dtype=np.float64) * period)
    nothing = np.zeros(u.size)
    moved = Motion(u, v, a, np.abs(v), sine=None)
    whole = with_motion_before(Window(moved, nothing, nothing + current, period))
    return whole.part(slice(part * size, (part + 1) * size)).thinned(PHASES)


class CandidateRuns:
    """The information from each of many ``runs`` and their load on the machine.

    Both depend only on the motion and current of the pieces, so each piece is evaluated once.
    """

    def __init__(self, model: Model, runs: Sequence[PlannedRun], sample_rate: float) -> None:
        self.runs = list(runs)
        pieces: dict[_Piece, int] = {}
        rows, columns, seconds, settled = [], [], [], []
        for row, run in enumerate(self.runs):
            steady = run.kind is MotionKind.SINE
            each = 1 if steady else _PARTS // len(run.currents)
            for place in range(len(run.currents) * each):
                stretch, part = place // each, 0 if steady else place
                piece = run.motion, run.duration, run.currents[stretch], part
                rows.append(row)
                columns.append(pieces.setdefault(piece, len(pieces)))
                seconds.append(run.stretch / each)
                settled.append((run.stretch - SETTLING * (stretch > 0)) / each)
        self._time, self._samples = np.zeros((2, len(self.runs), len(pieces)))
        np.add.at(self._time, (rows, columns), seconds)
        np.add.at(self._samples, (rows, columns), sample_rate * np.array(settled))
        windows = [_window(piece) for piece in pieces]
        self._cycles = Cycles(model, windows)
        self._velocity = np.array([window.motion.velocity for window in windows])
        self._steady = np.array([run.kind is MotionKind.SINE for run in self.runs])

    def gains(self, parameters: Array, noise: float, broad_noise: float) -> Array:
        """Information (m, p, p) that each run would add.

        ``noise`` [N] is the noise in a sine, ``broad_noise`` [N] in any other motion.
        """
        jacobian = self._cycles.gradient(parameters)
        of_sample = np.einsum("knp,knq->kpq", jacobian, jacobian) / PHASES
        # A force that overflows far from the windows gives no information.
        of_sample[~np.isfinite(of_sample).all(axis=(1, 2))] = 0.0
        size = parameters.size
        gains = (self._samples @ of_sample.reshape(-1, size * size)).reshape(-1, size, size)
        sigma = np.where(self._steady, noise, broad_noise)
        return np.asarray(gains / sigma[:, None, None] ** 2)

    def demands(self, sets: Sequence[Array]) -> tuple[Array, Array]:
        """Largest force (m,) [N] and heat (m,) [J] of each run over all sets that may be true."""
        forces = np.stack([self._cycles.force(values) for values in sets])
        largest = np.max(np.abs(forces), axis=(0, 2))
        power = np.max(np.mean(forces * self._velocity, axis=2), axis=0)
        return np.max(np.where(self._time > 0.0, largest, 0.0), axis=1), self._time @ power


class PlanState(Enum):
    """The kind of decision: a run, the goal is met, or no run would help."""

    RUN = "run"
    MET = "met"
    OUT_OF_REACH = "out of reach"


@dataclass(frozen=True, eq=False)
class Plan:
    """The next run, if there is one, and the present accuracy of the force.

    ``now``: errors at the points of the goal; ``expected``: worst error [1] after the run;
    ``runs_left``: number of runs until the goal is met, None if it is unknown or the goal cannot be
    met; ``reason``: why the goal is met or cannot be met, in words. A run may help even if the goal
    cannot be met.
    """

    state: PlanState
    now: PointErrors
    run: PlannedRun | None = None
    expected: float = math.nan
    runs_left: int | None = 0
    reason: str = ""


class RunPlanner:
    """Plans runs towards a goal within the limits of a machine, for dampers of one model.

    ``candidates`` are the runs that the planner selects from.
    """

    def __init__(self, model: Model, goal: ForceGoal, limits: MachineLimits) -> None:
        self.model = model
        self.goal = goal
        self.limits = limits
        self._cycles = Cycles(model, goal.cycles())
        # Shape parameters are drawn relative to the current range, which must not be zero.
        self._top = goal.peak_velocity[1], max(goal.current[1], 1e-6)
        self.candidates = candidate_runs(goal, limits)
        self._candidates = CandidateRuns(model, self.candidates, limits.sample_rate)

    def _shortcoming(self) -> str:
        """Why the machine cannot cover the goal, in words; empty if it can."""
        goal, limits = self.goal, self.limits
        for asked, machine, largest, unit in (
            (goal.peak_velocity[1], "machine", limits.peak_velocity, "m/s"),
            (goal.current[1], "supply", limits.current, "A"),
        ):
            if asked > largest:
                return (
                    f"the goal includes {asked:g} {unit}, but the {machine} reaches only "
                    f"{largest:g} {unit}"
                )
        return "" if self.candidates else "no run within the limits of the machine holds a cycle"

    def prior(self, parameters: Array) -> Prior:
        """The prior for any damper before the first run, centred on ``parameters`` (p,).

        A shape parameter has the scatter of plausible values. The standard deviation of a scale
        parameter, or without scatter, is the larger of its own size and the change that alters the
        force by a tenth.
        """
        rng = np.random.default_rng(0)
        draws = [self.model.draw_shape(rng, *self._top) for _ in range(_DRAWS)]
        gradient = self._cycles.gradient(parameters).reshape(-1, parameters.size)
        widths = parameter_spans(self.model, gradient, parameters, {})
        for place, name in enumerate(self.model.parameter_names):
            if name in draws[0]:
                values = np.array([draw[name] for draw in draws])
                # The centre may lie outside the draws; its distance from them adds to the scatter.
                scatter = np.hypot(np.std(values), np.mean(values) - parameters[place])
                widths[place] = scatter or widths[place]
        return Prior(parameters, widths)

    def _noise(self, windows: Sequence[Window], parameters: Array) -> list[float]:
        """Standard deviation [N] of white noise with the effect of each window's residual."""
        misfits = (Misfit(self.model, [window], [1.0]) for window in windows)
        return [max(noise_level(misfit.residual(parameters)), 1e-9) for misfit in misfits]

    def _design(
        self, windows: Sequence[Window], noise: Sequence[float], parameters: Array
    ) -> tuple[Array, Array, Array]:
        """The relative gradient, the present information, and the gains of the candidates.

        ``noise`` (k,) [N] belongs to the windows. A motion other than a sine may have a larger
        model error, so the noise of its kind weights each candidate.
        """
        prior = np.diag(1.0 / self.prior(parameters).width ** 2)
        information = prior + window_information(self.model, windows, noise, parameters)
        steady = np.array([window.motion.sine is not None for window in windows])
        kinds = [np.array(noise)[each] for each in (steady, ~steady) if each.any()]
        sigma = float(np.median(kinds[0])), float(np.median(kinds[-1]))
        gradient = self._cycles.relative_gradient(parameters)[:, ::_FEW_PHASES]
        return gradient, information, self._candidates.gains(parameters, *sigma)

    def _model_errors(
        self, windows: Sequence[Window], parameters: Array, growth: float = _GROWTH
    ) -> Array:
        """Model errors (k,) at the points of the goal: a mean that weights near windows most.

        ``growth`` is the relative growth with the distance from the nearest window.
        """
        goal, squares = self.goal, [model_error(self.model, w, parameters) ** 2 for w in windows]
        (slow, fast), (low, high) = goal.peak_velocity, goal.current
        # A narrow range has no smaller scale than a change of a few times the speed, or of half the
        # current.
        sizes = max(math.log(fast / slow), 1.0), max(high - low, 0.5 * high, SAME_CURRENT)

        def places(points: Sequence[tuple[float, float]]) -> Array:
            return np.array([(math.log(max(v, 1e-12)), i) for v, i in points]) / sizes

        apart = places(goal.points)[:, None] - places([w.operating_point for w in windows])
        distances = np.linalg.norm(apart, axis=-1)
        # Windows of nearly the same motion are equally near.
        weights = 1.0 / (SAME_MOTION + distances) ** 4
        near = np.sqrt(weights @ squares / weights.sum(axis=1))
        return np.asarray(near * (1.0 + growth * distances.min(axis=1)))

    def _errors(self, parameters: Array, information: Array, model_errors: Array) -> PointErrors:
        """Errors at the points of the goal; ``information`` (p, p) includes the prior."""
        gradient = self._cycles.relative_gradient(parameters)
        flat = gradient.reshape(-1, parameters.size)
        draws = np.random.default_rng(0).standard_normal((_DRAWS, parameters.size))
        scale = 1.0 / np.sqrt(np.diagonal(information))
        # Rounding can make the matrix indefinite, so it has no Cholesky factor.
        values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
        root = vectors / np.sqrt(np.maximum(values, np.finfo(float).eps * values[-1]))
        missed = np.abs((draws @ root.T * scale) @ flat.T).reshape(_DRAWS, len(gradient), -1)
        worst = np.max(np.hypot(np.max(missed, axis=2), model_errors), axis=1)
        errors = np.hypot(cycle_errors(gradient, information[None])[0], model_errors)
        largest = float(np.max(model_errors))
        median, bound = np.quantile(worst, [0.5, 0.95]).tolist()
        return PointErrors(self.goal.points, errors, median, math.hypot(bound, largest), largest)

    def _posterior(
        self, windows: Sequence[Window], parameters: Array, prior: Prior
    ) -> Posterior[ChosenParameters]:
        """The posterior of all parameters; the noise of each window is that of this set."""
        # A misfit weights all windows equally.
        sizes = np.array([window.sample_count for window in windows])
        level = np.array(self._noise(windows, parameters)) * np.sqrt(sizes.mean() / sizes)
        misfit = Misfit(self.model, windows, level.tolist())
        everything = ChosenParameters(misfit, parameters, range(parameters.size))
        return Posterior(everything, prior, 1.0)

    def most_probable(self, windows: Sequence[Window], parameters: Array) -> Array:
        """The most probable set (p,) near the identified one, with all parameters free.

        Weakly determined parameters move as far as the data support. If they were held, the
        standard errors would be too small. The noise is estimated together with the set.
        """
        prior = self.prior(parameters)
        for _ in range(_ROUNDS):
            problem = self._posterior(windows, parameters, prior)
            search = LocalSearch(problem, problem.start)
            search.least_squares(most_steps=self.model.effort.most_steps)
            parameters = problem.parameters(search.best)
        return parameters

    def errors(self, windows: Sequence[Window], parameters: Array) -> PointErrors:
        """Accuracy of the force from windows to which ``parameters`` (p,) were fitted.

        The errors of the parameters include the discrepancy between motions, because without it a
        law that is extrapolated to faster motions counts as exact.
        """
        posterior = self._posterior(windows, parameters, self.prior(parameters))
        units = np.outer(posterior.widths, posterior.widths)
        covariance = posterior.covariances()[0] / units
        # A parameter whose information is lost in rounding keeps its prior.
        lost = np.isnan(np.diag(covariance))
        covariance[lost] = covariance[:, lost] = 0.0
        covariance[lost, lost] = 1.0
        information = information_of(covariance) / units
        return self._errors(parameters, information, self._model_errors(windows, parameters))

    def next(self, windows: Sequence[Window], parameters: Array, observable: np.ndarray) -> Plan:
        """The next decision; ``observable`` (p,) marks the parameters that windows determine."""
        now = self.errors(windows, parameters)
        if now.worst <= self.goal.error:
            return Plan(PlanState.MET, now, reason=f"the goal is met: {now.sentence}")
        return self.plan_on(windows, parameters, observable, now)

    def plan_on(
        self, windows: Sequence[Window], parameters: Array, observable: np.ndarray, now: PointErrors
    ) -> Plan:
        """The plan of :meth:`next` as if the goal were not met; ``now``: the present accuracy."""
        reason = self._shortcoming()
        if not reason:
            others = open_sets(self.model, windows, parameters, observable, self._top)
            sets = [parameters, *others]
            allowed = self._allowed(windows, sets)
            if not allowed.any():
                reason = "every run that would help may leave the limits of force or heat"
        if reason:
            return Plan(PlanState.OUT_OF_REACH, now, runs_left=None, reason=reason)
        noise = self._noise(windows, parameters)
        scores = np.where(allowed, 0.0, math.inf)
        for values in sets:
            gradient, before, gains = self._design(windows, noise, values)
            scores[allowed] += np.log(_soft_worst(gradient, before + gains[allowed]))
        best = int(np.argmin(scores))
        # Further runs leave no point far from a window.
        model_errors = self._model_errors(windows, parameters, growth=0.0)
        left, expected, reached = self._look_ahead(windows, parameters, noise, model_errors, best)
        if model_errors.max() > self.goal.error:
            reason = (
                f"the model error of the law {self.model.name} is {model_errors.max():.2%} of the "
                f"force, more than the goal of {self.goal.error:.2%}, and no run can reduce it: "
                "choose another model (choose_law, or identify --model auto, compares them on the "
                "recorded runs) or a larger error; if the damper warms up, let it cool between runs"
            )
        state = PlanState.RUN
        # While shape parameters are undetermined, the number of runs cannot be predicted.
        if left is None and len(sets) == 1:
            state = PlanState.OUT_OF_REACH
            reason = reason or (
                f"{_LOOK_AHEAD} more runs would leave an error of {reached:.2%}: allow longer runs "
                "or a larger error"
            )
        return Plan(state, now, self.candidates[best], expected, left, reason)

    def _allowed(self, windows: Sequence[Window], sets: Sequence[Array]) -> np.ndarray:
        """Mask (m,) of runs within the limits for all sets, without a leap in speed or current."""
        fastest = max(window.motion.peak_velocity.max() for window in windows)
        highest = max(window.current.max() for window in windows)
        low, high = self.goal.current
        top = highest + _CURRENT_STEP * (high - low) + 1e-9
        gentle = [
            run.peak_velocity <= _SPEED_STEP * fastest and max(run.currents) <= top
            for run in self.candidates
        ]
        force, heat = self._candidates.demands(sets)
        # The force may be larger than predicted, noticeably.
        force, heat = (1.0 + NOTICED) * force, (1.0 + NOTICED) * heat
        within = (force <= self.limits.force) & (heat <= self.limits.heat)
        return np.asarray(gentle & within)

    def _look_ahead(
        self,
        windows: Sequence[Window],
        parameters: Array,
        noise: Sequence[float],
        model_errors: Array,
        first: int,
    ) -> tuple[int | None, float, float]:
        """Number of runs until the goal is met, and worst error after the first and last run."""
        gradient, information, gains = self._design(windows, noise, parameters)
        information += gains[first]
        expected = worst = self._errors(parameters, information, model_errors).worst
        for count in range(1, _LOOK_AHEAD + 1):
            if worst <= self.goal.error:
                return count, expected, worst
            after = information + gains
            information = after[int(np.argmin(_soft_worst(gradient, after)))]
            worst = self._errors(parameters, information, model_errors).worst
        return None, expected, worst


def _soft_worst(gradient: Array, information: Array) -> Array:
    """Smooth maximum (m,) over the cycles of :func:`cycle_errors`, as a norm."""
    return np.asarray(
        np.mean(cycle_errors(gradient, information) ** _NORM, axis=1) ** (1.0 / _NORM)
    )


# -- runs that would determine unobservable parameters --------------------------------------------


@dataclass(frozen=True)
class ExtraRun:
    """A recommended run: ``amplitude`` [m], ``frequency`` [Hz], ``current`` [A].

    ``determines``: the parameters that it would determine in addition to the runs before it.
    ``worst_error``: the largest standard error after the run in spans (see :mod:`observability`); 1
    if only the plausible range is known.
    """

    amplitude: float
    frequency: float
    current: float
    determines: tuple[str, ...] = ()
    worst_error: float = 1.0

    @property
    def sentence(self) -> str:
        """The recommendation in words."""
        gain = f"it would determine {', '.join(self.determines)}"
        if not self.determines:
            gain = "it would determine parameters only together with the next run"
        return (
            f"run {1e3 * self.amplitude:.3g} mm at {self.frequency:.3g} Hz "
            f"with {self.current:.3g} A: {gain}"
        )


def extra_runs(
    misfit: Misfit, noise: float, parameters: Array, observable: np.ndarray, rig: MachineLimits
) -> tuple[ExtraRun, ...]:
    """Recommended runs in order; empty if all parameters are determined or no run would help.

    ``misfit`` is the misfit of the present windows. ``noise`` [N] is the expected residual of a new
    run of the same length. ``parameters`` (p,) is the present set, ``observable`` (p,) marks its
    determined parameters. A run determines a shape parameter if it reduces the standard error below
    a quarter of the span for most of the sets that may be true.
    """
    model = misfit.model
    names = np.array(model.parameter_names)
    missing = np.isin(names, [name for law in model.shape_groups for name in law]) & ~observable
    if not missing.any():
        return ()
    speeds, currents = operating_points_within(misfit.windows)
    top = max(*speeds, rig.peak_velocity), max(rig.current, *currents)
    ranges = model.plausible_ranges(misfit.windows, *top)
    spans = parameter_spans(model, misfit.jacobian(parameters), parameters, ranges)
    amplitude = round_to(rig.amplitude, 2)
    fastest = rig.peak_velocity / (2.0 * math.pi * amplitude)
    candidates = CandidateRuns(
        model,
        [
            PlannedRun(amplitude, round_to(fastest * speed, 2), (current,), duration=1.0)
            for speed in np.geomspace(0.1, 1.0, 6).tolist()
            for current in dict.fromkeys(round_to(x, 2) for x in np.linspace(0.0, rig.current, 9))
        ],
        sample_rate=misfit.sample_count / len(misfit.windows),
    )
    level = noise_level(misfit.residual(parameters))
    top = top[0], max(top[1], 1e-6)
    sets = open_sets(model, misfit.windows, parameters, observable, top, 2 * _SETS)
    # The information of the present runs, as a root, which rounding does not make singular.
    present = [triangular_factor(misfit.jacobian(values) * spans / level) for values in sets]
    gains = np.array([candidates.gains(v, noise * level, noise * level) for v in sets])
    gains *= np.outer(spans, spans)
    advised: list[ExtraRun] = []
    useful = 0
    # A current dependence needs at most one run for each current.
    for _ in range(max(parameter.currents for parameter in model.parameters)):
        if not missing.any():
            break
        roots = np.array([prior_root(each) for each in present])[:, np.newaxis]
        growth = np.eye(spans.size) + np.swapaxes(roots, -1, -2) @ gains @ roots
        best = int(np.argmax(np.mean(np.linalg.slogdet(growth)[1], axis=0)))
        run = candidates.runs[best]
        values, axes = np.linalg.eigh(gains[:, best])
        added = np.sqrt(values.clip(0.0))[:, :, np.newaxis] * np.swapaxes(axes, -1, -2)
        pairs = zip(present, added, strict=True)
        present = [triangular_factor(np.vstack(pair)) for pair in pairs]
        errors = np.array([np.linalg.norm(prior_root(each), axis=1) for each in present])
        determined = missing & (np.median(errors, axis=0) < SURE)
        told, worst = tuple(names[determined].tolist()), float(np.mean(errors.max(axis=-1)))
        advised.append(ExtraRun(run.amplitude, run.frequency, run.currents[0], told, worst))
        missing &= ~determined
        # Runs at the end that determine no further parameter are not advised.
        useful = len(advised) if told else useful
    return tuple(advised[:useful])
