"""Causal prediction of the damper force from a stream of displacement and current.

The steps from a block to its predicted force are:

1. The block is placed on the uniform grid, and its motion is estimated.
2. The current is held at its last value to give a current at each sample.
3. The model bank selects the set, and the set gives the force, with bumpless transfer.
4. The residual monitor compares this force with the measured force.
5. The validity rules give each sample its reason code.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from mr_damper_ros.estimation.current_lag import LARGEST_LAG
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.motion_follower import MotionFollower
from mr_damper_ros.models.domain import Origin
from mr_damper_ros.models.parameter_set import ParameterSet, check_set
from mr_damper_ros.models.quantities import State
from mr_damper_ros.settings.option_table import option
from mr_damper_ros.signals.arrays import Array, Mask
from mr_damper_ros.signals.blocks import KEEP_CURRENT, NANOSECONDS, SampleBlock, ZeroOrderHold
from mr_damper_ros.signals.uniform_grid import GridSettings, Placed, UniformGrid
from mr_damper_ros.tracking.bumpless_transfer import ForceInUse
from mr_damper_ros.tracking.candidate_sets import CandidateSets
from mr_damper_ros.tracking.model_bank import ModelBank
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.residual_monitor import LoadCellZero, ResidualMonitor
from mr_damper_ros.tracking.validity import (
    NO_DOUBT,
    Codes,
    Doubt,
    DoubtKind,
    Freshness,
    Objection,
    RefusedWindows,
    ValiditySettings,
    judge_samples,
    lack_of_input,
    middle,
    objections_to_age,
    objections_to_current,
    objections_to_motion,
)


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted force [N], shape (n,), of the block's samples.

    ``doubts`` (n,) holds the reason code (:class:`DoubtKind`) of each sample; ``doubt`` is the
    reason of the newest invalid sample. ``set_doubt`` says why the set is wrong in part of the
    cycle, which concerns a controller also at a right sample. ``velocity`` [m/s], shape (n,), is
    the estimated velocity, NaN if unknown. ``motion`` and ``current`` (m,) [A] are the inputs of
    the newest samples; None without a force.
    """

    start_ns: int
    sequence: int
    period: float
    force: Array
    velocity: Array
    set_id: str
    doubts: Codes
    doubt: Doubt
    continuity: str = ""
    motion: Motion | None = None
    current: Array | None = None
    set_doubt: Doubt = NO_DOUBT

    @property
    def valid(self) -> bool:
        """Whether the force of all samples is valid."""
        return not self.doubt

    @property
    def valid_samples(self) -> Mask:
        """Whether the force of each sample is valid, shape (n,)."""
        return self.doubts == 0

    @property
    def newest_doubt(self) -> Doubt:
        """Why the force of the newest sample is invalid."""
        return self.doubt if self.doubts[-1] else NO_DOUBT

    @property
    def reason(self) -> str:
        """The reason in words; empty if all samples are valid."""
        return self.doubt.sentence

    def at_its_samples(self, values: Array) -> Array:
        """The last n of the values (m,) of a block: the values at the predicted samples."""
        return values[-self.force.size :]


class _Part(NamedTuple):
    """Predicted force [N] and velocity [m/s] of a part of a block, and the objections to it."""

    force: Array
    velocity: Array
    objections: list[Objection]
    motion: Motion | None = None
    current: Array | None = None

    @classmethod
    def unknown(cls, velocity: Array, kind: DoubtKind, sentence: str) -> _Part:
        """A part without a force, with the reason."""
        return cls(np.full(velocity.size, np.nan), velocity, [Objection(kind, sentence)])


@dataclass(frozen=True)
class PredictorSettings(ValiditySettings):
    """Settings of the prediction and limits of its validity."""

    bandwidth: float = option(
        0.0,
        "Bandwidth [Hz] of the observer that estimates velocity and acceleration from the "
        "displacement. A larger bandwidth follows faster motion; a smaller one passes less "
        "displacement noise. 0: it adapts to motion and noise. Other values are limited to "
        "between 0.02 % and a quarter of the sample rate.",
        within=(0.0, 10_000.0),
    )
    gradual_reversal: bool = option(
        True,
        "Whether the hysteresis branch of the sigmoid follows the velocity near reversals, as "
        "recorded forces do; false: it jumps with the sign of the acceleration, as in the "
        "thesis.",
    )
    centre_memory: float = option(
        10.0,
        "Time [s] over which the centre of the motion is estimated, to which the displacement "
        "is referred. It must cover a whole cycle.",
        within=(0.01, 3600.0),
    )


