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
from mr_damper_ros.emulation.faults import Delivery, Fault, Instruments
from mr_damper_ros.emulation.motions import Excitation
from mr_damper_ros.estimation.global_fit import error_of_set
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.parameter_set import ParameterSet, start_set
from mr_damper_ros.rig.blocks import Meter
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, BlockError, RigBlock, SampleBlock, check_live
from mr_damper_ros.tracking.engine import Engine, EngineSettings
from mr_damper_ros.tracking.predictor import Prediction, PredictorSettings
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.tracker import TrackerSettings
from mr_damper_ros.tracking.validity import DoubtKind
from mr_damper_ros.tracking.window_assembler import WindowSettings

CURRENT_STEP = 0.005
"""Change of the current [A] that is published at once, as in the bridge."""

WRONG = 0.2
"""Error above which a force is wrong, as a fraction of the peak force."""

PEAK_MEMORY = 10.0
"""Time [s] over which the peak force is taken."""

WORSE = 0.05
"""Increase of the NRMSE against the true force above which a set is worse than another."""

_REST_SPEED, _REST_TIME = 0.01, 0.5
"""The machine is at rest if it stays below this fraction of the top speed for this time [s]."""


@dataclass(frozen=True)
class TrialSettings:
    """Settings of a trial; all but the first line have the defaults of the nodes.

    ``sample_rate`` [Hz], ``block_size``, noises of displacement [m] and force [N] and their seed;
    ``current_rate``: readings of the supply per second. ``delay`` and ``search_delay`` [s]: time
    from the last sample of a window, or from when a search fell due, until its outcome counts.
    ``initial``: the set to start from; None for the one from the literature.
    """

    seed: int = 0
    sample_rate: float = 1000.0
    block_size: int = 10
    force_noise: float = THESIS_FORCE_NOISE
    displacement_noise: float = 1e-6
    current_rate: float = 10.0
    delay: float = 0.3
    search_delay: float = 1.0
    windows: WindowSettings = field(default_factory=WindowSettings)
    tracker: TrackerSettings = field(default_factory=TrackerSettings)
    predictor: PredictorSettings = field(default_factory=PredictorSettings)
    initial: ParameterSet | None = None


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

    ``reports`` are in the order in which they took effect, at ``report_times`` [s].
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
    report_times: list[float]

    @property
    def valid(self) -> np.ndarray:
        """Whether the predicted force of each sample is valid, shape (n,)."""
        return np.asarray(self.doubts == DoubtKind.NONE)

    @property
    def period(self) -> float:
        """Time between two samples [s]."""
        return float(self.time[1] - self.time[0])

    @property
    def peak(self) -> Array:
        """Largest true force [N] of the last :data:`PEAK_MEMORY` seconds, shape (n,)."""
        # The maximum of each tenth of a second is accurate enough and quick to compute.
        part = max(round(0.1 / self.period), 1)
        size = np.abs(self.true)
        largest = np.maximum.reduceat(size, np.arange(0, size.size, part))
        count = max(round(PEAK_MEMORY / (part * self.period)), 1)
        padded = np.concatenate([np.zeros(count - 1), largest])
        recent = np.lib.stride_tricks.sliding_window_view(padded, count).max(axis=1)
        return np.asarray(np.repeat(recent, part)[: size.size])

    @property
    def error(self) -> Array:
        """|predicted - true| over the peak force, shape (n,); NaN without a prediction."""
        return np.asarray(np.abs(self.predicted - self.true) / np.maximum(self.peak, 1e-9))

    def wrong_valid(
        self, limit: float = WRONG, since: float = 0.0, until: float = math.inf
    ) -> Stretch:
        """Time in which the force was valid although its error exceeded ``limit`` times the peak.

        The error may pass through zero for a moment. Two periods of wrong force therefore count as
        one if less than 0.1 s of correct and valid force separates them.
        """
        error = np.where(self.valid, self.error, 0.0)
        wrong = error > limit
        wrong &= (self.time >= since) & (self.time < until)
        if not wrong.any():
            return Stretch(0.0, 0.0, 0.0, math.nan)
        joined = _without_gaps(wrong, self.valid, round(0.1 / self.period))
        edges = np.flatnonzero(np.diff(np.concatenate(([0], joined.view(np.int8), [0]))))
        worst = int(np.argmax(np.where(wrong, error, 0.0)))
        return Stretch(
            float(np.max(edges[1::2] - edges[::2])) * self.period,
            float(np.count_nonzero(wrong)) * self.period,
            float(error[worst]),
            float(self.time[worst]),
        )

    def first_valid(self, since: float = 0.0) -> float:
        """Time [s] of the first valid sample from ``since`` on; infinite if there is none."""
        places = np.flatnonzero(self.valid & (self.time >= since))
        return float(self.time[places[0]]) if places.size else math.inf


