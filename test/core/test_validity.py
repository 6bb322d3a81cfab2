"""Each kind of evidence against a predicted force is detected in time, without false alarms."""

import dataclasses
import functools
import math

import known
import numpy as np
import pytest

from benchmarks.dampers import DAMPERS
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock, joined
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.predictor import ForcePredictor, Prediction, PredictorSettings
from mr_damper_ros.tracking.validity import (
    DoubtKind,
    RefusedWindows,
    ValiditySettings,
    objections_to_current,
    objections_to_motion,
)

PERIOD = 1e-3
RUN = known.run(current=1.0, samples=6000, seed=0)
CHANGE = 4000
"""The sample at which the fault begins."""

SOON = 0.1
"""Seconds in which a completely wrong force must be detected."""

SET = ParameterSet(
    known.PLAUSIBLE, set_id="known", peak_velocity_range=(0.02, 0.05), current_range=(0.5, 1.5)
)


def predicted(
    displacement: Array = RUN.displacement,
    force: Array = RUN.force,
    *,
    size: int = 10,
    parameters: ParameterSet = SET,
    late: float | None = None,
    **settings: float,
) -> list[Prediction]:
    """Predictions of a stream with its current; ``late`` [s] is the age of blocks by the clock."""
    made = ForcePredictor(PredictorSettings(**settings))
    made.set_parameters(parameters)
    result = []
    for block in known.blocks(displacement, force, (size,)):
        made.add_current(block.start_ns, 1.0)
        now_ns = None if late is None else block.end_ns + round(late * NANOSECONDS)
        result.append(made.predict(block, now_ns))
        made.catch_up()
    return result