_PART_TIME = 0.01
"""Longest time [s] that is predicted at once. A longer block is split into parts of this length,
and each part uses what was learnt from the previous part. A long block is therefore predicted as
well as several short ones."""

_UNKNOWN_MOTION = (DoubtKind.FROZEN, DoubtKind.SETTLING, DoubtKind.AT_REST)
"""Reasons for which the motion does not determine the force."""

_COMPARABLE = (
    *(DoubtKind.NONE, DoubtKind.OUT_OF_RANGE, DoubtKind.TOO_LARGE, DoubtKind.DRIVING),
    *(DoubtKind.WRONG, DoubtKind.REFUSED),
)
"""Reasons that concern the set, so that the measured force is evidence about other sets."""

_AT_REST = "the damper is at rest: its force depends on how it came to rest"


class ForcePredictor:
    """Predicts the force of each block as it arrives."""

    def __init__(
        self,
        settings: PredictorSettings | None = None,
        grid: GridSettings | None = None,
        candidates: CandidateSets | None = None,
    ) -> None:
        settings = settings or PredictorSettings()
        self._settings = settings
        self.candidates = candidates
        """The sets that are predicted in the background, for a controller; None without one."""
        margin, measured = settings.velocity_margin, settings.maximum_error > 0.0
        self._bank = ModelBank(margin, gradual=settings.gradual_reversal, measured=measured)
        self._current = ZeroOrderHold(keep=KEEP_CURRENT)
        # Lag [ns] of the force behind the current, from the identifier.
        self._lag_ns = 0
        self.sequence = UniformGrid(grid)
        """The uniform grid, which tracks gaps and repeats of the blocks."""
        self.freshness = Freshness(settings.max_age)
        """The age of the samples."""
        # Time [ns] by which the stamps leapt ahead, while it may also be a pause.
        self._leap_ns = 0
        self._refused = RefusedWindows()
        # These three restart with the first block and after a gap in the motion.
        self._motion: MotionFollower | None = None
        self._force = ForceInUse(math.inf)
        self._monitor = ResidualMonitor(math.inf, settings.error_limit)
        self._zero = LoadCellZero()
        # Number of reversals of the motion when the state of the law was initialised.
        self._begun_at = 0
        # The work on the newest samples that is left for later.
        self._unlearned: Callable[[], None] | None = None
        self._uncompared: Callable[[], None] | None = None
        self._newest_kind = DoubtKind.NONE
        self.tried = -math.inf
        """Highest current [A] under trial. Up to it, only the measured force decides validity."""

    @property
    def parameters(self) -> ParameterSet | None:
        """The set in use; None before the first."""
        present = self._bank.present
        return None if present is None else present.parameters

    @property
    def zero(self) -> float:
        """Zero of the load cell [N] that is added to the force of a set from another run."""
        return self._zero.present

    @property
    def gradual(self) -> bool:
        """Whether the predicted force has no jumps at reversals."""
        return self._bank.gradual

    @property
    def memory(self) -> State | None:
        """State of the law after the last block; it ends with the current of a lagging coil."""
        return self._force.state

    # Inputs other than samples

    def set_parameters(self, parameters: ParameterSet, confirmed_ns: int | None = None) -> None:
        """Predict with this set from the next block on.

        ``confirmed_ns`` is the stamp of the last sample of this stream that the set is known to
        fit; None for a set loaded by a user, which does not age. Raises ParameterError for anything
        but a set.
        """
        check_set(parameters)
        if confirmed_ns is None:
            self.follow_set(parameters.as_given())
        else:
            identified = parameters.origin.is_identified
            origin = parameters.origin if identified else Origin.WINDOW
            self.follow_set(replace(parameters, stamp_ns=confirmed_ns, origin=origin))

    def follow_set(self, parameters: ParameterSet) -> None:
        """Process a set published by the identifier.

        It is used from the next block on, unless the bank has a better one, and an identified set
        takes effect by bumpless transfer. :meth:`ModelBank.add` describes which sets replace a
        loaded set. The state of the law is recomputed.
        """
        self._refused.forget()
        if self._bank.is_in_use(parameters):
            return
        before = self._bank.present
        half_cycle = math.nan if self._motion is None else self._motion.centre.usual_half_cycle
        self._bank.add(parameters, half_cycle)
        if self.candidates is not None:
            self.candidates.add(parameters)
        if not parameters.origin.is_identified:
            self._zero = LoadCellZero()
        if self._bank.present is not before:
            self._use_present(fade=parameters.origin.is_identified)

    def follow_report(self, report: Report) -> None:
        """Process the identifier's report on a window."""
        said = report.verdict, report.nrmse_before, report.reason
        self._refused.follow(*said, confirms=report.confirms)
        if abs(report.current_lag) <= LARGEST_LAG:  # not NaN
            self._lag_ns = round(report.current_lag * NANOSECONDS)
        if report.confirms:
            currents = self._current.span(report.window_start_ns, report.stamp_ns)
            if self._bank.confirm(report.set_id, report.stamp_ns, currents):
                self._use_present(fade=True)

    def _use_present(self, *, fade: bool) -> None:
        """Use the first set of the bank."""
        assert self.parameters is not None
        self._force.use(self.parameters, gradual=self._bank.gradual, fade=fade)
        self._monitor.forget_error()

    def add_current(self, stamp_ns: int, current: float) -> None:
        """Add a value of the supply current [A]; raises CurrentError if it is not finite."""
        self._current.add(self.sequence.continued(stamp_ns), current)

    def current_at(self, stamp_ns: int) -> float:
        """Supply current [A] at a stamp; NaN if unknown."""
        if not self._current.known_from(stamp_ns):
            return np.nan
        return float(self._current.at(stamp_ns, 1.0, 1)[0])

    # Learning from the last block

    def catch_up(self) -> None:
        """Update everything that later predictions need from the last block.

        This takes longer than a prediction, so call it after publishing. If it is not called, the
        next :meth:`predict` does it first; the results are the same.
        """
        self._finish_learning()
        if self._motion is not None:
            self._motion.catch_up()

    def _finish_learning(self) -> None:
        for work in (self._unlearned, self._uncompared):
            if work is not None:
                work()
        self._unlearned = self._uncompared = None

    def _learn(
        self,
        block: SampleBlock,
        bridged: int,
        motion: Motion,
        current: Array,
        force: Array,
        *,
        known: bool,
    ) -> None:
        """Learn from the predicted ``force`` [N] and the ``current`` [A] of a block, (n,).

        ``known`` says whether the motion determines the force. The force of the first ``bridged``
        samples was not measured.
        """
        follower, parameters = self._motion, self.parameters
        assert follower is not None
        assert parameters is not None
        half_cycle, part = follower.centre.usual_half_cycle, slice(bridged, None)
        if known:
            measured = np.where(np.arange(force.size) < bridged, np.nan, block.force)
            self._bank.follow(motion, current, (force, measured), block.period, half_cycle)
        self._monitor.adapt(half_cycle)
        self._monitor.recent.add(
            (force[part], block.force[part]),
            motion.velocity[part],
            current[part],
            half_cycle,
            steady=follower.steady,
            largest=partial(
                parameters.largest_in_sine,
                float(motion.peak_velocity[-1]),
                half_cycle,
                float(current[-1]),
            ),
        )
        allowed = self._monitor.allowed
        sensible = self._newest_kind not in (DoubtKind.SENSOR, DoubtKind.INSTRUMENT)
        if self._bank.uses_given and sensible and allowed < math.inf:
            self._zero.learn(block.force[part] - force[part], follower.centre.reversals, allowed)
        if (choice := self._bank.choice(self._newest_kind, allowed)) is not None:
            chosen, error = choice
            self._bank.use(chosen)
            gradual = self._bank.gradual
            self._force.use(chosen.parameters, gradual=gradual, fade=True, restart=True)
            self._monitor.forget_error(error)

    # From a block to its force

    def predict(self, block: SampleBlock, now_ns: int | None = None) -> Prediction:
        """Force at the samples of a block; NaN and invalid if it cannot be computed.

        If part of the block arrived before, the force covers the new samples only. ``now_ns`` is
        the present time by the clock of the stamps; None without a clock.
        """
        (placed,) = self.sequence.follow(block)
        whole, bridged = placed.block, placed.bridged
        if placed.kind == "repeat":
            velocity = np.full(whole.sample_count, np.nan)
            part = _Part.unknown(velocity, DoubtKind.REPEATED, placed.sentence)
            return self._prediction(placed, [part])
        if placed.kind == "jump_back" and not placed.leap_ns:
            self._current.follow_jump()
            self.freshness.restart()
        self._follow_leap(placed.leap_ns, whole, now_ns)
        stale = self.freshness.judge(whole.end_ns, now_ns)
        lost_sight = self._motion is not None and self._motion.lost_sight(bridged * whole.period)
        if self._motion is None or placed.restarts or lost_sight:
            self._begin(whole.period)
        together = max(round(_PART_TIME / whole.period), 1)
        # The samples that bridge a gap belong to the first part.
        ends = [*range(bridged + together, whole.sample_count, together), whole.sample_count]
        parts = [
            self._predict(
                whole.part(first, end) if len(ends) > 1 else whole, 0 if first else bridged, stale
            )
            for first, end in pairwise([0, *ends])
        ]
        return self._prediction(placed, parts)

    def _follow_leap(self, leap_ns: int, block: SampleBlock, now_ns: int | None) -> None:
        """Let all ages continue after a leap of the stamps before this block, or an earlier one."""
        self._leap_ns += leap_ns
        if self._leap_ns and self.freshness.follow_leap(self._leap_ns, block.end_ns, now_ns):
            self._current.follow_leap(self._leap_ns, block.end_ns)
            self._bank.follow_leap(self._leap_ns)
            self._leap_ns = 0

    def _prediction(self, placed: Placed, parts: list[_Part]) -> Prediction:
        """The prediction for the samples that arrived, from the parts of their block in order."""
        doubt, judged = NO_DOUBT, []
        for part in parts:
            codes, newest = judge_samples(part.force.size, part.objections)
            doubt = newest or doubt
            judged.append((part.force, part.velocity, codes))
        force, velocity, codes = (
            (each[0] if len(each) == 1 else np.concatenate(each))[placed.bridged :]
            for each in zip(*judged, strict=True)
        )
        return Prediction(
            start_ns=placed.stamp_ns,
            sequence=placed.block.sequence + placed.bridged,
            period=placed.block.period,
            force=force,
            velocity=velocity,
            set_id=self.parameters.set_id if self.parameters else "",
            doubts=codes,
            doubt=doubt if doubt and codes.any() else NO_DOUBT,
            continuity=placed.sentence,
            motion=parts[-1].motion,
            current=parts[-1].current,
            set_doubt=self._monitor.doubt,
        )

    def _begin(self, period: float) -> None:
        """Restart for a motion that is unknown before these samples."""
        settings = self._settings
        self._motion = MotionFollower(period, settings.bandwidth, settings.centre_memory)
        self._force = ForceInUse(period)
        self._monitor = ResidualMonitor(period, settings.error_limit)
        self._zero.restart()
        self._unlearned = self._uncompared = None
        self._bank.forget_samples()
        if self.candidates is not None:
            self.candidates.restart()

    def _predict(self, block: SampleBlock, bridged: int, stale: str) -> _Part:
        assert self._motion is not None
        self._finish_learning()
        motion = self._motion.follow(block.displacement)
        if missing := lack_of_input(self.parameters, self._current, block.start_ns):
            return _Part.unknown(motion.velocity, DoubtKind.MISSING, missing)
        began_ns = block.start_ns - self._lag_ns
        current = self._current.at(began_ns, block.period, block.sample_count)
        self._bank.follow_current(float(current[-1]), block.end_ns)
        parameters = self.parameters
        assert parameters is not None
        if parameters is not self._force.parameters:
            # The change of current itself makes the force step, so nothing is faded.
            self._use_present(fade=False)
        if self._force.state is None:
            self._begun_at = self._motion.centre.reversals
        largest = (1.0 + self._settings.force_margin) * parameters.largest_force
        of_set = self._force.follow(motion, current, largest)
        if not math.isfinite(sum(of_set.tolist())):
            self._force.forget()
            sentence = f"the force of {parameters.set_id} overflows"
            return _Part.unknown(motion.velocity, DoubtKind.NOT_FINITE, sentence)
        given = self._bank.uses_given
        of_set = of_set + self._zero.follow(block.sample_count, block.period, counts=given)
        found = self._objections_to_set(block, bridged, motion, current, of_set)
        right = DoubtKind.WRONG if self._monitor.is_wrong else DoubtKind.NONE
        self._newest_kind = found[0].kind if found else right
        self._follow_candidates(block, bridged, motion, current)
        force = self._force.blended(of_set)
        if self._force.fading:
            arrived = force[bridged:], block.force[bridged:]
            found += self._force.objections(self._monitor.allowed, *arrived)
        if stale:
            found.append(Objection(DoubtKind.OUTDATED, stale))
        return _Part(force, motion.velocity, found, motion, current)

    def _follow_candidates(
        self, block: SampleBlock, bridged: int, motion: Motion, current: Array
    ) -> None:
        """Predict the sets in the background, and compare them with the measured force later."""
        candidates, follower = self.candidates, self._motion
        if candidates is None:
            return
        assert follower is not None
        assert self.parameters is not None
        candidates.use(self.parameters)
        if self._newest_kind in _UNKNOWN_MOTION:
            candidates.restart()
            return
        half_cycle, gradual = follower.centre.usual_half_cycle, self._bank.gradual
        candidates.follow(motion, current, block.period, half_cycle, gradual=gradual)
        if self._newest_kind in _COMPARABLE:
            self._uncompared = partial(
                candidates.compare,
                *(block.force[bridged:], current, self._monitor.recent, block.period),
                follower.centre,
            )

    def _objections_to_set(
        self, block: SampleBlock, bridged: int, motion: Motion, current: Array, force: Array
    ) -> list[Objection]:
        """The objections to the force of a set, beginning with those of the motion."""
        follower, monitor, settings = self._motion, self._monitor, self._settings
        assert follower is not None
        unsettled, past = follower.unsettled, follower.doubt
        resting = not unsettled and not past and follower.resting
        compared: list[Objection] | None = None
        if not unsettled and not resting:
            compared = monitor.judge(force[bridged:], block.force[bridged:])
        if not past and self._force.remembers and follower.centre.reversals == self._begun_at:
            past = "the state of the model is unknown until the motion has reversed"
        # If the predicted force agrees with the measured force, it is valid even if the past is
        # unknown, outside the identified range and after rejected windows.
        unproven = not (monitor.holds and follower.centre.reversals)
        found: list[Objection] = []
        frozen = follower.freeze.speed
        if frozen > 0.0:
            found.append(
                Objection(
                    DoubtKind.FROZEN,
                    f"the displacement has stopped within a sample at {frozen:.2g} m/s: is its "
                    "sensor connected, and does its signal still change?",
                )
            )
        if unsettled:
            found.append(Objection(DoubtKind.SETTLING, unsettled))
        if resting:
            found.append(Objection(DoubtKind.AT_REST, _AT_REST))
        if unproven and past:
            found.append(Objection(DoubtKind.SETTLING, past))
        if resting:
            self._zero.restart()
        else:
            self._unlearned = partial(
                self._learn, block, bridged, motion, current, force, known=not found
            )
        if found:
            # While the motion does not determine the force, a wrong force does not refute the set.
            if compared is None or monitor.is_wrong:
                monitor.forget_moment()
            self._bank.forget_samples()
            self._force.forget_known()
            return found
        live, present = self.freshness.live, self._bank.present
        assert present is not None
        parameters, confirmed_ns = present.parameters, present.confirmed_ns
        if of_instrument := self._refused.of_instrument:
            found.append(Objection(DoubtKind.INSTRUMENT, of_instrument))
        found += objections_to_age(self._current, confirmed_ns, block.end_ns, settings, live=live)
        if not unproven:
            return found + (compared or [])
        speed = middle(motion.peak_velocity)
        if not follower.steady:
            # In a motion other than a sine, a low peak velocity does not mean a small motion.
            speed = max(speed, follower.peak.root_mean_square)
        found += objections_to_current(parameters, settings.current_margin, current, self.tried)
        found += compared or []
        found += objections_to_motion(parameters, settings, speed, force)
        if refused := self._refused.sentence:
            found.append(Objection(DoubtKind.REFUSED, refused))
        return found
