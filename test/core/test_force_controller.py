"""Force control: the desired force is reached, and no uncertain current is commanded."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from known import EXAMPLES, PLAUSIBLE, T0
from random_motion import BandLimitedRandom

from mr_damper_ros.control.force_controller import (
    Command,
    Fallback,
    FallbackSettings,
    FeedbackSettings,
    ForceController,
    ForceControlSettings,
    ForceFeedback,
)
from mr_damper_ros.emulation.emulator import (
    CurrentSchedule,
    Damper,
    EmulatedDamper,
    EmulatedRig,
    RigSettings,
)
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.models.domain import Origin
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.tracking.predictor import PredictorSettings
from mr_damper_ros.tracking.validity import DoubtKind

PERIOD = 1e-3
BLOCK = 10

WHOLE = ParameterSet(
    PLAUSIBLE,
    set_id="true",
    peak_velocity_range=(0.0, 1.0),
    current_range=(0.0, 2.0),
    largest_force=4000.0,
)

TRACKED = 0.1
"""NRMSE against the desired force where it is attainable; the bound for a lag of 10 ms."""

SETTLED = 2.5
"""Seconds after which motion and peak velocity are known."""


@dataclass(frozen=True, eq=False)
class ControlTrial:
    """Desired, attainable and actual force; arrays (n,), commands by block."""

    wanted: Array
    attainable: np.ndarray
    force: Array
    commands: list[Command]

    @property
    def nrmse(self) -> float:
        """NRMSE over the samples with an attainable desired force."""
        error = (self.force - self.wanted)[self.attainable]
        return float(np.sqrt(np.mean(error**2)) / np.std(self.force))


class ControlLoop:
    """A rig whose supply follows the controller's commands from the next block on."""

    def __init__(
        self,
        controller: ForceController,
        damper: Damper,
        *,
        coil: float = 0.0,
        noise: float = 5.53,
        displacement_noise: float = 0.0,
        excitation: object | None = None,
    ) -> None:
        self.controller = controller
        self._times, self._currents = [0.0], [controller.settings.fallback.safe_current]
        self._rig = EmulatedRig(
            damper,
            excitation or BandLimitedRandom(0.004, 0.5, 3.0, seed=4),  # type: ignore[arg-type]
            CurrentSchedule(self._times, self._currents),
            settings=RigSettings(
                force_noise=noise, displacement_noise=displacement_noise, start_ns=T0
            ),
            coil_time_constant=coil,
        )
        self._rig.live = True

    def blocks(self, duration: float) -> Iterator[SampleBlock]:
        """Blocks of samples; the controller has received their currents."""
        for number in range(round(duration / PERIOD / BLOCK)):
            made = self._rig.next_block(BLOCK)
            for place in range(BLOCK):
                self.controller.predictor.add_current(made.stamp_ns(place), made.current[place])
            self._now = (number + 1) * BLOCK * PERIOD
            yield made.samples

    def command(self, current: float) -> None:
        """Set the supply current."""
        self._times.append(self._now)
        self._currents.append(current)


def settings(
    feedback_gain: float = 0.0,
    safe_current: float = 0.0,
    crossing_rate: float = 0.0,
    **changes: float,
) -> ForceControlSettings:
    """Settings of a controller that ignores the age of samples."""
    return ForceControlSettings(
        feedback=FeedbackSettings(feedback_gain=feedback_gain),
        fallback=FallbackSettings(safe_current=safe_current, crossing_rate=crossing_rate),
        predictor=PredictorSettings(max_age=0.0),
        **changes,
    )


def controlled(parameters: ParameterSet, **changes: float) -> ForceController:
    controller = ForceController(settings(**changes))
    controller.predictor.set_parameters(parameters)
    return controller


