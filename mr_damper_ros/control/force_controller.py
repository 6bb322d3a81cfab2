"""Force control of the damper: from the desired force to a supply command, block by block.

The controller uses the inverse of the identified law as feedforward and, optionally, feedback of
the measured force. While the predicted force is invalid, the command falls back to the safe
current.

During fallback, the current does not jump and does not move away from the safe current. At first,
it stays constant or moves slowly towards the safe current. When the force has been invalid for
``doubt_time`` longer than it was valid, the current goes to the safe current. Control returns when
the force has been valid for this time. If control is lost again soon, this time doubles; without
this rule, a force that is valid only at the safe current would switch control on and off for ever.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from mr_damper_ros.control.inverse_model import InverseModel
from mr_damper_ros.control.licence import Approach, Licence, Limits
from mr_damper_ros.kinematics.motion import MotionSample
from mr_damper_ros.models.first_order_lag import COIL
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.quantities import State
from mr_damper_ros.settings.option_table import CheckedSettings, group, option
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.signals.uniform_grid import GridSettings
from mr_damper_ros.tracking.candidate_sets import CandidateSets
from mr_damper_ros.tracking.predictor import ForcePredictor, Prediction, PredictorSettings
from mr_damper_ros.tracking.validity import NO_DOUBT, Doubt, DoubtKind

_LEAST = 0.05
"""Smallest desired force that is used for feedback, relative to the largest one so far.

