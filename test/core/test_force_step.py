"""A step of the load cell is told from a change of the damper, and nothing is learnt from it."""

import dataclasses
import math
from collections.abc import Callable

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.acceptance import AcceptanceSettings, Verdict
from mr_damper_ros.tracking.force_step import Compared, ForceStep, find_step, is_back
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.tracker import TrackerSettings, WindowTracker
from mr_damper_ros.tracking.tracker_state import from_text, to_text

PEAK, NOISE = 700.0, 5.0
SECONDS = 2.0


def compared(
    change: Callable[[Array, Array], Array],
    *,
    frequency: float = 1.0,
    rate: float = 1000.0,
    current: float | Array = 1.0,
    misfit: float = 0.05,
    seed: int = 0,
) -> Compared:
    """Two seconds of a damper with friction, whose force ``change`` gives from time and force.

    The set predicts another shape: ``misfit`` of the peak stays unexplained.
    """
    time = np.arange(round(SECONDS * rate)) / rate
    phase = 2.0 * np.pi * frequency * time
    predicted = PEAK * np.tanh(8.0 * np.cos(phase))
    true = predicted + misfit * PEAK * np.sin(phase)
    noise = NOISE * np.random.default_rng(seed).standard_normal(time.size)
    held = np.broadcast_to(np.asarray(current, dtype=np.float64), time.shape)
    return Compared(predicted, change(time, true) + noise, held, 1.0 / rate)


def stepped(factor: float = 1.0, offset: float = 0.0, at: float = 1.0) -> Callable[..., Array]:
    """A load cell that changes at a time [s]."""
    return lambda time, force: np.where(time < at - 1e-9, force, factor * force + offset)


def faded(factor: float, at: float = 1.0, lasts: float = 0.1) -> Callable[..., Array]:
    """A damper that loses force within ``lasts`` [s]."""
    return lambda time, force: force * np.interp(time, (at, at + lasts), (1.0, factor))


def lagged(factor: float, at: float, coil: float) -> Callable[..., Array]:
    """A damper whose coil, with this time constant [s], changes the force by a factor."""

    def change(time: Array, force: Array) -> Array:
        since = np.maximum(time - at, 0.0)
        return force * (factor + (1.0 - factor) * np.exp(-since / coil))

    return change


@known.fixed(40)
@given(
    factor=st.sampled_from([0.1, 0.5, 0.7, 1.5, 2.0, 10.0]),
    at=st.floats(0.4, 1.2),
    frequency=st.sampled_from([1.0, 2.0, 5.0]),
    rate=st.sampled_from([500.0, 1000.0, 2000.0]),
    seed=st.integers(0, 100),
)
def test_a_factor_within_one_sample_is_found(
    factor: float, at: float, frequency: float, rate: float, seed: int
) -> None:
    if abs(math.cos(2.0 * math.pi * frequency * at)) < 0.3:
        # The force is near zero, and shows no factor.
        at += 0.25 / frequency
    found = find_step(compared(stepped(factor, at=at), frequency=frequency, rate=rate, seed=seed))
    assert found is not None
    assert found.place == pytest.approx(at * rate, abs=1.0)
    assert found.factor == pytest.approx(factor, rel=0.1)
    assert found.offset == 0.0


@known.fixed(40)
@given(
    offset=st.sampled_from([-2000.0, -150.0, 150.0, 300.0]),
    at=st.floats(0.5, 1.2),
    rate=st.sampled_from([200.0, 1000.0, 2000.0]),
    seed=st.integers(0, 100),
)
def test_an_offset_within_one_sample_is_found(
    offset: float, at: float, rate: float, seed: int
) -> None:
    found = find_step(compared(stepped(offset=offset, at=at), rate=rate, seed=seed))
    # Where the force reverses within two samples, the jump does not stand apart from it.
    if found is None:
        assert abs(math.cos(2.0 * math.pi * at)) < 0.2
        return
    assert (found.factor, found.offset) == (1.0, pytest.approx(offset, abs=20.0))


@known.fixed(60)
@given(
    factor=st.floats(0.0, 3.0),
    at=st.floats(0.3, 1.7),
    frequency=st.sampled_from([0.7, 1.0, 2.0, 5.0]),
    rate=st.sampled_from([100.0, 200.0, 500.0, 1000.0, 2000.0]),
    coil=st.sampled_from([None, 5e-3, 8e-3, 20e-3]),
    seed=st.integers(0, 100),
)
def test_a_change_of_the_damper_is_no_step(
    factor: float, at: float, frequency: float, rate: float, coil: float | None, seed: int
) -> None:
    """A lost seal takes 0.1 s, and an open coil its time constant."""
    change = faded(factor, at) if coil is None else lagged(factor, at, coil)
    found = find_step(compared(change, frequency=frequency, rate=rate, seed=seed))
    assert found is None or found.factor is None