def tracked(loop: ControlLoop, demand: float, duration: float = 5.5) -> ControlTrial:
    """Track the force of a viscous damper [N s/m] at the velocity of the previous block."""
    wanted, attainable, forces, commands = [], [], [], []
    velocity, last = 0.0, None
    for block in loop.blocks(duration):
        if last is not None and last.doubt.kind is DoubtKind.NONE:
            time = (block.start_ns - T0) / NANOSECONDS
            if time > SETTLED:
                wanted += [last.wanted] * BLOCK
                attainable += [last.attainable] * BLOCK
                forces.append(block.force)
        steps = np.diff(block.displacement)
        velocity = float(steps.mean()) / PERIOD
        loop.controller.want(block.end_ns, demand * velocity)
        last = loop.controller.command(block)
        loop.controller.predictor.catch_up()
        loop.command(last.current)
        commands.append(last)
    return ControlTrial(
        np.array(wanted), np.array(attainable), np.concatenate(forces or [np.empty(0)]), commands
    )


def lagging_coil(name: str, time_constant: float) -> ParameterSet:
    """The damper with a coil lag."""
    values = np.pad(PLAUSIBLE, (0, 4)) if name == "sigmoid_lag" else EXAMPLES[name].copy()
    values[-1] = time_constant
    return ParameterSet(
        values, model=name, peak_velocity_range=(0.0, 1.0), current_range=(0.0, 2.0)
    )


@pytest.mark.parametrize("damper", [WHOLE, lagging_coil("sigmoid_lag", 0.03)], ids=["", "lag"])
def test_a_dissipative_force_is_tracked(damper: ParameterSet) -> None:
    trial = tracked(ControlLoop(controlled(damper), EmulatedDamper(damper)), 12e3)
    assert trial.attainable.mean() > 0.3
    assert trial.nrmse < TRACKED


def test_other_laws_are_controlled_too() -> None:
    values = EXAMPLES["bouc_wen"].copy()
    names = list(ParameterSet(values, model="bouc_wen").law.parameter_names)
    values[names.index("alpha_1")], values[names.index("c0_1")] = 3.0, 1.0
    other = ParameterSet(
        values, model="bouc_wen", peak_velocity_range=(0.0, 1.0), current_range=(0.0, 2.0)
    )
    trial = tracked(ControlLoop(controlled(other), EmulatedDamper(other)), 25e3)
    assert trial.attainable.mean() > 0.3
    assert trial.nrmse < TRACKED


def test_feedback_makes_good_a_damper_that_has_got_weaker() -> None:
    weak = PLAUSIBLE.copy()
    weak[0] *= 0.9
    errors = []
    for gain in (0.0, 2.0):
        controller = controlled(WHOLE, feedback_gain=gain)
        damper = EmulatedDamper(weak)
        errors.append(tracked(ControlLoop(controller, damper), 12e3).nrmse)
    assert errors[1] < 0.7 * errors[0]
    assert controller.feedback.factor == pytest.approx(1.0 / 0.9, abs=0.04)


# -- uncertain forces ------------------------------------------------------------------------------


def after(
    controller: ForceController,
    duration: float = 4.0,
    demand: float | None = 500.0,
    noise: float = 0.0,
    damper: Damper | None = None,
) -> Command:
    """The last command after a sine with a constant desired force."""
    loop = ControlLoop(
        controller, damper or EmulatedDamper(WHOLE), noise=noise, excitation=SineMotion(5e-3, 1.0)
    )
    for block in loop.blocks(duration):
        if demand is not None:
            controller.want(block.end_ns, demand)
        last = controller.command(block)
        loop.command(last.current)
    return last


def test_without_parameters_the_current_is_safe() -> None:
    command = after(ForceController(settings(safe_current=0.2)))
    assert command.doubt.kind is DoubtKind.MISSING
    assert command.current == 0.2


def test_without_a_desired_force_the_current_is_safe() -> None:
    command = after(controlled(WHOLE), demand=None)
    assert command.doubt.kind is DoubtKind.MISSING
    assert "damper/desired_force" in command.doubt.sentence
    assert command.current == 0.0