def at_rest(result: TrialResult) -> np.ndarray:
    """Mask (n,) of the samples in a rest of the machine of half a second or longer."""
    speed = np.abs(np.gradient(result.displacement, result.period))
    slow = speed < _REST_SPEED * speed.max()
    edges = np.flatnonzero(np.diff(np.concatenate(([0], slow.view(np.int8), [0]))))
    rest = np.zeros(slow.size, dtype=bool)
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        if (end - begin) * result.period >= _REST_TIME:
            rest[begin:end] = True
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
        truths = [
            truth
            for begin, end in spans
            if (truth := _truth(result, after.time + begin, after.time + end)) is not None
        ]
        pairs = [
            (_nrmse(before.parameters, truth), _nrmse(after.parameters, truth)) for truth in truths
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


def _without_gaps(wrong: np.ndarray, valid: np.ndarray, longest: int) -> np.ndarray:
    """The mask, with gaps of up to ``longest`` samples closed if all samples in them are valid."""
    closed = wrong.copy()
    places = np.flatnonzero(wrong)
    for one, other in itertools.pairwise(places):
        if 1 < other - one <= longest and valid[one:other].all():
            closed[one:other] = True
    return closed


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
        self._supply = Meter(1.0 / given.current_rate, step=CURRENT_STEP)
        initial = given.initial or start_set(given.tracker.law)
        self._engine = Engine(
            EngineSettings(
                windows=given.windows,
                tracking=given.tracker,
                predictor=given.predictor,
                fit_delay=given.delay,
                search_delay=given.search_delay,
            ),
            initial,
        )
        self._now = 0.0
        self._parts: list[Array] = []
        self._sets = [SetInUse(0.0, initial)]
        self._reports: list[Report] = []
        self._report_times: list[float] = []

    @property
    def now(self) -> float:
        """Duration of the stream so far [s]."""
        return self._now

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
        for _ in range(round(duration * self._settings.sample_rate / size)):
            self._go_on(self._rig.next_block(size))

    def result(self) -> TrialResult:
        """Result since the start."""
        rows = np.concatenate(self._parts, axis=1)
        time, displacement, current, true, measured, predicted, doubts = rows
        return TrialResult(
            time=time,
            displacement=displacement,
            current=current,
            true=true,
            measured=measured,
            predicted=predicted,
            doubts=doubts.astype(int),
            sets=list(self._sets),
            reports=list(self._reports),
            report_times=list(self._report_times),
        )

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
        self._now = (first + size) * made.period
        for delivery in self._instruments.read(block):
            self._send(delivery)

    def _send(self, delivery: Delivery) -> None:
        block = delivery.block
        ahead = block.supply_ahead_ns
        for reading in self._supply.read(block, block.current, ahead):
            self._engine.add_current(reading.stamp_ns, reading.value)
        try:
            samples = SampleBlock(
                block.start_ns, block.sequence, block.period, block.displacement, block.force
            )
            check_live(samples)
        except BlockError:
            return
        now_ns = self._rig.settings.start_ns + round(self._now * NANOSECONDS)
        prediction = self._engine.predict(samples, now_ns)
        for publication in self._engine.take_publications():
            self._reports.append(publication.report)
            self._report_times.append(self._now)
            if publication.parameters is not None:
                self._sets.append(SetInUse(self._now, publication.parameters))
        self._note(delivery, prediction)

    def _note(self, delivery: Delivery, prediction: Prediction) -> None:
        size = self._settings.block_size
        rows = self._parts[delivery.first // size]
        if np.isfinite(rows[4]).any():
            return  # it came twice: the first one counted
        rows[4] = delivery.block.force
        rows[5] = prediction.force
        rows[6] = prediction.doubts
