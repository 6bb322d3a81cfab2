"""A rig, its instruments, the identification and the prediction in one process, on stamp time.

    trial = StreamTrial(DAMPERS["viscous_tanh"], SineMotion(0.005, 1.0), 1.5)
    trial.advance(10.0)
    broken = trial.branch(faults_of(["force_gain:10@12"]))
    broken.advance(10.0)
    broken.result().wrong_valid(since=12.0).longest

A trial does not use the wall clock, so its result depends only on its arguments. It does the work
of the bridge, block by block, and drives the engine. A set or a report affects the prediction after
a given delay from the last sample of its window.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from mr_damper_ros.emulation.emulator import (
    THESIS_FORCE_NOISE,
    CurrentSchedule,
    Damper,
    EmulatedDamper,
    EmulatedRig,
    RigSettings,
    ThermalModel,
)
from mr_damper_ros.emulation.faults import Fault, Instruments
from mr_damper_ros.emulation.motions import Excitation
from mr_damper_ros.estimation.global_fit import error_of_set
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.parameter_set import ParameterSet, start_set
from mr_damper_ros.rig.blocks import Meter
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, BlockError, RigBlock, check_live
from mr_damper_ros.tracking.engine import Engine, EngineSettings
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.validity import DoubtKind

WRONG = 0.2
"""Error above which a force is wrong, as a fraction of the peak force of the last 10 s."""

WORSE = 0.05
"""Increase of the NRMSE against the true force above which a set is worse than another."""


@dataclass(frozen=True)
class TrialSettings:
    """Settings of a trial; the ``engine`` has the defaults of the nodes.

    ``sample_rate`` is in Hz. ``force_noise`` [N] and ``displacement_noise`` [m] are standard
    deviations. The supply is read every ``supply_period`` [s], and at once after a change of
    ``supply_step`` [A]; by default as in the bridge.
    """

    seed: int = 0
    block_size: int = 10
    force_noise: float = THESIS_FORCE_NOISE
    displacement_noise: float = 1e-6
    sample_rate: float = 1000.0
    supply_period: float = 0.1
    supply_step: float = 0.005
    engine: EngineSettings = field(default_factory=EngineSettings)


class Stretch(NamedTuple):
    """Time [s] in which a condition holds: the ``longest`` unbroken period, and the ``total``.

    ``worst`` is the largest error in this time over the peak force, and ``at`` [s] its time (NaN
    without an error).
    """

    longest: float
    total: float
    worst: float
    at: float


class SetInUse(NamedTuple):
    """A set, and the time [s] from which the prediction uses it."""

    time: float
    parameters: ParameterSet


@dataclass(frozen=True, eq=False)
class TrialResult:
    """Result of a trial at each sample of the rig; arrays of shape (n,).

    - ``time`` [s].
    - ``current`` [A]: the actual output of the supply.
    - ``true`` [N]: force between rod and load cell, without noise or instrument faults.
    - ``measured`` [N]: reading of the instruments, NaN for samples that were not sent.
    - ``predicted`` [N]: NaN without a prediction.
    - ``doubts``: reason code of each prediction, -1 without a prediction.

    ``sets`` and ``reports`` are in the order in which they took effect.
    """

    time: Array
    displacement: Array
    current: Array
    true: Array
    measured: Array
    predicted: Array
    doubts: np.ndarray
    sets: list[SetInUse]
    reports: list[Report]

    @property
    def valid(self) -> np.ndarray:
        """Whether the predicted force of each sample is valid, shape (n,)."""
        return np.asarray(self.doubts == DoubtKind.NONE)

    @property
    def period(self) -> float:
        """Time between two samples [s]."""
        return float(self.time[1] - self.time[0])

    @property
    def error(self) -> Array:
        """|predicted - true| over the largest force of the last 10 s, (n,); NaN if not predicted.

        The maximum of each tenth of a second is accurate enough and quick to compute.
        """
        part = max(round(0.1 / self.period), 1)
        largest = np.maximum.reduceat(np.abs(self.true), np.arange(0, self.true.size, part))
        padded = np.concatenate([np.zeros(99), largest])
        recent = np.lib.stride_tricks.sliding_window_view(padded, 100).max(axis=1)
        peak = np.repeat(recent, part)[: self.true.size]
        return np.asarray(np.abs(self.predicted - self.true) / np.maximum(peak, 1e-9))

    @property
    def right(self) -> np.ndarray:
        """Whether the predicted force of each sample is right, valid or not, shape (n,)."""
        return np.asarray(self.error <= WRONG)

    def wrong_valid(self, since: float = 0.0) -> Stretch:
        """Time from ``since`` [s] on in which the force was valid although it was wrong.

        The error may pass through zero for a moment. Two periods of wrong force therefore count as
        one if less than 0.1 s of correct and valid force separates them.
        """
        valid = self.valid
        error = np.where(valid, self.error, 0.0)
        wrong = (error > WRONG) & (self.time >= since)
        places = np.flatnonzero(wrong)
        if not places.size:
            return Stretch(0.0, 0.0, 0.0, math.nan)
        joined = wrong.copy()
        for one, other in itertools.pairwise(places):
            if 1 < other - one <= round(0.1 / self.period) and valid[one:other].all():
                joined[one:other] = True
        begins, ends = _stretches(joined)
        worst = int(np.argmax(np.where(wrong, error, 0.0)))
        return Stretch(
            float(np.max(ends - begins)) * self.period,
            float(places.size) * self.period,
            float(error[worst]),
            float(self.time[worst]),
        )


def _stretches(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Begins and ends of the stretches in which the mask (n,) is true."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.view(np.int8), [0]))))
    return edges[::2], edges[1::2]


def worst_stretch(mask: np.ndarray, period: float) -> tuple[float, float]:
    """Longest stretch and total time [s] in which a mask (n,) is true."""
    begins, ends = _stretches(mask)
    return float(np.max(ends - begins, initial=0)) * period, float(mask.sum()) * period


def at_rest(result: TrialResult) -> np.ndarray:
    """Mask (n,) of the samples in a rest of the machine of half a second or longer.

    At rest the speed stays below one percent of the top speed.
    """
    speed = np.abs(np.gradient(result.displacement, result.period))
    slow = speed < 0.01 * speed.max()
    rest = np.zeros(slow.size, dtype=bool)
    for begin, end in zip(*_stretches(slow), strict=True):
        rest[begin:end] = (end - begin) * result.period >= 0.5
    return rest


class WorseSet(NamedTuple):
    """A worse set accepted at ``time`` [s], and the NRMSE ``before`` and ``after`` the change."""

    set_id: str
    time: float
    before: float
    after: float


def worse_sets(
    result: TrialResult, spans: Sequence[tuple[float, float]], good: float
) -> list[WorseSet]:
    """Sets with a larger NRMSE against the true force than a good predecessor.

    The NRMSE must be larger over each of the ``spans`` [s], relative to the time when the set took
    effect. Spans without motion are skipped. ``good`` is the largest NRMSE of a good set.
    """
    found = []
    for before, after in itertools.pairwise(result.sets):
        windows = [_truth(result, after.time + begin, after.time + end) for begin, end in spans]
        pairs = [
            [_nrmse(each.parameters, window) for each in (before, after)]
            for window in windows
            if window is not None
        ]
        if pairs and all(old <= good and new > old + WORSE for old, new in pairs):
            found.append(WorseSet(after.parameters.set_id, after.time, *pairs[0]))
    return found


def _truth(result: TrialResult, begin: float, end: float) -> Window | None:
    """True motion and force between two times [s]; None if there was almost no motion."""
    part = slice(max(round(begin / result.period), 0), round(end / result.period))
    if result.time[part].size * result.period < 0.5 * (end - begin):
        return None  # the trial ends
    try:
        return Window.from_samples(
            result.displacement[part], result.true[part], result.current[part], result.period
        )
    except ValueError:
        return None


def _nrmse(parameters: ParameterSet, window: Window) -> float:
    error = error_of_set(parameters, [window]).nrmse
    return error if math.isfinite(error) else math.inf


class StreamTrial:
    """A trial that can be continued and branched, so that several trials share the same past."""

    def __init__(
        self,
        damper: ParameterSet | Damper,
        excitation: Excitation,
        current: CurrentSchedule | float,
        *,
        faults: Sequence[Fault] = (),
        settings: TrialSettings | None = None,
        thermal: ThermalModel | None = None,
        hot_force: float = 1.0,
    ) -> None:
        """``thermal`` describes the heating of the damper.

        A damper given by a set has the fraction ``hot_force`` of its force at 71 °C.
        """
        self._settings = given = settings or TrialSettings()
        if isinstance(damper, ParameterSet):
            damper = EmulatedDamper(damper, hot_force)
        # The noise is added here, so that the rig provides the true values.
        self._rig = EmulatedRig(
            damper,
            excitation,
            current,
            settings=RigSettings(given.sample_rate, force_noise=0.0, seed=given.seed),
            thermal=thermal,
            faults=faults,
        )
        # With one generator per channel, the noise is independent of the block size.
        self._noise = [np.random.default_rng((given.seed, channel)) for channel in range(2)]
        self._instruments = Instruments(faults)
        self._supply = Meter(given.supply_period, step=given.supply_step)
        self._engine = Engine(given.engine)
        self.now = 0.0
        """Duration of the stream so far [s]."""
        self._parts: list[Array] = []
        self._sets = [SetInUse(0.0, start_set(given.engine.tracking.law))]
        self._reports: list[Report] = []

    def branch(
        self, faults: Sequence[Fault] = (), current: CurrentSchedule | None = None
    ) -> StreamTrial:
        """A trial with the same past and these later faults; this trial is unchanged.

        ``current`` is a different schedule of the supply that is the same up to now.
        """
        other = deepcopy(self)
        other._rig.add_faults(faults)
        if current is not None:
            other._rig.supply(current)
        other._instruments = Instruments(faults)
        return other

    def run(self, duration: float) -> TrialResult:
        """Continue for ``duration`` [s] and return the result since the start."""
        self.advance(duration)
        return self.result()

    def advance(self, duration: float) -> None:
        """Continue for ``duration`` [s]."""
        size = self._settings.block_size
        for _ in range(round(duration * self._rig.settings.sample_rate / size)):
            self._go_on(self._rig.next_block(size))

    def result(self) -> TrialResult:
        """Result since the start."""
        *rows, doubts = np.concatenate(self._parts, axis=1)
        codes = doubts.astype(int)
        return TrialResult(*rows, codes, list(self._sets), list(self._reports))  # type: ignore

    # --- what the bridge does ------------------------------------------------------------------

    def _go_on(self, made: RigBlock) -> None:
        size, first = made.sample_count, made.sequence
        rows = np.full((7, size), math.nan)
        rows[0] = (first + np.arange(size)) * made.period
        rows[1:4] = made.displacement, made.current, made.force
        rows[6] = -1.0
        self._parts.append(rows)
        noise = [rng.standard_normal(size) for rng in self._noise]
        block = replace(
            made,
            displacement=made.displacement + self._settings.displacement_noise * noise[0],
            force=made.force + self._settings.force_noise * noise[1],
        )
        self.now = (first + size) * made.period
        for sent, number in self._instruments.read(block):
            self._send(sent, number)

    def _send(self, block: RigBlock, first: int) -> None:
        for reading in self._supply.read(block, block.current, block.supply_ahead_ns):
            self._engine.add_current(*reading)
        try:
            samples = block.samples
            check_live(samples)
        except BlockError:
            return
        now_ns = self._rig.settings.start_ns + round(self.now * NANOSECONDS)
        prediction = self._engine.predict(samples, now_ns)
        for publication in self._engine.take_publications():
            self._reports.append(publication.report)
            if publication.parameters is not None:
                self._sets.append(SetInUse(self.now, publication.parameters))
        rows = self._parts[first // self._settings.block_size]
        # Of a block that comes twice, the first one counts.
        if not np.isfinite(rows[4]).any():
            rows[4:] = block.force, prediction.force, prediction.doubts