def test_an_endless_desired_force_is_followed_as_far_as_the_damper_can() -> None:
    """The highest current if the force opposes the motion, otherwise the lowest."""
    controller = controlled(WHOLE)
    loop = ControlLoop(controller, EmulatedDamper(WHOLE), excitation=SineMotion(5e-3, 1.0))
    currents: dict[bool, list[float]] = {True: [], False: []}
    for block in loop.blocks(5.0):
        controller.want(block.end_ns, 1e20)
        command = controller.command(block)
        loop.command(command.current)
        angle = 2.0 * math.pi * (block.end_ns - T0) / NANOSECONDS
        if block.end_ns - T0 > SETTLED * NANOSECONDS and abs(math.cos(angle)) > 0.5:
            currents[math.cos(angle) > 0.0].append(command.current)
    assert min(currents[True]) > 1.5
    assert max(currents[False]) < 0.1


def test_noise_of_a_small_motion_turns_the_current_no_more_often() -> None:
    turned = []
    for noise in (0.0, 20e-6):
        controller = controlled(WHOLE)
        loop = ControlLoop(
            controller,
            EmulatedDamper(WHOLE),
            excitation=SineMotion(0.3e-3, 1.0),
            displacement_noise=noise,
        )
        currents = []
        for block in loop.blocks(6.0):
            angle = 2.0 * math.pi * (block.end_ns - T0) / NANOSECONDS
            controller.want(block.end_ns, 600.0 * math.cos(angle))
            currents.append(controller.command(block).current)
            loop.command(currents[-1])
        steps = np.diff(currents[round(SETTLED / PERIOD / BLOCK) :])
        turned.append(np.count_nonzero(np.diff(np.sign(steps[np.abs(steps) > 1e-3]))))
    assert 0 < turned[1] <= 1.3 * turned[0]


def test_an_old_desired_force_counts_no_more() -> None:
    controller = controlled(WHOLE)
    controller.want(T0, 500.0)
    command = after(controller, demand=None)
    assert command.doubt.kind is DoubtKind.OUTDATED
    assert command.current == 0.0


def test_a_desired_force_that_is_no_number_is_refused() -> None:
    assert "finite" in ForceController(settings()).want(T0, math.nan)


def test_a_set_of_a_single_current_commands_nothing() -> None:
    command = after(controlled(replace(WHOLE, current_range=(0.0, 0.0))))
    assert command.doubt.kind is DoubtKind.OUT_OF_RANGE
    assert "several currents" in command.doubt.sentence


def commands_of(controller: ForceController, damper: Damper, duration: float) -> list[Command]:
    """The commands for a viscous damper in a sine."""
    loop = ControlLoop(controller, damper, excitation=SineMotion(5e-3, 1.0))
    return tracked(loop, 9e3, duration).commands


def test_a_set_for_fewer_currents_takes_no_currents_away() -> None:
    """It did once another set had replaced the given one, and was in use itself."""
    controller = controlled(WHOLE)
    commands_of(controller, EmulatedDamper(WHOLE), 0.5)
    for name, highest in (("window", 2.0), ("global", 0.3)):
        found = replace(WHOLE, set_id=name, origin=Origin.GLOBAL, current_range=(0.0, highest))
        found = replace(found, observable=np.ones(found.values.size, dtype=bool))
        stamp_ns = T0 + (NANOSECONDS if highest < 2.0 else 0)
        controller.predictor.set_parameters(found, stamp_ns)
    commands_of(controller, EmulatedDamper(WHOLE), 4.0)
    assert controller.predictor.parameters is not None
    assert controller.predictor.parameters.set_id == "global"
    assert controller.highest_known == 2.0


def test_control_does_not_start_from_a_safe_current_outside_the_set() -> None:
    """Agreement at the safe current started it, and the current was driven up and fell again."""
    far = replace(WHOLE, current_range=(1.0, 2.0))
    commands = commands_of(controlled(far), EmulatedDamper(WHOLE), 5.0)
    assert {each.current for each in commands} == {0.0}
    assert "crossing_rate" in commands[-1].doubt.sentence