Smaller forces do not determine the factor.
"""


@dataclass(frozen=True)
class FeedbackSettings(CheckedSettings):
    """Options of the feedback of the measured force."""

    feedback_gain: float = option(
        0.0,
        "Gain [1/s] of the feedback of the measured force. With 1, compensation for a weaker "
        "damper takes about a second. 0: feedforward only, for a rig without a load cell.",
        within=(0.0, 100.0),
    )
    feedback_limit: float = option(
        0.2, "Largest relative change of the desired force by the feedback.", within=(0.0, 0.9)
    )


class ForceFeedback:
    """Integral feedback of the measured force; ``factor`` multiplies the desired force."""

    def __init__(self, settings: FeedbackSettings) -> None:
        self._settings = settings
        self._expected = math.nan
        self._largest = 0.0
        self.factor = 1.0

    def expect(self, wanted: float) -> None:
        """Set the desired force [N] of the next block; NaN if it is not attainable."""
        self._expected = wanted
        if not math.isnan(wanted):
            self._largest = max(self._largest, abs(wanted))

    def follow(self, measured: Array, duration: float) -> None:
        """Correct the factor by the measured force (n,) [N] of a block of ``duration`` [s]."""
        wanted, gain = self._expected, self._settings.feedback_gain
        if gain == 0.0 or not abs(wanted) > _LEAST * self._largest:
            return
        step = min(gain * duration, 1.0) * (wanted - float(np.mean(measured))) / wanted
        limit = self._settings.feedback_limit
        self.factor = min(max(self.factor + step, 1.0 - limit), 1.0 + limit)


HOLD, SLIDE = "hold", "slide"


@dataclass(frozen=True)
class FallbackSettings(CheckedSettings):
    """Options of the fallback to the safe current and of the return to control."""

    safe_current: float = option(
        0.0,
        "Current [A] that is commanded when the predicted force is invalid, and when the node "
        "ends. It should lie within the identified range of currents: outside this range control "
        "does not start, except with crossing_rate.",
        within=(-10.0, 10.0),
    )
    crossing_rate: float = option(
        0.0,
        "Rate [A/s] at which the current crosses from a safe current outside the identified range "
        "of currents to this range, although the force on the way is unknown. 0: control does not "
        "start, and the diagnostics say so.",
        within=(0.0, 10.0),
    )
    in_doubt: str = option(
        HOLD,
        f"Reaction to a force that has just become invalid: {HOLD} keeps the current, which "
        f"suits a force that is soon valid again; {SLIDE} moves it towards the safe current "
        "from the first invalid sample on, and reaches it after doubt_time.",
        choices=(HOLD, SLIDE),
    )
    doubt_time: float = option(
        0.3,
        "Once the force has been invalid for this time [s] longer than it was valid, the command "
        "goes to the safe current. Control returns after this time of valid force; the wait "
        "doubles if control is soon lost again.",
        within=(0.0, 60.0),
    )
    fade_time: float = option(
        0.1,
        "Duration [s] of a ramp through the whole range of currents on the way to the safe "
        "current; the way back is at most as fast.",
        within=(0.001, 60.0),
    )


_ROUNDING = 1e-9
"""Tolerance of times [s] against rounding errors."""

_LASTING = 10.0
"""Control that has lasted for this multiple of ``doubt_time`` resets the wait."""

_LONGEST = 8.0
"""Longest wait for valid force, as a multiple of ``doubt_time``."""


class Fallback:
    """Limits the current around the safe current according to the validity of the force.

    ``span`` [A] is the range of the currents of the controller; ``lasts``: whether the command is
    the safe current, or moves towards it.
    """

    def __init__(self, settings: FallbackSettings, span: float) -> None:
        self._settings = settings
        self._span = span
        self._wait = settings.doubt_time
        self.give_up()

    @property
    def left(self) -> float:
        """Time [s] of valid force that is still needed until control returns."""
        return self._wait - self._calm if self.lasts else 0.0

    def give_up(self) -> None:
        """Go to the safe current at once, and wait for valid force again."""
        self.lasts, self._reach = True, 0.0
        # Times [s]: invalid minus valid; valid minus invalid; since the start of control.
        self._doubted = self._calm = self._controlled = 0.0

    def follow(self, duration: float, *, doubted: bool, at_once: bool = False) -> bool:
        """Update with ``duration`` [s] of valid or invalid (``doubted``) force.

        Returns whether the controller may command its own current. ``at_once``: fall back without
        waiting for ``doubt_time``.
        """
        step = duration if doubted else -duration
        if self.lasts:
            self._calm = max(self._calm - step, 0.0)
            if not doubted and self._calm >= self._wait - _ROUNDING:
                self.lasts = False
                self._doubted = self._controlled = 0.0
            return not self.lasts
        limit = self._settings.doubt_time
        self._controlled += duration
        self._doubted = max(self._doubted + step, 0.0)
        if doubted and (at_once or self._doubted >= limit - _ROUNDING):
            lasted = at_once or self._controlled > _LASTING * limit
            self._wait = limit if lasted else min(2.0 * self._wait, _LONGEST * limit)
            self.lasts, self._calm = True, 0.0
        return not doubted

    def away_from(self, current: float, duration: float) -> float:
        """The current [A] during fallback, ``duration`` [s] after it was ``current`` [A]."""
        safe, settings = self._settings.safe_current, self._settings
        time = settings.fade_time
        if not self.lasts:
            time = settings.doubt_time if settings.in_doubt == SLIDE else 0.0
        step = self._span * duration / time if time > 0.0 else 0.0
        self._reach = max(abs(current - safe) - step, 0.0)
        return self.within_reach(current)

    def approaching(self, current: float, target: float, step: float) -> float:
        """The current [A] moved from ``current`` to a ``target`` by at most a ``step`` [A]."""
        moved = current + min(max(target - current, -step), step)
        self._reach = abs(moved - self._settings.safe_current)
        return moved

    def towards(self, current: float, duration: float) -> float:
        """The setpoint ``current`` [A], limited by the ramp away from the safe current."""
        step = self._span * duration / self._settings.fade_time
        self._reach = min(self._reach + step, self._span)
        return self.within_reach(current)

    def within_reach(self, current: float) -> float:
        """The current [A], limited to the largest present distance from the safe current."""
        safe = self._settings.safe_current
        return min(max(current, safe - self._reach), safe + self._reach)


_CONFIRMING_TIME = 1.0
"""Time [s] of valid force, while more current is needed, before the next step."""

_PROBE_PAUSE = 30.0
"""Time [s] for which probing stops after the force was wrong."""

_PROBE_FAULTS = (DoubtKind.WRONG, DoubtKind.DRIVING, DoubtKind.TOO_LARGE, DoubtKind.SENSOR)


class Probe:
    """Extends the range of currents beyond the identified range in steps of ``step`` [A].

    ``beyond`` [A] is the present extension. A step of 0 disables probing.
    """

    def __init__(self, step: float) -> None:
        self._step = step
        self._needed = self._refuted = 0.0
        self.beyond = 0.0

    def follow(self, duration: float, doubt: Doubt, needed: bool) -> None:
        """Update after ``duration`` [s]; ``needed``: whether more current was needed."""
        if self._step == 0.0:
            return
        self._refuted = max(self._refuted - duration, 0.0)
        if doubt.kind in _PROBE_FAULTS and self.beyond > 0.0:
            self.beyond, self._refuted = 0.0, _PROBE_PAUSE
        if doubt or self._refuted > 0.0:
            self._needed = 0.0
        elif needed:
            self._needed += duration
        if self._needed >= _CONFIRMING_TIME:
            self._needed = 0.0
            self.beyond += self._step


_JUDGED_TIMES = (0.5, 1.0, 1.5)
"""Times at which the force of a current is evaluated, as fractions of the horizon."""

_MIDDLE = 1
"""Index of the time for which the current is computed."""

_INVERSE, _LOWEST, _LAST = range(3)
"""Indices of the candidate currents: the current of the inverse, the lowest, the last one."""


@dataclass(frozen=True)
class ForceControlSettings(CheckedSettings):
    """Options of the force controller."""

    lowest_current: float = option(
        0.0,
        "Lowest current that is commanded [A], within the identified range.",
        within=(-10.0, 10.0),
    )
    highest_current: float = option(
        2.0,
        "Highest current [A] that is commanded; see the rated current in the damper's data sheet.",
        within=(-10.0, 10.0),
    )
    slew_rate: float = option(
        0.0, "Largest rate of change of the command [A/s]; 0: no limit.", within=(0.0, 1e6)
    )
    fallback: FallbackSettings = group(FallbackSettings, flat=True)
    demand_timeout: float = option(
        0.2,
        "Age [s] of the desired force, by its stamp relative to the samples, after which the "
        "safe current is commanded.",
        within=(0.001, 3600.0),
    )
    horizon: float = option(
        0.01,
        "Time [s] in which a lagging coil should reach its current; at least a block. The lag "
        "is coil_time_constant of the parameters. A shorter time tracks faster and needs "
        "larger steps of the supply current.",
        within=(0.0001, 1.0),
    )
    force_deadband: float = option(
        5.0,
        "Improvement of the force [N] below which the current does not change; it prevents "
        "chatter.",
        within=(0.0, 1e6),
    )
    probe_step: float = option(
        0.0,
        "Step [A] for probing beyond the identified currents; 0: no probing. If a desired force "
        "needs a current outside the identified range, the diagnostics say so. With a step, "
        "the controller extends the range by this step, and by another one after each second "
        "in which the extension was needed and the measured force confirmed the predicted "
        "force, up to highest_current. If the predicted force becomes wrong, the controller "
        "returns to the identified range for half a minute. Probing needs a load cell "
        "(maximum_error).",
        within=(0.0, 1.0),
    )
    feedback: FeedbackSettings = group(FeedbackSettings, flat=True)
    predictor: PredictorSettings = group(PredictorSettings, flat=True)

    def limited(self, command: float, before: float, duration: float) -> float:
        """The command [A] within the limits of current and slew rate.

        ``before`` [A] is the previous command, ``duration`` [s] the time since then.
        """
        command = min(max(command, self.lowest_current), self.highest_current)
        if self.slew_rate > 0.0:
            reach = self.slew_rate * duration
            command = min(max(command, before - reach), before + reach)
        return command


@dataclass(frozen=True, eq=False)
class Command:
    """Supply command ``current`` [A]; it tracks the desired force only without a ``doubt``.

    ``wanted`` is the desired force [N], NaN without one; ``expected`` is the force [N] that the
    current produces, NaN during fallback; ``attainable``: whether the expected force is the desired
    force; ``prediction``: the prediction of the block. ``falls_back``: whether the current is the
    safe current or moves towards it. ``unknown``: whether the desired force needs a current outside
    the identified range.
    """

    current: float
    doubt: Doubt
    wanted: float
    prediction: Prediction
    expected: float = math.nan
    attainable: bool = False
    falls_back: bool = False
    unknown: bool = False


_AT_ONCE = (DoubtKind.MISSING, DoubtKind.OUTDATED, DoubtKind.FROZEN)
"""Reasons for immediate fallback, which have already lasted for some time or will not end soon."""


class ForceController:
    """Computes supply commands from blocks of samples and desired forces.

    All times are stamps of the data.
    """

    def __init__(self, settings: ForceControlSettings, grid: GridSettings | None = None) -> None:
        self.settings = settings
        predictor, fallback = settings.predictor, settings.fallback
        self._candidates = CandidateSets(predictor.error_limit)
        self.predictor = ForcePredictor(predictor, grid, self._candidates)
        """Predicts the force and its validity.

        The caller passes it parameter sets, currents, reports, and blocks that arrived too late for
        a command. After sending a command, the caller calls its method ``catch_up``.
        """
        self.feedback = ForceFeedback(settings.feedback)
        # Stamp [ns] and value [N] of the desired force.
        self._demand: tuple[int, float] | None = None
        limits = Limits(settings.lowest_current, settings.highest_current, fallback.safe_current)
        self._licence = Licence(limits, predictor.current_margin)
        self._approach = Approach(fallback.crossing_rate)
        # The inverse, its coil time constant [s], and the limits within its range of currents,
        # which also apply to the overshoot that drives the coil.
        self._inverse: InverseModel | None = None
        self._time_constant = 0.0
        self._limits = settings
        # The inverted set, whether its reversals are gradual, and the permitted currents [A].
        self._inverted: tuple[ParameterSet, bool, float, float] | None = None
        # The last setpoint of the coil current and the last command [A].
        self._wanted: float | None = None
        self._commanded = fallback.safe_current
        self._fallback = Fallback(fallback, settings.highest_current - settings.lowest_current)
        self._probe = Probe(settings.probe_step)
        self._last_was_unknown = False

    @property
    def highest_known(self) -> float:
        """Highest permitted current [A]; NaN if no set can be inverted."""
        return math.nan if self._inverse is None else self._limits.highest_current

    @property
    def _memory(self) -> State | None:
        """State of the inverted law after the last block."""
        permit = self._licence.permit
        return None if permit is None else permit.candidate.state

    def _invert(self) -> None:
        """Invert the set that the licence permits, if the set or its range has changed."""
        self._licence.choose(self._candidates.sets, self._probe.beyond)
        permit, gradual = self._licence.permit, self.predictor.gradual
        if permit is None:
            return
        self._candidates.kept = permit.candidate
        parameters, settings = permit.candidate.parameters, self.settings
        self.predictor.tried = parameters.current_range[1] + self._probe.beyond
        wanted, before = (parameters, gradual, permit.low, permit.high), self._inverted
        if before is not None and wanted[0] is before[0] and wanted[1:] == before[1:]:
            return
        self._inverted, self._inverse = wanted, None
        if permit.width > 0.0:
            self._inverse = InverseModel(
                parameters, permit.low, permit.high, gradual_reversal=gradual
            )
            self._time_constant = parameters.as_dict().get(COIL, 0.0)
            self._limits = replace(settings, lowest_current=permit.low, highest_current=permit.high)

    def want(self, stamp_ns: int, force: float) -> str:
        """Set the desired force [N]; returns an objection, empty if the force is usable."""
        if not math.isfinite(force):
            return f"the desired force is {force}: it must be a finite number"
        self._demand = stamp_ns, force
        return ""

    def command(self, block: SampleBlock, now_ns: int | None = None) -> Command:
        """The command after a block; ``now_ns`` as in :meth:`ForcePredictor.predict`."""
        prediction = self.predictor.predict(block, now_ns)
        duration = block.sample_count * block.period
        self._invert()
        doubt = self._doubt(prediction, block.end_ns)
        wanted = math.nan if self._demand is None else self._demand[1]
        at_once = doubt.kind in _AT_ONCE or bool(self._licence.refusal)
        self._probe.follow(duration, doubt, self._last_was_unknown)
        self._last_was_unknown = False
        if not self._fallback.follow(duration, doubted=bool(doubt), at_once=at_once):
            return self._fall_back(prediction, doubt, wanted, duration)
        self._approach.succeed()
        self.feedback.follow(block.force, duration)
        horizon = max(duration, self.settings.horizon)
        assert prediction.motion is not None
        assert prediction.current is not None
        sample, sought = MotionSample.of(prediction.motion, -1), wanted * self.feedback.factor
        current, force, attainable, unknown = self._aim(sample, sought, horizon)
        self._wanted = command = self._fallback.towards(current, duration)
        attainable = attainable and self._wanted == current
        self.feedback.expect(wanted if attainable else math.nan)
        if self._time_constant > 0.0:
            memory = self._memory
            coil = float((prediction.current if memory is None else memory)[-1])
            # The lagging coil reaches the setpoint at the end of the horizon.
            command = coil + (command - coil) / -math.expm1(-horizon / self._time_constant)
        command = self._limits.limited(command, self._commanded, duration)
        self._commanded = self._fallback.within_reach(command)
        self._last_was_unknown = unknown
        made = self._commanded, NO_DOUBT, wanted, prediction
        return Command(*made, force, attainable, unknown=unknown)

    def _fall_back(
        self, prediction: Prediction, doubt: Doubt, wanted: float, duration: float
    ) -> Command:
        self.feedback.expect(math.nan)
        safe = self.settings.fallback.safe_current
        # With a lagging coil, the command overshoots the setpoint of the coil current. Of these
        # two, the one closer to the safe current is held.
        held = self._commanded if self._wanted is None else self._wanted
        held = min(held, self._commanded, key=lambda current: abs(current - safe))
        if self._inverse is not None:
            # A current beyond the identified range, reached by probing, is not held.
            held = min(held, max(self._limits.highest_current, safe))
        self._wanted = self._moved(held, doubt, duration)
        self._commanded = self.settings.limited(self._wanted, self._commanded, duration)
        doubt = doubt or Doubt(
            DoubtKind.SETTLING,
            f"the force is valid again: control returns after another {self._fallback.left:.2f} "
            "s of valid force",
        )
        falls_back = self._fallback.lasts
        return Command(self._commanded, doubt, wanted, prediction, falls_back=falls_back)

    def _moved(self, held: float, doubt: Doubt, duration: float) -> float:
        """The coil current [A] of a fallback, ``duration`` [s] after it was ``held`` [A]."""
        fallback, approach = self._fallback, self._approach
        safe = self.settings.fallback.safe_current
        if not fallback.lasts:
            approach.end()
        elif approach.under_way or held == safe:
            step = approach.follow(doubt, self._licence.permit, held, duration)
            if approach.fault_ended:
                self._candidates.forget_evidence()
            if approach.under_way:
                return fallback.approaching(held, approach.target, step)
        return fallback.away_from(held, duration)

    def give_up(self) -> float:
        """Reset to the safe current [A] and return it."""
        self._wanted = None
        self._commanded = self.settings.fallback.safe_current
        self._fallback.give_up()
        return self._commanded

    def _doubt(self, prediction: Prediction, end_ns: int) -> Doubt:
        permit, parameters = self._licence.permit, self.predictor.parameters
        current = math.nan if prediction.current is None else float(prediction.current[-1])
        in_use = permit is not None and permit.candidate.parameters is parameters
        doubt = self._licence.judge(
            *(prediction.newest_doubt or prediction.set_doubt, current),
            in_use=in_use,
            in_control=not self._fallback.lasts,
        )
        if doubt:
            return doubt
        if self._demand is None:
            return Doubt(
                DoubtKind.MISSING, "no desired force yet: is it published on damper/desired_force?"
            )
        age = (end_ns - self._demand[0]) / NANOSECONDS
        if abs(age) > self.settings.demand_timeout:
            return Doubt(
                DoubtKind.OUTDATED,
                f"the desired force is {age:.2f} s older than the samples, but demand_timeout is "
                f"{self.settings.demand_timeout:g} s: has its publisher stopped, or does it use a "
                "different clock?",
            )
        return NO_DOUBT

    def _aim(
        self, sample: MotionSample, wanted: float, horizon: float
    ) -> tuple[float, float, bool, bool]:
        """The coil current [A] for a desired force [N] within the ``horizon`` [s] after a sample.

        Also returns its force [N], whether this is the desired force, and whether that needs a
        current within the limits, but outside the identified range.
        """
        model, last, state = self._inverse, self._wanted, self._memory
        assert model is not None
        ahead = horizon if self._time_constant > 0.0 else 0.5 * horizon
        times = [part * ahead for part in _JUDGED_TIMES]
        samples = [sample.moved_on(time) for time in times]
        found = model.current(samples[_MIDDLE], wanted, last, period=times[_MIDDLE], state=state)
        responses = [
            model.at(later, period=time, state=state)
            for later, time in zip(samples, times, strict=True)
        ]
        lowest = self._limits.lowest_current
        currents = found.current, lowest, lowest if last is None else last
        # Just before a reversal, a suitable current soon becomes wrong, and the coil cannot follow.
        # Therefore each candidate is judged at several times.
        forces = [[force_at(current) for force_at in responses] for current in currents]
        # The desired force is limited to the range of the candidates, because their errors relative
        # to a far larger force would be almost equal.
        every = [each for several in forces for each in several]
        sought = min(max(wanted, min(every)), max(every))
        misses = [math.dist(force, [sought] * len(_JUDGED_TIMES)) for force in forces]
        best = misses.index(min(misses))
        deadband = self.settings.force_deadband * math.sqrt(len(_JUDGED_TIMES))
        if last is not None and misses[_LAST] <= misses[best] + deadband:
            best = _LAST
        # The current of the inverse is rejected if its error over these times is larger.
        given_up = best == _LOWEST and found.current != lowest
        met = found.attainable and not given_up
        # A desired force of the same sign as the attainable force, but larger, needs more current.
        more = wanted * found.force > 0.0 and abs(wanted) > abs(found.force)
        ends_early = self._limits.highest_current < self.settings.highest_current
        unknown = ends_early and more and not found.attainable
        return currents[best], forces[best][_MIDDLE], met, unknown