@pytest.mark.parametrize(("late", "found"), [(0.0, False), (0.03, False), (0.5, True)])
def test_a_current_that_changes_near_by_excuses_a_jump(late: float, found: bool) -> None:
    current = np.where(np.arange(2000) < 1000 * (1.0 + late), 1.0, 0.2)
    assert (find_step(compared(stepped(0.5), current=current)) is not None) is found


def test_until_the_motion_reverses_the_step_is_neither_factor_nor_offset() -> None:
    force = compared(stepped(0.5, at=1.05))
    early = Compared(*(each[:1150] for each in force[:3]), force.period)
    found = find_step(early)
    assert found is not None
    assert (found.place, found.factor) == (1050, None)


@pytest.mark.parametrize("width", [1, 5, 40])
def test_a_burst_is_no_step(width: int) -> None:
    burst = compared(lambda t, f: f + np.where((t >= 1.0) & (t < 1.0 + 1e-3 * width), 5e3, 0.0))
    assert find_step(burst) is None


def test_without_a_good_set_nothing_is_named() -> None:
    assert find_step(compared(stepped(0.5), misfit=1.0)) is None


@pytest.mark.parametrize("step", [ForceStep(0, factor=0.5), ForceStep(0, offset=150.0)])
def test_a_load_cell_that_shows_the_force_of_the_set_again_is_back(step: ForceStep) -> None:
    still = compared(stepped(step.factor, step.offset, at=0.0))
    assert not is_back(step, still)
    assert is_back(step, compared(stepped()))


# -- the tracker -----------------------------------------------------------------------------


SAMPLES = 2000


def tracked(**acceptance: bool) -> WindowTracker:
    """A tracker that has accepted three windows of a sound load cell."""
    settings = TrackerSettings(
        method="least_squares", global_period=0, acceptance=AcceptanceSettings(**acceptance)
    )
    made = WindowTracker(settings, ParameterSet(known.PLAUSIBLE, set_id="start"))
    reports = followed(made, 0, 3)
    assert {each.verdict for each in reports} <= {Verdict.ACCEPTED, Verdict.NO_BETTER}
    return made


def followed(
    made: WindowTracker, first: int, last: int, factor: float = 1.0, since: int = 0
) -> list[Report]:
    """Reports on windows of the known damper, with a load cell that changes within the first."""
    reports = []
    for number in range(first, last):
        run = known.run(current=1.0, samples=SAMPLES, start=2.0 * number, seed=number)
        force = run.force.copy()
        force[since if number == first else 0 :] *= factor
        changed = dataclasses.replace(run, force=force)
        raw = dataclasses.replace(
            known.raw_window(changed), start_ns=known.T0 + number * SAMPLES * 1_000_000
        )
        report = made.follow(raw)
        assert report is not None
        reports.append(report)
    return reports


SINCE = 1100
"""A sample at which the force of the known damper is large."""


def test_a_step_is_named_and_the_sets_are_kept_until_the_load_cell_is_back() -> None:
    made = tracked()
    before = made.parameters
    reports = followed(made, 3, 8, factor=0.5, since=SINCE)
    assert {each.verdict for each in reports} == {Verdict.INSTRUMENT}
    assert "changed by a factor of 0.5" in reports[0].reason
    assert made.parameters is before
    back, *later = followed(made, 8, 11)
    assert back.verdict is Verdict.NO_BETTER
    assert "again" in back.reason
    assert all(each.verdict.confirms for each in later)
    assert made.memory.step is None


def test_after_a_restart_the_question_stands_again() -> None:
    made = tracked()
    followed(made, 3, 5, factor=0.5, since=SINCE)
    again = tracked()
    again.resume(made.parameters, from_text(to_text(made.memory), made.parameters.law))
    assert again.memory.step == made.memory.step is not None
    (report,) = followed(again, 5, 6, factor=0.5)
    assert report.verdict is Verdict.INSTRUMENT


def test_an_acknowledged_step_is_learnt() -> None:
    made = tracked()
    assert made.acknowledge() == ""
    followed(made, 3, 5, factor=0.6, since=SINCE)
    assert "factor of 0.6" in made.acknowledge()
    reports = followed(made, 5, 9, factor=0.6)
    assert Verdict.ACCEPTED in {each.verdict for each in reports}
    assert reports[-1].nrmse_before < 0.1


def test_an_option_takes_a_step_for_a_change_of_the_damper() -> None:
    made = tracked(accept_force_steps=True)
    reports = followed(made, 3, 7, factor=0.6, since=SINCE)
    assert Verdict.INSTRUMENT not in {each.verdict for each in reports}
    assert reports[-1].nrmse_before < 0.1