def test_the_unknown_currents_are_crossed_once_at_the_stated_rate() -> None:
    far = replace(WHOLE, current_range=(1.0, 2.0))
    controller = controlled(far, crossing_rate=0.5)
    commands = commands_of(controller, EmulatedDamper(WHOLE), 8.0)
    currents = np.array([each.current for each in commands])
    first = int(np.flatnonzero(currents >= 1.0 - 1e-6)[0])
    assert max(np.diff(currents[:first])) <= 0.5 * BLOCK * PERIOD + 1e-9
    assert min(currents[first:]) >= 1.0 - 1e-6
    assert not commands[-1].doubt


class WeakAbove(EmulatedDamper):
    """Above 0.85 A it has 70 % of the force of its set."""

    def force(self, motion: Any, current: Array, celsius: float, period: float) -> Array:
        part = 1.0 - 0.3 / (1.0 + np.exp(-(current - 0.85) / 0.01))
        return np.asarray(super().force(motion, current, celsius, period) * part)


def test_currents_at_which_the_set_is_wrong_are_excluded_and_the_others_are_not() -> None:
    controller = controlled(replace(WHOLE, current_range=(0.0, 1.6)), highest_current=1.6)
    loop = ControlLoop(controller, WeakAbove(WHOLE), excitation=SineMotion(5e-3, 1.0))
    used, current = 0.0, 0.0
    for block in loop.blocks(8.0):
        if controller.highest_known > 0.9:
            used += (current > 0.85) * BLOCK * PERIOD
        speed = float(np.diff(block.displacement).mean()) / PERIOD
        controller.want(block.end_ns, 40e3 * speed)
        current = controller.command(block).current
        loop.command(current)
    assert 0.75 < controller.highest_known <= 0.9
    assert 0.0 < used < 5.0


class Sticking(EmulatedDamper):
    """It has friction that a current of 0.1 A hides."""

    def force(self, motion: Any, current: Array, celsius: float, period: float) -> Array:
        usual = super().force(motion, current, celsius, period)
        friction = 60.0 * np.exp(-current / 0.05) * np.tanh(motion.velocity / 1e-3)
        return np.asarray(usual + friction)


