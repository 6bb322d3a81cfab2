"""After a current step, the set of that current counts instead of the latest window's."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import known
import numpy as np
import pytest

from benchmarks.dampers import DAMPERS
from mr_damper_ros.emulation.emulator import CurrentSchedule, EmulatedDamper, EmulatedRig
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.models.domain import Origin
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.sigmoid.law import operating_point_coefficients
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.model_bank import force_ratio
from mr_damper_ros.tracking.predictor import ForcePredictor, Prediction, PredictorSettings
from mr_damper_ros.tracking.validity import DoubtKind

LOW, HIGH = 0.4, 1.2
"""Currents [A] before and after the step."""

STEP, END = 6.0, 7.0
"""[s]: time of the step, and end of the evaluated force."""

STRONGER = 1.2
"""Force of the damper relative to that of the set for all currents."""

NEAR = 0.05
"""NRMSE: errors of the observer at reversals, the coil lag and the factor."""

SIGMOID = replace(ParameterSet(known.PLAUSIBLE), set_id="sigmoid")
TANH = DAMPERS["viscous_tanh"]
LAWS = [pytest.param(SIGMOID, id="sigmoid"), pytest.param(TANH, id="viscous tanh")]


def with_values(parameters: ParameterSet, **factors: float) -> ParameterSet:
    """A set with these parameters multiplied by factors."""
    values = parameters.values.copy()
    for name, factor in factors.items():
        values[parameters.law.places((name,))] *= factor
    return replace(parameters, values=values)


def stronger(parameters: ParameterSet, factor: float = STRONGER) -> ParameterSet:
    """The same damper with more force."""
    values = parameters.values.copy()
    values[parameters.law.strength_indices] *= factor
    return replace(parameters, values=values)


def whole_of(damper: ParameterSet) -> ParameterSet:
    """The set for all currents."""
    return replace(
        damper,
        observable=np.ones(damper.values.size, dtype=bool),
        set_id="whole",
        origin=Origin.GLOBAL,
        peak_velocity_range=(0.02, 0.05),
        current_range=(0.2, 1.4),
        stamp_ns=known.T0,
    )


def window_of(damper: ParameterSet, current: float, set_id: str) -> ParameterSet:
    """A set that is right at one current [A] and poorly determined at the others."""
    if damper.model == "sigmoid":
        found = with_values(damper, k2=0.3)
        right, wrong = (
            operating_point_coefficients(each.values, 0.0314, current)[0]
            for each in (damper, found)
        )
        found = with_values(found, f0=right / wrong)
    else:
        found = with_values(damper, c_1=0.0, alpha_1=0.3, alpha_2=0.3)
        names = damper.law.parameter_names
        of = dict(zip(names, damper.values, strict=True))
        slope, bend = of["alpha_1"] * current, of["alpha_2"] * current**2
        alpha = (1.0 + slope + bend) / (1.0 + 0.3 * (slope + bend))
        found = with_values(found, c=1.0 + of["c_1"] * current / of["c"], alpha=alpha)
    return replace(whole_of(found), set_id=set_id, origin=Origin.WINDOW)


def poor(damper: ParameterSet) -> ParameterSet:
    """A set for all currents that is right at :data:`LOW` only."""
    return replace(window_of(damper, LOW, "whole"), origin=Origin.GLOBAL)


class Said(NamedTuple):
    """A set that arrives at ``time`` [s], ``late`` [s] after its window of ``length`` [s].

    ``reported``: whether its report arrives too.
    """

    time: float
    parameters: ParameterSet
    length: float = 0.8
    late: float = 0.0
    reported: bool = True


class Course(NamedTuple):
    """Predictions of each block, and the true force of the damper (n,) [N]."""

    predictions: list[Prediction]
    force: Array

    def nrmse(self, begin: float = STEP, end: float = END) -> float:
        """NRMSE between two times [s]."""
        predicted = np.concatenate([each.force for each in self.predictions])
        part = slice(round(begin / known.PERIOD), round(end / known.PERIOD))
        return float(known.rms((predicted - self.force)[part]) / np.std(self.force[part]))

    def set_at(self, time: float) -> str:
        """Name of the set in use at a time [s]."""
        return self.predictions[round(time / (20 * known.PERIOD))].set_id


def course(
    said: Sequence[Said],
    damper: ParameterSet = SIGMOID,
    *,
    whole: ParameterSet | None = None,
    currents: CurrentSchedule | None = None,
    from_file: bool = False,
    **settings: float,
) -> Course:
    """A sine of 5 mm at 1 Hz, predicted with the set for all currents, then with those in ``said``.

    ``from_file``: the former is from a file, so that it does not age.
    """
    schedule = currents or CurrentSchedule([0.0, STEP], [LOW, HIGH])
    rig = EmulatedRig(EmulatedDamper(damper), SineMotion(5e-3, 1.0), schedule)
    made = ForcePredictor(PredictorSettings(**settings))
    first = whole or whole_of(SIGMOID)
    made.set_parameters(first, None if from_file else rig.settings.start_ns)
    waiting, predictions, forces = list(said), [], []
    for _ in range(round(END / (20 * known.PERIOD))):
        block = rig.next_block(20)
        while waiting and block.start_ns >= stamp(rig, waiting[0].time):
            one = waiting.pop(0)
            end_ns = stamp(rig, one.time - one.late)
            begin_ns = end_ns - round(one.length * NANOSECONDS)
            if one.reported:
                made.follow_report(known.confirmation(one.parameters.set_id, begin_ns, end_ns))
            made.set_parameters(one.parameters, end_ns)
        made.add_current(block.start_ns, float(block.current[0]))
        predictions.append(made.predict(block.samples))
        made.catch_up()
        forces.append(block.force)
    return Course(predictions, np.concatenate(forces))


def stamp(rig: EmulatedRig, time: float) -> int:
    return rig.settings.start_ns + round(time * NANOSECONDS)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("maximum_error", [0.2, 0.0])
def test_after_a_step_the_set_for_all_counts_with_the_force_of_now(
    law: ParameterSet, maximum_error: float
) -> None:
    damper = stronger(law)
    said = [Said(5.0, window_of(damper, LOW, "low"))]
    came = course(said, damper, whole=whole_of(law), maximum_error=maximum_error)
    assert came.set_at(5.5) == "low"
    assert came.set_at(END - 0.1).startswith("whole x 1.")
    assert came.nrmse() < NEAR


@pytest.mark.parametrize("law", LAWS)
def test_a_set_found_lately_at_this_current_comes_first(law: ParameterSet) -> None:
    said = [Said(3.9, window_of(law, HIGH, "high")), Said(5.0, window_of(law, LOW, "low"))]
    currents = CurrentSchedule([0.0, 2.0, 4.0, STEP], [LOW, HIGH, LOW, HIGH])
    came = course(said, law, whole=poor(law), currents=currents)
    assert came.set_at(5.5) != "high"
    assert came.set_at(END - 0.1) == "high"
    assert came.nrmse() < NEAR


def test_a_set_of_a_window_before_the_step_does_not_come_after_it() -> None:
    low = window_of(SIGMOID, LOW, "low")
    came = course([Said(5.0, low), Said(6.3, replace(low, set_id="late"), late=0.4)])
    assert came.set_at(END - 0.1).startswith("whole")


@pytest.mark.parametrize("length", [0.3, 1.0])
def test_a_set_of_this_current_too_takes_over_where_it_gives_the_force_better(
    length: float,
) -> None:
    said = [Said(5.0, window_of(SIGMOID, LOW, "low"))]
    for factor, in_use in ((1.0, "new"), (0.5, "whole")):
        new = stronger(window_of(SIGMOID, HIGH, "new"), factor)
        came = course([*said, Said(6.4, new, length)], whole=poor(SIGMOID))
        assert came.set_at(END - 0.1).startswith(in_use)


@pytest.mark.parametrize(
    ("maximum_error", "kind"), [(0.2, DoubtKind.NONE), (0.0, DoubtKind.OUT_OF_RANGE)]
)
def test_where_nothing_is_known_of_a_current_only_the_measured_force_vouches_for_the_present_set(
    maximum_error: float, kind: DoubtKind
) -> None:
    low = window_of(SIGMOID, LOW, "low")
    known_low = replace(whole_of(SIGMOID), current_range=(0.3, 0.5))
    came = course(
        [Said(5.0, replace(low, current_range=(0.3, 0.5)))],
        whole=known_low,
        maximum_error=maximum_error,
    )
    assert came.set_at(END - 0.1) == "low"
    assert came.predictions[-1].doubt.kind is kind


def test_a_wrong_set_for_all_is_not_called_valid() -> None:
    wrong = with_values(poor(SIGMOID), k2=-1.0)
    came = course([Said(5.0, window_of(SIGMOID, LOW, "low"))], whole=wrong)
    assert came.set_at(END - 0.1).startswith("whole")
    # NRMSE: smaller than that of a set for another current.
    assert came.nrmse() > 0.1
    assert came.predictions[-1].doubt.kind.grave


def test_a_factor_is_believed_in_as_far_as_it_stands_out() -> None:
    whole = np.sin(np.linspace(0.0, 20.0, 1000))
    assert force_ratio(1.3 * whole, whole) == pytest.approx(1.3)
    rest = 0.3 * np.sign(np.cos(np.linspace(0.0, 20.0, 1000)))
    assert 1.0 < force_ratio(1.05 * whole + rest, whole) < 1.01
    assert force_ratio(-whole, whole) == 1.0
    assert force_ratio(whole, 0.0 * whole) == 1.0
