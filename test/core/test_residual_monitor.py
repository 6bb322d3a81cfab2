"""Detection of a wrong force from the load cell's noise and the latest peak."""

import math

import numpy as np
import pytest

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.residual_monitor import ForceStatistics, ResidualMonitor
from mr_damper_ros.tracking.validity import DoubtKind, ErrorLimit

PERIOD = 1e-3
PEAK = 1000.0


def watch_of(noise: float, largest_error: float = math.inf) -> tuple[ResidualMonitor, Array]:
    """A monitor that has followed a sine force for some time, and the next samples."""
    watch = ResidualMonitor(PERIOD, ErrorLimit(0.2, largest_error))
    angle = 2.0 * np.pi * PERIOD * np.arange(3000)
    force = PEAK * np.sin(angle) + noise * np.random.default_rng(0).standard_normal(angle.size)
    for part in np.split(force, 300):
        watch.judge(part, part)
        watch.adapt(0.5)
        along = (part, part), part / PEAK, np.ones(part.size), 0.5
        watch.recent.add(*along, steady=True, largest=lambda: PEAK)
    return watch, force[:10]


@pytest.mark.parametrize(("error", "valid"), [(0.19, True), (0.21, False)])
def test_without_noise_the_limit_is_that_of_the_error_itself(error: float, valid: bool) -> None:
    watch, force = watch_of(0.0)
    off = np.where(np.arange(force.size) == 4, error * PEAK, 0.0)
    assert any(watch.judge(force + off, force)) is not valid
    assert 0.19 * PEAK < watch.allowed < 0.21 * PEAK
    assert ResidualMonitor(PERIOD, ErrorLimit(0.2)).allowed == math.inf, "no force was measured"


@pytest.mark.parametrize(
    ("largest_error", "allowed"), [(math.inf, 200.0), (50.0, 50.0), (1000.0, 200.0)]
)
def test_the_smaller_of_a_relative_and_an_absolute_limit_counts(
    largest_error: float, allowed: float
) -> None:
    watch, force = watch_of(0.0, largest_error)
    assert watch.allowed == pytest.approx(allowed, rel=0.03)
    at_peak = np.full(force.size, 0.9 * allowed)
    assert watch.judge(force + at_peak, force) == []
    for _ in range(100):
        found = watch.judge(force + 1.2 * allowed, force)
    assert found is not None
    assert [each.kind for each in found] == [DoubtKind.WRONG]


def test_a_load_cell_that_dies_while_the_force_is_wrong_ends_nothing() -> None:
    watch, force = watch_of(0.0, 100.0)
    for _ in range(100):
        watch.judge(force + PEAK, force)
    dead = np.zeros(10)
    for _ in range(2000):
        watch.recent.add((dead, dead), dead, dead, 0.5, steady=False, largest=lambda: PEAK)
    assert (watch.recent.peak, watch.is_wrong) == (0.0, True)
    assert "right again below 18%" in watch.doubt.sentence
    watch.forget_error()
    assert watch.is_wrong


def test_much_noise_alone_is_no_wrong_force() -> None:
    noise = 0.04 * PEAK
    watch, force = watch_of(noise)
    beyond = np.where(np.arange(force.size) == 4, 4.0 * noise, 0.0)
    assert not any(watch.judge(force, force + beyond))


@pytest.mark.parametrize(("noise", "refused"), [(0.0, 0.5), (0.04, 0.95)])
def test_where_the_force_is_wrong_half_of_the_time_only_noise_makes_the_rest_invalid(
    noise: float, refused: float
) -> None:
    watch, _ = watch_of(noise * PEAK)
    rng = np.random.default_rng(1)
    force = PEAK * np.sin(2.0 * np.pi * PERIOD * np.arange(4000))
    wrong = np.arange(4000) % 200 < 100
    measured = force + noise * PEAK * rng.standard_normal(4000)
    invalid = np.zeros(4000, dtype=bool)
    for part in np.split(np.arange(4000), 400):
        off = np.where(wrong[part], 0.5 * PEAK, 0.1 * PEAK)
        for each in watch.judge(force[part] + off, measured[part]) or []:
            invalid[part] |= each.where
    late = slice(1000, None)
    assert watch.is_wrong
    assert invalid[late][wrong[late]].all()
    assert np.mean(invalid[late]) == pytest.approx(refused, abs=0.1)


def test_after_a_wrong_stretch_the_force_is_valid_only_once_the_error_has_stayed_small() -> None:
    watch, _ = watch_of(0.0)
    force = PEAK * np.sin(2.0 * np.pi * PERIOD * np.arange(400))
    off = np.where(np.arange(400) < 40, 0.5 * PEAK, 0.0)
    off[60:100:10] = 0.19 * PEAK  # below the limit, but the margin is too small
    wrong = np.array(
        [any(watch.judge(force[k : k + 1] + off[k], force[k : k + 1])) for k in range(400)]
    )
    assert wrong[:45].all()
    assert not wrong[150:].any()
    assert np.count_nonzero(np.diff(wrong.astype(int))) == 1, "once valid, it stays valid"