def test_control_returns_although_the_force_is_wrong_at_the_safe_current() -> None:
    commands = commands_of(controlled(WHOLE), Sticking(WHOLE), 12.0)
    late = commands[len(commands) // 2 :]
    assert np.mean([not each.doubt for each in late]) > 0.9


def test_no_current_beyond_the_identified_ones_is_commanded() -> None:
    command = after(controlled(replace(WHOLE, current_range=(0.0, 0.8))), demand=-1e5)
    currents = {round(command.current, 6)}
    assert not command.doubt
    assert max(currents) <= 0.8


def reached(damper: Damper, duration: float = 12.0, **changes: float) -> tuple[float, bool]:
    """Highest current of a damper identified up to 0.4 A, and whether more was requested."""
    known = replace(WHOLE, current_range=(0.0, 0.4))
    trial = tracked(ControlLoop(controlled(known, **changes), damper), 40e3, duration)
    commands = trial.commands
    return max(each.current for each in commands), any(each.unknown for each in commands)


class Saturated(EmulatedDamper):
    """Its force saturates at 0.4 A, unlike that of its set."""

    def force(self, motion: Any, current: Array, celsius: float, period: float) -> Array:
        return super().force(motion, np.minimum(current, 0.4), celsius, period)


def test_it_probes_higher_currents_step_by_step_while_the_force_is_right() -> None:
    assert 0.8 <= reached(EmulatedDamper(WHOLE), probe_step=0.2)[0] <= 2.0
    # One step is needed to see that the force is wrong.
    assert reached(Saturated(WHOLE), probe_step=0.4)[0] <= 0.81
    # Without probing it only says that unknown currents are needed.
    assert reached(EmulatedDamper(WHOLE), 4.0) == (pytest.approx(0.4), True)


def test_a_coil_that_lags_is_not_hurried_by_currents_beyond_the_identified_ones() -> None:
    """The force would be invalid at such currents, and each rise would end at the safe current."""
    late = replace(lagging_coil("sigmoid_lag", 0.03), current_range=(0.0, 0.4))
    trial = tracked(ControlLoop(controlled(late), EmulatedDamper(late)), 12e3)
    assert max(command.current for command in trial.commands) == 0.4
    begun = trial.commands[round(SETTLED / PERIOD / BLOCK) :]
    assert {command.doubt.kind for command in begun} == {DoubtKind.NONE}


def test_a_prediction_that_the_measured_force_belies_commands_nothing() -> None:
    strong = PLAUSIBLE.copy()
    strong[0] *= 3.0
    controller = controlled(WHOLE)
    command = after(controller, damper=EmulatedDamper(strong))
    assert command.doubt.kind is DoubtKind.WRONG
    assert command.current == 0.0


# -- a short invalid period ------------------------------------------------------------------------

SPAN = 2.0
STEP = 0.01


def currents_of(fallback: Fallback, course: str, wanted: float = 1.0) -> list[float]:
    """Currents [A] of blocks of 10 ms with a valid (.) or invalid (?) force."""
    made = [0.0]
    for each in course:
        if fallback.follow(STEP, doubted=each == "?"):
            made.append(fallback.towards(wanted, STEP))
        else:
            made.append(fallback.away_from(made[-1], STEP))
    return made[1:]


def begun(**changes: Any) -> Fallback:
    """A fallback after a long time with a valid force."""
    fallback = Fallback(FallbackSettings(**changes), SPAN)
    currents_of(fallback, 100 * ".")
    return fallback


def test_a_doubt_of_a_moment_lets_the_current_slide() -> None:
    currents = currents_of(begun(in_doubt="slide", doubt_time=0.4), "." + 30 * "?")
    np.testing.assert_allclose(currents[:11], 1.0 - SPAN * STEP / 0.4 * np.arange(11), atol=1e-9)
    assert currents[-1] == 0.0


def test_a_doubt_that_lasts_takes_the_current_to_the_safe_one_without_a_jump() -> None:
    currents = currents_of(begun(doubt_time=0.1, fade_time=0.2), "." + 40 * "?")
    assert currents[5] == 1.0
    assert currents[-1] == 0.0
    assert max(np.abs(np.diff(currents))) <= SPAN * STEP / 0.2 + 1e-9


def test_no_doubt_drives_the_current_up() -> None:
    rng = np.random.default_rng(0)
    fallback = begun(doubt_time=0.05)
    current = 0.0
    for doubted, wanted in zip(rng.random(2000) < 0.5, rng.uniform(0, 2, 2000), strict=True):
        before = current
        if fallback.follow(STEP, doubted=bool(doubted)):
            current = fallback.towards(wanted, STEP)
        else:
            current = fallback.away_from(before, STEP)
            assert current <= before


def test_control_that_is_lost_again_soon_returns_after_twice_the_time() -> None:
    fallback, waits = begun(doubt_time=0.05), []
    for controlled_before in (0, 0, 0, 60):
        currents_of(fallback, controlled_before * "." + 30 * "?")
        waits.append(1)
        while not fallback.follow(STEP, doubted=False):
            waits[-1] += 1
    assert waits == [5, 10, 20, 5]


def test_what_was_commanded_is_given_up() -> None:
    controller = controlled(WHOLE, safe_current=0.1)
    after(controller)
    assert controller.give_up() == 0.1


def test_the_factor_of_the_feedback_has_limits() -> None:
    feedback = ForceFeedback(FeedbackSettings(feedback_gain=10.0, feedback_limit=0.3))
    for _ in range(100):
        feedback.expect(1000.0)
        feedback.follow(np.array([90.0, 110.0]), 0.1)
    assert feedback.factor == pytest.approx(1.3)
