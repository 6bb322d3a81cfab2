"""Windows with a changing current: split, fitted and learnt from; the lag of the coil."""

from dataclasses import replace

import known
import numpy as np
import pytest

from mr_damper_ros.emulation.emulator import (
    CurrentSchedule,
    EmulatedDamper,
    EmulatedRig,
    RigSettings,
)
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.misfit import Misfit
from mr_damper_ros.models.parameter_set import ParameterSet, start_set
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.acceptance import Verdict, judge_parts
from mr_damper_ros.tracking.operating_point import parts_by_current
from mr_damper_ros.tracking.tracker import TrackerSettings, WindowTracker
from mr_damper_ros.tracking.window_assembler import RawWindow

SAMPLES = 2000
TOLERANCE = 0.05
LAG = 0.012

LAW, SIXTEEN = MODELS["sigmoid_lag"], MODELS["sigmoid"]
LATE = np.append(known.PLAUSIBLE, [3e-8, 1500.0, -40.0, LAG])


def switching(seconds: float = 2.0) -> CurrentSchedule:
    """Current [A] that switches between 0.2 and 1.2 A every 0.4 s."""
    times = np.arange(0.0, seconds, 0.4)
    return CurrentSchedule(times.tolist(), np.where(np.arange(times.size) % 2, 1.2, 0.2).tolist())


def raw(current: CurrentSchedule, *, coil: float = 0.0, number: int = 0) -> RawWindow:
    """A window of a sine, from a stream that begins with it."""
    rig = EmulatedRig(
        EmulatedDamper(known.PLAUSIBLE),
        SineMotion(5e-3, 1.0),
        current,
        settings=RigSettings(seed=number),
        coil_time_constant=coil,
    )
    for _ in range(number):
        rig.next_block(SAMPLES)
    block = rig.next_block(SAMPLES)
    return RawWindow(block.start_ns, block.period, block.displacement, block.force, block.current)


def window(current: CurrentSchedule, **options: float) -> Window:
    given = raw(current, **options)  # type: ignore[arg-type]
    return Window.from_samples(given.displacement, given.force, given.current, given.period)


def test_each_level_of_the_current_is_a_part() -> None:
    parts = parts_by_current(SIXTEEN, window(switching()), TOLERANCE)
    assert [np.unique(part.current).tolist() for part in parts] == [[0.2], [1.2]]
    assert sum(part.sample_count for part in parts) == SAMPLES


def test_a_part_whose_past_is_not_known_is_left_out_of_a_law_that_remembers() -> None:
    early = CurrentSchedule([0.0, 0.3], [1.2, 0.2])
    assert len(parts_by_current(SIXTEEN, window(early), TOLERANCE)) == 2
    assert len(parts_by_current(LAW, window(early), TOLERANCE)) == 1


def test_the_right_law_over_the_current_explains_the_parts_and_a_wrong_one_does_not() -> None:
    given = window(switching())
    parts = parts_by_current(SIXTEEN, given, TOLERANCE)
    assert judge_parts(given, parts, ParameterSet(known.PLAUSIBLE))[1]
    wrong = known.PLAUSIBLE.copy()
    wrong[known.index("k2")] *= 0.7
    assert not judge_parts(given, parts, ParameterSet(wrong))[1]


def followed(windows: list[RawWindow], start: ParameterSet) -> tuple[WindowTracker, list[Verdict]]:
    tracker = WindowTracker(TrackerSettings(model=start.model), start)
    verdicts = []
    for given in windows:
        report = tracker.follow(given)
        verdicts.append(report.verdict)
        if report.global_due:
            tracker.identify()
    return tracker, verdicts


def test_a_window_of_changing_current_is_accepted_where_the_law_is_known() -> None:
    weaker = known.weaker(0.9)
    start = ParameterSet(weaker, observable=np.ones(16, dtype=bool))
    tracker, verdicts = followed([raw(switching())], start)
    assert verdicts == [Verdict.ACCEPTED]
    f0 = tracker.parameters.values[known.index("f0")] / known.PLAUSIBLE[known.index("f0")]
    assert f0 == pytest.approx(1.0, abs=0.01)  # ten times its standard error of 0.1 %


def test_the_dependence_on_the_current_is_learnt_from_one_window_that_switches() -> None:
    tracker, _ = followed([raw(switching())], start_set("sigmoid"))
    assert len(tracker.points.windows) == 2
    law, given = MODELS["sigmoid"], window(switching(), number=1)
    error = law.window_force(given, tracker.parameters.values) - given.force
    assert known.rms(error) < 1.1 * known.NOISE


@pytest.mark.parametrize("model", [LAW, MODELS["bingham"]], ids=lambda model: model.name)
def test_a_stream_and_a_window_have_the_same_coil(model: Model) -> None:
    parameters: Array = (
        LATE
        if model is LAW
        else np.array([500.0, 4000.0, -30.0, *np.zeros(len(model.parameters) - 4), LAG])
    )
    if model is not LAW:
        parameters[model.parameter_names.index("f_y_1")] = 2.0
    given = window(switching())
    state = None
    cut = [slice(0, 700), slice(700, 701), slice(701, 2000)]
    forces = []
    for part in cut:
        m = given.motion
        piece = Motion(*(getattr(m, name)[part] for name in _SERIES), sine=None)
        force, state = model.follow(parameters, piece, given.current[part], given.period, state)
        forces.append(force)
    in_window = model.window_force(given, parameters)
    settled = model.settled(given, parameters)
    streamed = np.concatenate(forces)
    np.testing.assert_allclose(streamed[settled], in_window[settled], rtol=1e-6)


_SERIES = ("displacement", "velocity", "acceleration", "peak_velocity")


def test_the_jacobian_by_the_coil_is_that_of_differences() -> None:
    given = window(switching())
    misfit = Misfit(LAW, parts_by_current(SIXTEEN, given, TOLERANCE), [known.NOISE] * 2)
    step = 1e-4 * np.eye(20)[-1]
    expected = (misfit.residual(LATE + step) - misfit.residual(LATE - step)) / 2e-4
    got = misfit.jacobian(LATE)[:, -1]
    # The central difference has an error of (step / lag)² times the third derivative.
    np.testing.assert_allclose(got, expected, atol=1e-3 * np.abs(expected).max())


def stamped_late(seconds: float) -> RawWindow:
    """A window whose current is stamped late."""
    given = raw(switching())
    places = np.arange(SAMPLES) - round(seconds / given.period)
    return replace(given, current=given.current[places.clip(0)])


def test_a_current_that_is_stamped_late_is_shifted_before_the_window_is_fitted() -> None:
    late, right = (
        WindowTracker(TrackerSettings(method="least_squares")).follow(each)
        for each in (stamped_late(0.03), raw(switching()))
    )
    assert late is not None
    assert right is not None
    assert late.current_lag == pytest.approx(-0.03, abs=3e-3)
    # The current of the last samples is still unknown.
    assert (late.window_start_ns, late.stamp_ns) == (
        right.window_start_ns,
        right.stamp_ns + round(late.current_lag * NANOSECONDS),
    )
    assert "before the stamped current" in late.late_current
    assert not right.late_current


def test_the_lag_of_a_coil_is_left_to_a_law_that_contains_it() -> None:
    for law, applies in (("sigmoid", True), ("sigmoid_lag", False)):
        settings = TrackerSettings(method="least_squares", model=law)
        report = WindowTracker(settings).follow(raw(switching(), coil=LAG))
        assert report is not None
        assert (report.current_lag > 0.0) is applies
