"""Predicts the damper's force from a stream of displacement and current, from the past alone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.motion_follower import MotionFollower
from mr_damper_ros.models.force_model import ForceStream
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.quantities import State
from mr_damper_ros.settings.option_table import option
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import SampleBlock
from mr_damper_ros.signals.uniform_grid import GridSettings, UniformGrid
from mr_damper_ros.signals.zero_order_hold import KEEP_CURRENT, ZeroOrderHold
from mr_damper_ros.tracking.fading_force import FadingForce
from mr_damper_ros.tracking.force_watch import ForceWatch
from mr_damper_ros.tracking.freshness import Freshness
from mr_damper_ros.tracking.known_sets import Choice, KnownSets
from mr_damper_ros.tracking.prediction import Prediction
from mr_damper_ros.tracking.reckoned_force import ForceDoubt, Reckoned, Unlearned
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.validity import (
    NO_DOUBT,
    Doubt,
    DoubtKind,
    ValiditySettings,
    doubt_of_current_age,
    doubt_of_current_range,
    doubt_of_missing,
    doubt_of_motion,
    doubt_of_parameters_age,
    doubt_of_past,
    doubt_of_size,
    doubt_of_speed,
    doubts_of_samples,
    middle,
)
from mr_damper_ros.tracking.verdict_watch import VerdictWatch


@dataclass(frozen=True)
class PredictorSettings(ValiditySettings):
    """How the prediction follows the stream, and when it is no longer valid."""

    bandwidth: float = option(
        0.0,
        "Bandwidth of the observer that estimates velocity and acceleration from the displacement "
        "[Hz]. Wider follows faster motion, narrower passes less noise of the displacement sensor. "
        "0: it follows the motion and the noise by itself. Any other is brought between 0.02 % and "
        "a quarter of the sample rate.",
        minimum=0.0,
        maximum=10_000.0,
    )
    gradual_reversal: bool = option(
        True,
        "Whether the branch of the sigmoid's hysteresis follows the velocity where the motion "
        "turns, as recorded forces do; false: it jumps with the sign of the acceleration, as the "
        "thesis' law does.",
    )
    centre_memory: float = option(
        10.0,
        "Time over which the centre of the motion is taken [s]: the law needs the displacement "
        "from the centre. A whole cycle of the motion must fit in.",
        minimum=0.01,
        maximum=3600.0,
    )


_TOGETHER = 0.01
"""Seconds of samples that are followed at once: what is learnt from them, another set or another
current, counts for the next. So a block of many is no worse than several of few."""

_OF_THE_SET = (DoubtKind.WRONG, DoubtKind.DRIVING, DoubtKind.OUT_OF_RANGE, DoubtKind.TOO_LARGE)
"""Doubts that another set may remove."""


class ForcePredictor:
    """Predicts the force of each block as it arrives."""

    def __init__(self, settings: PredictorSettings, grid: GridSettings | None = None) -> None:
        self._settings = settings
        margin, measured = settings.velocity_margin, settings.maximum_error > 0.0
        self._known = KnownSets(margin, gradual=settings.gradual_reversal, measured=measured)
        self._newest_doubt = NO_DOUBT
        self._current = ZeroOrderHold(keep=KEEP_CURRENT)
        self._sequence = UniformGrid(grid)
        self._motion: MotionFollower | None = None
        self._stream: ForceStream | None = None
        self._freshness = Freshness(settings.max_age)
        self._verdicts = VerdictWatch()
        self._watch: ForceWatch | None = None
        self._fading = FadingForce()
        self._unlearned: Unlearned | None = None
        # Reversals of the motion when the model began to follow it.
        self._begun_at = 0
        self.tried = -math.inf
        """Highest current [A] that is being tried out: the measured force alone judges up to it."""

    @property
    def sequence(self) -> UniformGrid:
        """How the blocks have followed each other so far."""
        return self._sequence

    @property
    def freshness(self) -> Freshness:
        """How old the samples are."""
        return self._freshness

    @property
    def parameters(self) -> ParameterSet | None:
        """The set in use; None before the first."""
        present = self._known.present
        return None if present is None else present.parameters

    @property
    def gradual(self) -> bool:
        """Whether the force is predicted without jumps where the motion turns."""
        return self._known.gradual

    @property
    def memory(self) -> State | None:
        """What the law remembers after the last block, the coil's current last, if it lags."""
        return None if self._stream is None else self._stream.state

    def set_parameters(self, parameters: ParameterSet, confirmed_ns: int | None = None) -> None:
        """Predict with this set from the next block on, unless another is better known here.

        ``confirmed_ns`` is the stamp of the last sample that it is known to fit; None for a set
        that does not age, such as one that a user gave: its force counts at once, that of others
        after what is left of the force before has faded. See :meth:`KnownSets.add` for what
        displaces a given set. What the model remembers of the motion is found anew with this set;
        one of another model begins without.
        """
        self._verdicts.forget()
        if self._known.is_in_use(parameters):
            return
        before, used = self._known.present, self.parameters
        half_cycle = math.nan if self._motion is None else self._motion.half_cycle
        self._known.add(parameters, confirmed_ns, half_cycle)
        if before is not None and self._known.present is before:
            return
        if confirmed_ns is not None:
            self._fading.leave(self._stream, used)
        else:
            self._fading.step()
        self._retrace()

    def _retrace(self) -> None:
        """What the model remembers is found anew with the set that is in use now."""
        if self._stream is not None and self.parameters is not None:
            if self._stream.model.name != self.parameters.model:
                self._stream = None
            else:
                self._stream.retrace(self.parameters.values)
        if self._watch is not None:
            self._watch.forget_error()

    def confirm(self, set_id: str, start_ns: int, stamp_ns: int) -> None:
        """Take note that the set of this name fits the samples of a window, up to the stamp."""
        before = self.parameters
        if self._known.confirm(set_id, stamp_ns, self._current.span(start_ns, stamp_ns)):
            self._fading.leave(self._stream, before)
            self._retrace()

    def follow_verdict(self, verdict: int, nrmse_before: float, *, confirms: bool) -> None:
        """Take note of the identifier's verdict on a window, as in FitReport.

        ``nrmse_before``: what the parameters in use leave of the window, NaN where it is unknown.
        """
        self._verdicts.follow(verdict, nrmse_before, confirms=confirms)

    def follow_report(self, report: Report) -> None:
        """Take note of the identifier's report on a window."""
        self.follow_verdict(report.verdict, report.nrmse_before, confirms=report.confirms)
        if report.confirms:
            self.confirm(report.set_id, report.window_start_ns, report.stamp_ns)

    def add_current(self, stamp_ns: int, current: float) -> None:
        """Add a value of the supply current [A]; raises CurrentError for one that is not finite."""
        self._current.add(stamp_ns, current)

    def current_at(self, stamp_ns: int) -> float:
        """Supply current [A] that holds at a stamp; NaN where none is known."""
        if not self._current.known_from(stamp_ns):
            return np.nan
        return float(self._current.at(stamp_ns, 1.0, 1)[0])

    def catch_up(self) -> None:
        """Learn from the last block what only the predictions after it need.

        It takes longer than a prediction, so call it once that is on its way. Without it the next
        :meth:`predict` does what it must itself, with the same results.
        """
        if self._motion is not None:
            self._learn()
            self._motion.catch_up()

    def _learn(self) -> None:
        unlearned, self._unlearned = self._unlearned, None
        if unlearned is not None and self._watch is not None and self._motion is not None:
            half_cycle, steady = self._motion.half_cycle, self._motion.steady
            forces, motion, current, known, period, bridged = unlearned
            if known:
                self._known.follow(motion, current, forces, period, half_cycle, bridged)
            self._watch.learn(*unlearned.measured, half_cycle, steady=steady)
            if self._newest_doubt.kind in _OF_THE_SET and self._known.search_is_due():
                self._go_on_with(self._another(self._watch), self._watch)
            elif self._known.look_at_turning_is_due():
                self._go_on_with(self._known.turned_otherwise(), self._watch)

    def _another(self, watch: ForceWatch) -> Choice | None:
        """A set that was for such a motion before, if the measured force says so."""
        wrong = self._newest_doubt.kind in (DoubtKind.WRONG, DoubtKind.DRIVING)
        choice = self._known.another(watch.allowed, wrong=wrong)
        return self._known.turned_otherwise() if choice is None and wrong else choice

    def _go_on_with(self, choice: Choice | None, watch: ForceWatch) -> None:
        if choice is None:
            return
        self._fading.leave(self._stream, self.parameters)
        self._stream = self._known.settled_stream(choice.chosen)
        self._known.use(choice.chosen)
        watch.forget_error(choice.error)

    def _doubt_of_force(
        self, motion: Motion, steady: bool, current: Array, force: Array
    ) -> ForceDoubt:
        assert self.parameters is not None
        settings, parameters = self._settings, self.parameters
        return ForceDoubt(
            doubt_of_current_range(current, parameters, settings.current_margin, self.tried),
            doubt_of_size(force, parameters, settings.force_margin),
            doubt_of_speed(self._speed(motion, steady), parameters, settings.velocity_margin),
        )

    def predict(self, block: SampleBlock, now_ns: int | None = None) -> Prediction:
        """Force at the samples of a block; NaN, and not valid, where it cannot be computed.

        Of a block of which a part came before, that at its new samples. ``now_ns`` is the present
        time on the clock of the stamps, where there is one.
        """
        (placed,) = self._sequence.follow(block)
        whole, bridged, verdict = placed.block, placed.bridged, placed.continuity
        if verdict.kind == "repeat":
            repeated = Doubt(DoubtKind.REPEATED, verdict.sentence)
            return self._invalid(whole, repeated, verdict.sentence)
        if verdict.kind == "jump_back":
            self._current.follow_jump()
            self._freshness.restart()
        stale = self._freshness.judge(whole.end_ns, now_ns)
        lost_sight = self._motion is not None and self._motion.lost_sight(bridged * whole.period)
        restarts = verdict.restarts or lost_sight
        together = max(round(_TOGETHER / whole.period), 1)
        if whole.sample_count <= bridged + together:
            prediction = self._predict(whole, bridged, verdict.sentence, stale, restarts=restarts)
            return prediction if whole is block else prediction.of_arrived(placed)
        # Those that were bridged go with the first that were not.
        ends = [*range(bridged + together, whole.sample_count, together), whole.sample_count]
        parts = [
            self._predict(
                whole.part(first, end),
                0 if first else bridged,
                verdict.sentence,
                stale,
                restarts=restarts and first == 0,
            )
            for first, end in pairwise([0, *ends])
        ]
        prediction = Prediction.joined(parts)
        return prediction if whole is block else prediction.of_arrived(placed)

    def _predict(
        self, block: SampleBlock, bridged: int, continuity: str, stale: Doubt, *, restarts: bool
    ) -> Prediction:
        if self._motion is None or restarts:
            self._motion = MotionFollower(
                block.period, self._settings.bandwidth, self._settings.centre_memory
            )
            self._stream = None
            self._watch = ForceWatch(block.period, self._settings.maximum_error)
            self._fading = FadingForce(block.period)
            self._unlearned = None
            self._known.forget_samples()
        self._learn()
        motion = self._motion.follow(block.displacement)
        missing = doubt_of_missing(self.parameters, self._current, block.start_ns)
        if missing:
            return self._invalid(block, missing, continuity, motion.velocity)
        reckoned = self._reckon_block(motion, block)
        assert self.parameters is not None
        if not reckoned.finite:
            self._stream = None
            sentence = f"the force of {self.parameters.set_id} is beyond what a number can hold"
            not_finite = Doubt(DoubtKind.NOT_FINITE, sentence)
            return self._invalid(block, not_finite, continuity, motion.velocity)
        assert self._watch is not None
        largest = (1.0 + self._settings.force_margin) * self.parameters.largest_force
        force = self._fading.follow(reckoned.force, motion, reckoned.current, largest)
        of_set = [each for each in self._doubts(block, bridged, motion, reckoned) if each]
        self._newest_doubt = of_set[0] if of_set else NO_DOUBT
        fading = self._fading.doubt(self._watch.allowed, force[bridged:], block.force[bridged:])
        others = [each for each in (fading.after(bridged), stale) if each]
        doubts, doubt = doubts_of_samples(block.sample_count, of_set + others)
        return Prediction(
            start_ns=block.start_ns,
            sequence=block.sequence,
            period=block.period,
            force=force,
            velocity=motion.velocity,
            set_id=self.parameters.set_id,
            doubts=doubts,
            doubt=doubt,
            continuity=continuity,
            motion=motion,
            current=reckoned.current,
        )

    def _doubts(
        self, block: SampleBlock, bridged: int, motion: Motion, reckoned: Reckoned
    ) -> list[Doubt]:
        """Why not to rely on the force of a block: what is known of the motion comes first."""
        assert self._motion is not None
        assert self._stream is not None
        assert self._watch is not None
        forces = reckoned.force, block.force
        settling = doubt_of_motion(self._motion)
        measured: list[Doubt] = []
        if not settling:
            measured = self._watch.judge(reckoned.force[bridged:], block.force[bridged:])
            if not self._watch.holds:
                settling = doubt_of_past(self._motion, self._stream, self._begun_at)
        if settling:
            # A force that nobody could know says nothing of the parameters.
            if not measured or any(measured):
                self._watch.forget_moment()
            self._known.forget_samples()
            if settling.kind is not DoubtKind.AT_REST:
                self._unlearned = Unlearned(
                    forces, motion, reckoned.current, False, block.period, bridged
                )
            return [settling]
        self._unlearned = Unlearned(forces, motion, reckoned.current, True, block.period, bridged)
        settings, live, present = self._settings, self._freshness.live, self._known.present
        assert present is not None
        doubts = [
            doubt_of_current_age(self._current, block.end_ns, settings.current_timeout, live=live),
            doubt_of_parameters_age(present.confirmed_ns, block.end_ns, settings, live=live),
        ]
        by_force = [each.after(bridged) for each in measured]
        if self._watch.holds:
            # What has been right for a cycle holds, identified for this motion and this current or
            # not, and whatever the identifier says of windows that it could not fit.
            return doubts + by_force
        current, size, speed = reckoned.doubt
        return [*doubts, current, *by_force, size, speed, self._verdicts.doubt]

    def _reckon_block(self, motion: Motion, block: SampleBlock) -> Reckoned:
        assert self._motion is not None
        current = self._current.at(block.start_ns, block.period, block.sample_count)
        if self._known.follow_current(float(current[-1]), block.end_ns):
            # A change of the current changes the force, too.
            self._fading.step()
            self._retrace()
        parameters, steady = self.parameters, self._motion.steady
        assert parameters is not None
        if self._stream is None:
            law = parameters.law.continuous if self._known.gradual else parameters.law
            self._stream = law.stream(block.period)
            self._begun_at = self._motion.reversals
        held = parameters.held(motion)
        force = self._stream.follow(parameters.values, held, current)
        doubt = self._doubt_of_force(motion, steady, current, force)
        return Reckoned(force, bool(np.isfinite(force).all()), doubt, current)

    def _speed(self, motion: Motion, steady: bool) -> float:
        """The peak velocity [m/s] that stands for a block."""
        speed = middle(motion.peak_velocity)
        if self._motion is not None and not steady:
            # A motion that is no sine passes through low values without being small.
            speed = max(speed, self._motion.usual_peak_velocity)
        return speed

    def _invalid(
        self, block: SampleBlock, doubt: Doubt, continuity: str, velocity: Array | None = None
    ) -> Prediction:
        set_id = self.parameters.set_id if self.parameters else ""
        return Prediction.without_force(block, set_id, doubt, continuity, velocity)