@pytest.mark.parametrize(("known", "valid"), [(math.nan, False), (0.01 * PEAK, True)])
def test_new_parameters_after_wrong_ones_prove_right_first_unless_their_error_is_known(
    known: float, valid: bool
) -> None:
    watch, _ = watch_of(0.0)
    force = PEAK * np.sin(2.0 * np.pi * PERIOD * np.arange(500))
    for part in np.split(force, 50):
        watch.judge(part + 0.5 * PEAK, part)
    watch.forget_error(known)
    assert any(watch.judge(force[:10], force[:10])) is not valid
    for part in np.split(force, 50):
        rules = watch.judge(part, part)
    assert rules == []


def test_a_force_that_drives_the_motion_is_no_objection_to_the_next_set() -> None:
    watch, _ = watch_of(0.0)
    parts = np.split(PEAK * np.sin(2.0 * np.pi * PERIOD * np.arange(3000)), 300)
    for sign, drives in ((-1.0, True), (1.0, False)):
        for part in parts if drives else parts[:20]:
            along = (sign * part, part), part / PEAK, np.ones(part.size), 0.5
            watch.recent.add(*along, steady=True, largest=lambda: PEAK)
        assert watch.recent.predicted_drives is drives
        watch.forget_error()


# -- the peak to which errors are relative ---------------------------------------------------------


HALF_CYCLE = 0.1
LARGE, SMALL = 700.0, 300.0


@pytest.mark.parametrize(("steady", "peak"), [(True, SMALL), (False, LARGE)])
def test_small_half_cycles_are_no_smaller_peak_unless_the_motion_is_steady(
    steady: bool, peak: float
) -> None:
    recent = ForceStatistics(PERIOD)
    for size, seconds in ((LARGE, 2), (SMALL, 4)):
        time = PERIOD * np.arange(seconds * 1000)
        force = size * np.sign(np.cos(np.pi * time / HALF_CYCLE))
        for part in np.split(force, seconds * 10):
            along = (part, part), part / LARGE, np.ones(part.size), HALF_CYCLE
            recent.add(*along, steady=steady, largest=lambda: LARGE)
    assert recent.peak == pytest.approx(peak)


@pytest.mark.parametrize("half_cycle", [HALF_CYCLE, 2.5])
def test_a_large_force_is_forgotten_in_any_motion(half_cycle: float) -> None:
    recent = ForceStatistics(PERIOD)
    for size, seconds in ((LARGE, 2), (SMALL, 11)):
        for part in np.split(size * np.tile((1.0, -1.0), 500 * seconds), seconds * 10):
            along = (part, part), part / LARGE, np.ones(part.size), half_cycle
            recent.add(*along, steady=False, largest=lambda: LARGE)
    assert recent.peak == pytest.approx(SMALL)


def followed(
    force: Array, current: Array, half_cycle: float, largest: float = math.inf
) -> ForceStatistics:
    """Force statistics after a force [N] at a current [A], each of shape (n,).

    ``largest`` [N] is the largest force of the set at the present current.
    """
    recent = ForceStatistics(PERIOD)
    for part in np.split(np.arange(force.size), force.size // 10):
        forces = force[part], force[part]
        recent.add(
            forces, force[part], current[part], half_cycle, steady=True, largest=lambda: largest
        )
    return recent


@pytest.mark.parametrize("width", [5, 20, 40])
def test_a_burst_hardly_raises_the_peak(width: int) -> None:
    time = np.arange(8000)
    force = LARGE * np.sin(np.pi * PERIOD / HALF_CYCLE * time)
    shown = force + np.where(time % 3300 < width, 5000.0, 0.0)
    peak = followed(shown[:7000], np.ones(7000), HALF_CYCLE).peak
    assert LARGE < 1.02 * peak < 2.1 * LARGE


def test_some_wild_samples_are_no_peak() -> None:
    force = LARGE * np.sin(np.pi * PERIOD / HALF_CYCLE * np.arange(4000))
    force[[1500, 2000, 2001, 2002]] = 20_000.0
    recent = followed(force, np.ones(4000), HALF_CYCLE)
    assert recent.peak == pytest.approx(LARGE, rel=0.02)
    assert recent.centre == pytest.approx(0.0, abs=0.02 * LARGE)


@pytest.mark.parametrize(
    ("since", "largest", "peak"),
    [
        (9.0, math.inf, LARGE),
        (11.0, math.inf, SMALL),
        # In slow motion it counts up to the largest force of the set at the present current.
        (2.0, 2.0 * SMALL, 2.0 * SMALL),
        (2.0, 0.1 * SMALL, SMALL),
    ],
)
def test_the_force_at_another_current_counts_for_ten_seconds(
    since: float, largest: float, peak: float
) -> None:
    time = PERIOD * np.arange(round((20.0 + since) / PERIOD))
    current = np.where(time < 20.0, 1.5, 0.0)
    force = np.where(time < 20.0, LARGE, SMALL) * np.sin(2.0 * np.pi * time)
    assert followed(force, current, 10.0, largest).peak == pytest.approx(peak, rel=0.02)