def kinds(predictions: list[Prediction], first: int, last: int | None = None) -> set[DoubtKind]:
    """Reason codes of the blocks within these samples."""
    size = predictions[0].force.size
    return {p.doubt.kind for p in predictions[first // size : last and last // size]}


def seconds_until_doubt(predictions: list[Prediction]) -> float:
    """Time from the change to the first invalid block; all later blocks must be invalid too."""
    size = predictions[0].force.size
    after = [bool(p.doubt) for p in predictions[CHANGE // size :]]
    assert all(after[after.index(True) :])
    return after.index(True) * size * PERIOD


def spoilt(values: Array, spoil: Array | float) -> Array:
    """The same values up to the change, then other ones."""
    result = values.copy()
    result[CHANGE:] = spoil
    return result


# -- the measured force ----------------------------------------------------------------------


@pytest.mark.parametrize("size", [1, 10, 100, 1000])
def test_a_right_force_stays_valid(size: int) -> None:
    force = RUN.force[:4000]
    assert kinds(predicted(RUN.displacement[:4000], force, size=size), 3000) == {DoubtKind.NONE}


@pytest.mark.parametrize(("factor", "valid"), [(1e-3, False), (1e-2, True)])
def test_a_load_cell_in_kilonewtons_makes_no_force_valid(factor: float, valid: bool) -> None:
    """A damper of less than 5 N is none; one of a table top is."""
    values = known.PLAUSIBLE * np.where(np.arange(16) == known.index("f0"), factor, 1.0)
    small = dataclasses.replace(SET, values=values)
    predictions = predicted(force=factor * RUN.force, parameters=small)
    assert (kinds(predictions, 3000) == {DoubtKind.NONE}) is valid
    if not valid:
        assert kinds(predictions, 3000) == {DoubtKind.SENSOR}
        assert "kilonewtons" in predictions[-1].reason


@pytest.mark.parametrize("factor", [1000.0, 10.0, 0.1, 0.001, -1.0])
def test_a_force_far_from_the_measured_one_is_not_valid(factor: float) -> None:
    predictions = predicted(force=spoilt(RUN.force, factor * RUN.force[CHANGE:]))
    # A wrong factor is visible once the force has left zero.
    assert seconds_until_doubt(predictions) <= SOON


def test_each_sample_is_judged_by_itself() -> None:
    force = RUN.force.copy()
    off = slice(5020, 5030)
    force[off] += 0.3 * np.ptp(force)
    block = predicted(force=force, size=100)[50]
    assert (block.doubts[20:30] == DoubtKind.WRONG).all()
    assert block.valid_samples[:20].all()
    assert block.valid_samples[60:].all()
    assert (block.valid, block.doubt.kind, block.newest_doubt.kind) == (
        False,
        DoubtKind.WRONG,
        DoubtKind.NONE,
    )


def test_the_valid_share_of_a_stream_does_not_depend_on_its_blocks() -> None:
    """The force is wrong at the ends of each half-cycle."""
    size = np.abs(RUN.force)
    force = np.where(size > np.quantile(size, 0.9), 1.3 * RUN.force, RUN.force)
    shares = [
        np.mean(np.concatenate([p.valid_samples for p in predicted(force=force, size=size)]))
        for size in (1, 10, 100)
    ]
    assert 0.3 < min(shares) < 0.9
    assert max(shares) - min(shares) < 0.02


def test_a_measured_force_of_a_cycle_makes_other_currents_valid() -> None:
    elsewhere = dataclasses.replace(SET, current_range=(0.2, 0.5))
    for maximum_error, kind in ((0.0, DoubtKind.OUT_OF_RANGE), (0.2, DoubtKind.NONE)):
        predictions = predicted(parameters=elsewhere, maximum_error=maximum_error)
        assert kinds(predictions, 4000) == {kind}


def spiked(size: float) -> Array:
    """The force with outliers of this size [N] in the second before the change."""
    force = RUN.force.copy()
    force[CHANGE - 900 : CHANGE - 100 : 200] += size
    return force


@pytest.mark.parametrize("size", [3000.0, -20_000.0])
def test_a_wild_sample_of_the_load_cell_is_told_and_spoils_no_other(size: float) -> None:
    predictions = predicted(force=spiked(size))[(CHANGE - 1000) // 10 : (CHANGE + 500) // 10]
    doubts = np.concatenate([p.doubts for p in predictions])
    assert np.flatnonzero(doubts).tolist() == [100, 300, 500, 700]
    assert set(doubts[doubts > 0]) == {DoubtKind.SENSOR}
    assert "the measured force jumps to" in predictions[10].reason


@pytest.mark.parametrize("size", [3000.0, 20_000.0])
def test_wild_samples_in_a_slow_motion_hide_no_loss_of_force(size: float) -> None:
    """The peak of a 20 s cycle would retain them for a long time."""
    run = known.run(amplitude=0.01, frequency=0.05, samples=30_000)
    wild, lost = slice(23_000, 24_000, 200), 24_500
    force = run.force.copy()
    force[wild] += size
    force[lost:] *= 0.3
    slow = dataclasses.replace(SET, peak_velocity_range=(0.0, 1.0))
    predictions = predicted(run.displacement, force, size=100, parameters=slow)
    valid = np.concatenate([p.valid_samples for p in predictions])
    assert valid[22_000:23_000].all(), "before them the force is valid"
    assert not valid[lost + 500 :].any()


def test_a_measured_force_that_drives_the_motion_is_told() -> None:
    predictions = predicted(force=spoilt(RUN.force, -RUN.force[CHANGE:]))
    assert predictions[-1].doubt.kind is DoubtKind.SENSOR
    assert "has the sign" in predictions[-1].reason


def test_parameters_whose_force_drives_the_motion_are_told_without_a_load_cell() -> None:
    reversed_sign = known.PLAUSIBLE.copy()
    reversed_sign[known.index("f0")] *= -1.0
    parameters = dataclasses.replace(SET, values=reversed_sign)
    predictions = predicted(force=np.zeros(6000), parameters=parameters, maximum_error=0.0)
    assert kinds(predictions, 3000) == {DoubtKind.DRIVING}


# -- magnitude and range ---------------------------------------------------------------------


@pytest.mark.parametrize(("factor", "kind"), [(1.0, DoubtKind.NONE), (2.0, DoubtKind.TOO_LARGE)])
def test_a_force_beyond_what_was_measured_is_not_valid(factor: float, kind: DoubtKind) -> None:
    limited = dataclasses.replace(SET, largest_force=float(np.abs(RUN.clean).max()) / factor)
    predictions = predicted(parameters=limited, maximum_error=0.0)
    assert kind in kinds(predictions, 4000)
    assert kinds(predictions, 4000) <= {DoubtKind.NONE, kind}


def test_a_motion_beyond_the_identified_one_is_not_valid_until_the_force_was_right() -> None:
    slower = dataclasses.replace(SET, peak_velocity_range=(0.02, 0.03))
    for maximum_error, kind in ((0.0, DoubtKind.OUT_OF_RANGE), (0.2, DoubtKind.NONE)):
        predictions = predicted(
            parameters=slower, velocity_margin=0.01, maximum_error=maximum_error
        )
        assert kinds(predictions, 4000) == {kind}


@pytest.mark.parametrize(
    ("known", "current", "speed", "outside"),
    [
        ((0.5, 1.5), (0.41, 1.59), 0.03, (False, False)),
        ((0.5, 1.5), (0.39, 1.0), 0.03, (True, False)),
        ((0.5, 1.5), (1.0, 1.61), 0.03, (True, False)),
        # A set for a single current holds within the resolution of a supply.
        ((1.0, 1.0), (0.985, 1.015), 0.016, (False, False)),
        ((1.0, 1.0), (0.975, 1.0), 0.062, (True, False)),
        ((0.5, 1.5), (1.0, 1.0), 0.0149, (False, True)),
        ((0.5, 1.5), (1.0, 1.0), 0.0626, (False, True)),
    ],
)
def test_current_and_peak_velocity_have_margins_at_both_ends(
    known: tuple[float, float],
    current: tuple[float, float],
    speed: float,
    outside: tuple[bool, bool],
) -> None:
    parameters = dataclasses.replace(SET, current_range=known)
    given = ValiditySettings()
    of_current = objections_to_current(parameters, given.current_margin, np.array(current))
    of_motion = objections_to_motion(parameters, given, speed, np.zeros(2))
    assert (any(of_current), any(of_motion)) == outside


# -- sets for other motions ------------------------------------------------------------------


STAIR = 6000


def stair(law: ParameterSet) -> tuple[Array, Array]:
    """Displacement and force at 1 Hz and 1 A, with 5 mm and from sample STAIR on 1 mm."""
    time = np.arange(2 * STAIR) * PERIOD
    amplitude = np.interp(time, (STAIR * PERIOD, STAIR * PERIOD + 0.1), (5e-3, 1e-3))
    u = amplitude * np.sin(2.0 * np.pi * time)
    window = Window.from_samples(u, np.arange(time.size), 1.0, PERIOD)
    return u, law.law.window_force(window, law.values)


@functools.cache
def sets_of_stair(law: ParameterSet) -> list[ParameterSet]:
    """Results of a sixteen-parameter fit to each amplitude alone."""
    u, force = stair(law)
    found = []
    parts = {"large": slice(1000, 5000), "small": slice(8000, 12_000)}
    for age, (name, part) in zip((2, 1), parts.items(), strict=True):
        window = Window.from_samples(u[part], force[part], 1.0, PERIOD)
        fit = fit_window(MODELS["sigmoid"], window, known.PLAUSIBLE, method="least_squares")
        speed = fit.operating_point[0]
        found.append(
            dataclasses.replace(
                SET,
                values=fit.parameters,
                set_id=name,
                peak_velocity_range=(speed, speed),
                stamp_ns=known.T0 - age * NANOSECONDS,
            )
        )
    return found


def predicted_of_stair(law: ParameterSet, *sets: ParameterSet) -> list[Prediction]:
    """Predictions with these sets, added one after the other before the stream begins."""
    made = ForcePredictor(PredictorSettings())
    for each in sets:
        made.set_parameters(each, each.stamp_ns or None)
    results = []
    for block in known.blocks(*stair(law), (20,)):
        made.add_current(block.start_ns, 1.0)
        results.append(made.predict(block))
        made.catch_up()
    return results


BOUC_WEN = DAMPERS["modified_bouc_wen"]


def test_where_a_motion_comes_back_its_set_is_used_at_once() -> None:
    large, small = sets_of_stair(BOUC_WEN)
    predictions = predicted_of_stair(BOUC_WEN, large, small)
    used = {(p.set_id, p.valid) for p in predictions[4000 // 20 : STAIR // 20]}
    assert used == {("large", True)}
    # The machine takes a tenth of a second to change its amplitude.
    after = predictions[(STAIR + 500) // 20 :]
    assert {p.set_id for p in after} == {"small"}
    # The error of the sixteen-parameter law for this damper at 1 mm is nearly a tenth of the force.
    assert np.mean([p.valid for p in after]) > 0.9


def test_a_force_that_jumps_where_the_motion_turns_is_followed() -> None:
    """At the slow motion of 1 mm the force of this model jumps, unlike that of a real damper."""
    damper = DAMPERS["viscous_tanh"]
    _, small = sets_of_stair(damper)
    predictions = predicted_of_stair(damper, small)
    assert np.mean([p.valid for p in predictions[(STAIR + 2000) // 20 :]]) > 0.8


# -- age -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("late", "kind"),
    [
        (0.4, DoubtKind.NONE),
        (0.6, DoubtKind.OUTDATED),
        (-0.6, DoubtKind.OUTDATED),
        (3600.0, DoubtKind.NONE),
    ],
)
def test_samples_of_a_running_machine_have_an_age(late: float, kind: DoubtKind) -> None:
    """A live stream cannot be an hour old: such stamps indicate a recording."""
    assert kinds(predicted(late=late), 3000) == {kind}


def current_of(blocks: list[SampleBlock], ahead: float, *, live: bool) -> list[Prediction]:
    """Predictions with stamps of the current that jump ahead [s] at the change."""
    made = ForcePredictor(PredictorSettings())
    made.set_parameters(SET)
    result = []
    for number, block in enumerate(blocks):
        jump = ahead if number * 10 >= CHANGE else 0.0
        if number % 10 == 0:
            made.add_current(block.start_ns + round(jump * NANOSECONDS), 1.0)
        result.append(made.predict(block, block.end_ns if live else None))
    return result


@pytest.mark.parametrize("live", [True, False])
def test_a_current_whose_stamps_jump_ahead_is_unknown_at_once(live: bool) -> None:
    blocks = known.blocks(RUN.displacement, RUN.force, (10,))
    predictions = current_of(blocks, 5.0, live=live)
    assert kinds(predictions, 3000, CHANGE) == {DoubtKind.NONE}
    assert kinds(predictions, CHANGE) == {DoubtKind.OUTDATED}


# -- the identifier's verdict ----------------------------------------------------------------


def verdicts(*reports: tuple[Verdict, float]) -> DoubtKind:
    watch = RefusedWindows()
    for verdict, nrmse_before in reports:
        watch.follow(verdict, nrmse_before, "", confirms=verdict is Verdict.NO_BETTER)
    return DoubtKind.REFUSED if watch.sentence else DoubtKind.NONE


FAULT, CONFIRMED = (Verdict.FAULT_OF_DATA, math.nan), (Verdict.NO_BETTER, 0.1)


@pytest.mark.parametrize(
    ("reports", "kind"),
    [
        ([FAULT], DoubtKind.NONE),
        ([FAULT, FAULT], DoubtKind.REFUSED),
        ([FAULT, FAULT, CONFIRMED], DoubtKind.NONE),
        ([FAULT, CONFIRMED, FAULT], DoubtKind.NONE),
        ([(Verdict.DISTURBED, 0.5), (Verdict.UNCONFIRMED, 0.6)], DoubtKind.REFUSED),
        ([(Verdict.BEYOND_LIMITS, 9.0)] * 2, DoubtKind.REFUSED),
        ([(Verdict.DISTURBED, 0.2), (Verdict.DISTURBED, 0.2)], DoubtKind.NONE),
        ([(Verdict.FAILED, math.nan)] * 3, DoubtKind.NONE),
        ([FAULT, (Verdict.FAILED, math.nan), FAULT], DoubtKind.REFUSED),
    ],
)
def test_windows_refused_in_a_row_speak_against_the_force(
    reports: list[tuple[Verdict, float]], kind: DoubtKind
) -> None:
    assert verdicts(*reports) is kind


def test_a_step_of_the_load_cell_makes_the_force_invalid_until_it_is_back() -> None:
    """Also where the predicted force agrees with the measured one, as after a small tare."""
    made = ForcePredictor(PredictorSettings())
    made.set_parameters(SET)
    results = []
    verdicts = {300: Verdict.INSTRUMENT, 350: Verdict.TOO_LITTLE_MOTION, 400: Verdict.NO_BETTER}
    for number, block in enumerate(known.blocks(RUN.displacement, RUN.force, (10,))):
        made.add_current(block.start_ns, 1.0)
        if (verdict := verdicts.get(number)) is not None:
            report = known.report("any", known.T0, known.T0, verdict=verdict)
            made.follow_report(dataclasses.replace(report, reason="a step"))
        results.append(made.predict(block).doubt)
    assert {(each.kind, each.sentence) for each in results[300:400]} == {
        (DoubtKind.INSTRUMENT, "a step")
    }
    assert not any(results[250:300] + results[400:])


def test_without_a_load_cell_a_refusal_is_believed_until_other_parameters_come() -> None:
    made = ForcePredictor(PredictorSettings(maximum_error=0.0))
    made.set_parameters(SET)
    made.add_current(known.T0, 1.0)
    results = []
    for number, block in enumerate(known.blocks(RUN.displacement, RUN.force, (10,))):
        made.add_current(block.start_ns, 1.0)
        if number in (400, 450):
            fault = Verdict.FAULT_OF_DATA
            made.follow_report(known.report("any", known.T0, known.T0, verdict=fault))
        if number == 500:
            made.set_parameters(SET)
        results.append(made.predict(block).doubt.kind)
    assert set(results[300:450]) == {DoubtKind.NONE}
    assert set(results[450:500]) == {DoubtKind.REFUSED}
    assert set(results[520:]) == {DoubtKind.NONE}


# -- delayed blocks --------------------------------------------------------------------------


def test_a_load_cell_that_is_not_connected_makes_nothing_valid() -> None:
    assert DoubtKind.NONE not in kinds(predicted(force=np.zeros(6000)), 0)


def test_blocks_that_follow_each_other_are_joined() -> None:
    blocks = known.blocks(RUN.displacement[:100], RUN.force[:100], (10,))
    first, second = joined([*blocks[:4], *blocks[6:]])
    assert (first.sequence, second.sequence) == (0, 60)
    assert (first.start_ns, second.start_ns) == (blocks[0].start_ns, blocks[6].start_ns)
    np.testing.assert_array_equal(first.displacement, RUN.displacement[:40])
    np.testing.assert_array_equal(second.force, RUN.force[60:100])


def test_a_displacement_that_sticks_is_frozen() -> None:
    stuck = float(RUN.displacement[CHANGE])
    predictions = predicted(spoilt(RUN.displacement, stuck))
    assert seconds_until_doubt(predictions) <= 2.0 * SOON
    assert kinds(predictions, 5000) == {DoubtKind.FROZEN}
