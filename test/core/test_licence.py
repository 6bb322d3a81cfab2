"""The licence to act: which currents may be commanded, and how control returns."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from known import PLAUSIBLE

from mr_damper_ros.control.force_controller import Fallback, FallbackSettings
from mr_damper_ros.control.licence import (
    ABOUT_THE_FORCE,
    PROBED_PART,
    Approach,
    Licence,
    Limits,
    Permit,
    permit_of,
)
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.tracking.candidate_sets import CandidateSet
from mr_damper_ros.tracking.validity import NO_DOUBT, Doubt, DoubtKind, ErrorLimit

STEP = 0.01
LIMIT = 0.2
LIMITS = Limits(0.0, 1.6, 0.0)
WIDE = ParameterSet(
    PLAUSIBLE, set_id="wide", peak_velocity_range=(0.0, 1.0), current_range=(0.0, 1.6)
)
NARROW = replace(WIDE, set_id="narrow", current_range=(0.0, 0.4))

FORCE = 1000.0
"""Force [N] of the damper in these tests, at all currents."""


def candidate(parameters: ParameterSet = WIDE, largest_error: float = math.inf) -> CandidateSet:
    """A set in a motion in which its force is some hundred newtons."""
    made = CandidateSet(parameters, ErrorLimit(LIMIT, largest_error))
    still = np.zeros(1)
    motion = Motion(still, np.full(1, 0.03), still, np.full(1, 0.03), sine=None)
    made.follow(motion, still, STEP, 0.5, gradual=True)
    return made


def seen(made: CandidateSet, current: float, error: float, time: float = 1.0) -> None:
    """Evidence at a current [A]: a relative error for a time [s]."""
    count = round(time / STEP)
    made.evidence.add(
        np.full(count, current),
        np.full(count, error * FORCE),
        np.full(count, FORCE),
        STEP,
        peak=FORCE,
        half_cycle=0.5,
    )


def small_error(made: CandidateSet) -> float:
    """A relative error at the safe current that is small relative to the force of a probe."""
    return 0.5 * made.tolerated_at(PROBED_PART * 1.6) / FORCE


def wrong_when_off() -> Permit:
    """The permit of a set that is wrong at the safe current by a small force."""
    made = candidate()
    seen(made, 0.0, small_error(made))
    return permit_of(made, LIMITS)


def chosen(*candidates: CandidateSet) -> Permit:
    licence = Licence(LIMITS, 0.1)
    licence.choose([*candidates])
    assert licence.permit is not None
    return licence.permit


# -- which set, and which currents -----------------------------------------------------------------


def test_the_widest_set_is_inverted() -> None:
    permit = chosen(candidate(WIDE), candidate(NARROW))
    assert permit.candidate.parameters is WIDE
    assert (permit.low, permit.high) == (0.0, 1.6)


def test_a_set_that_holds_at_the_safe_current_goes_before_a_wider_one_that_does_not() -> None:
    far = replace(WIDE, current_range=(0.8, 1.6))
    near = candidate(NARROW)
    assert chosen(candidate(far), near).candidate is near


def test_currents_at_which_the_set_is_wrong_are_excluded_with_those_behind_them() -> None:
    wide = candidate()
    for current in (0.3, 0.6, 1.4):
        seen(wide, current, 0.05)
    seen(wide, 1.0, 0.3)
    assert chosen(wide).high == pytest.approx(0.95)


def test_a_short_error_excludes_nothing() -> None:
    wide = candidate()
    seen(wide, 1.0, 0.5, time=0.1)
    assert chosen(wide).high == 1.6


def test_a_refuted_set_gives_way_to_a_narrower_one() -> None:
    wide, narrow = candidate(), candidate(NARROW)
    seen(wide, 0.2, 0.5)
    assert chosen(wide, narrow).candidate is narrow


def test_evidence_outside_the_range_of_a_set_says_nothing_about_it() -> None:
    narrow = candidate(NARROW)
    seen(narrow, 1.0, 5.0)
    assert chosen(narrow).high == 0.4


def test_evidence_expires() -> None:
    wide = candidate()
    seen(wide, 1.0, 0.5)
    seen(wide, 0.2, 0.0, time=70.0)
    assert chosen(wide).high == 1.6


def test_of_two_equal_sets_the_better_one_is_inverted_and_the_first_one_kept() -> None:
    first, second, third = candidate(), candidate(), candidate()
    licence = Licence(LIMITS, 0.1)
    seen(first, 0.5, 0.1)
    seen(second, 0.5, 0.09)
    licence.choose([first])
    licence.choose([first, second])
    assert licence.permit is not None
    assert licence.permit.candidate is first
    seen(third, 0.5, 0.05)
    licence.choose([first, second, third])
    assert licence.permit.candidate is third


def test_without_a_load_cell_the_set_in_use_is_inverted_in_its_whole_range() -> None:
    """No evidence decides between sets for the same currents, nor takes currents away."""
    licence, given, found = Licence(LIMITS, 0.1), candidate(), candidate()
    licence.choose([given])
    licence.choose([given, found])
    assert licence.permit is not None
    assert licence.permit.candidate is found
    licence.choose([given, candidate(NARROW)])
    assert licence.permit.candidate is given


errors = st.lists(
    st.tuples(st.floats(0.0, 1.6), st.floats(0.0, 0.6), st.floats(0.05, 2.0)), max_size=12
)


@settings(max_examples=100, deadline=None)
@given(errors)
def test_the_range_shrinks_by_evidence_against_the_widest_set_alone(
    evidence: list[tuple[float, float, float]],
) -> None:
    """Narrower sets that arrive, and right forces, never shrink it; wrong forces do."""
    wide, licence = candidate(), Licence(LIMITS, 0.1)
    for current, error, time in evidence:
        seen(wide, current, error, time)
        alone = permit_of(wide, LIMITS)
        licence.choose([wide, candidate(NARROW)])
        assert licence.permit is not None
        assert licence.permit.width >= alone.width
        refuted = [cell for cell in wide.evidence.cells if cell.refuted and cell.low > 0.0]
        assert alone.high == 1.6 or alone.high in [cell.low for cell in refuted]
        untolerated = [c.low for c in refuted if not c.high <= PROBED_PART * 1.6]
        assert alone.high <= min(untolerated, default=1.6)


# -- whether control is permitted now --------------------------------------------------------------


def judged(doubt: DoubtKind, current: float = 0.0, *, in_control: bool = True) -> DoubtKind:
    licence = Licence(LIMITS, 0.1)
    licence.choose([candidate(replace(WIDE, current_range=(0.0, 1.0)))])
    given = NO_DOUBT if doubt is DoubtKind.NONE else Doubt(doubt, "said")
    return licence.judge(given, current, in_use=True, in_control=in_control).kind


@pytest.mark.parametrize("kind", [*DoubtKind])
def test_every_reason_of_the_set_in_use_forbids_control(kind: DoubtKind) -> None:
    assert judged(kind) is kind


def test_agreement_at_a_current_outside_the_set_permits_nothing() -> None:
    assert judged(DoubtKind.NONE, 1.3) is DoubtKind.OUT_OF_RANGE


def test_a_set_that_holds_permits_control_whatever_is_said_of_the_set_in_use() -> None:
    licence, wide = Licence(LIMITS, 0.1), candidate()
    licence.choose([wide])
    for kind in DoubtKind:
        wide.holds = True
        given = Doubt(kind, "said")
        made = licence.judge(given, 0.0, in_use=False, in_control=False)
        assert made.kind is (DoubtKind.NONE if kind in ABOUT_THE_FORCE else kind)


def test_a_wrong_force_near_the_safe_current_is_tolerated_where_the_set_is_right_behind_it() -> (
    None
):
    wide, licence = candidate(), Licence(LIMITS, 0.1)
    seen(wide, 0.5, 0.02)
    seen(wide, 0.0, small_error(wide))
    licence.choose([wide])
    wrong = Doubt(DoubtKind.WRONG, "said")
    assert not licence.judge(wrong, 0.0, in_use=True, in_control=True)
    # Control that was lost returns only with a right force.
    assert licence.judge(wrong, 0.0, in_use=True, in_control=False)
    assert licence.judge(wrong, 0.5, in_use=True, in_control=True)


# -- the return ------------------------------------------------------------------------------------

kinds = st.sampled_from([*DoubtKind])


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(kinds, st.integers(1, 60), st.floats(0.0, 1.6)), max_size=30))
def test_no_doubt_raises_the_current(course: list[tuple[DoubtKind, int, float]]) -> None:
    """Except a probe: a wrong force at the safe current, slowly and by a quarter of the range."""
    permit = wrong_when_off()
    fallback, approach, current = Fallback(FallbackSettings(), 1.6), Approach(0.0), 0.0
    for kind, count, wanted in course:
        doubt = NO_DOUBT if kind is DoubtKind.NONE else Doubt(kind, "said")
        for _ in range(count):
            before = current
            if fallback.follow(STEP, doubted=bool(doubt)):
                approach.succeed()
                current = fallback.towards(wanted, STEP)
                continue
            step = 0.0
            if fallback.lasts and (approach.under_way or current == 0.0):
                step = approach.follow(doubt, permit, current, STEP)
            if approach.under_way:
                current = fallback.approaching(current, approach.target, step)
            else:
                current = fallback.away_from(current, STEP)
            if current > before:
                assert doubt.kind is DoubtKind.WRONG
                assert current <= PROBED_PART * 1.6
                assert current - before <= STEP * PROBED_PART * 1.6 / 2.5 + 1e-12


@settings(max_examples=200, deadline=None)
@given(st.lists(st.booleans(), max_size=400))
def test_control_returns_after_any_transient_fault(course: list[bool]) -> None:
    """Within three seconds of valid force, whatever the doubts were before."""
    fallback = Fallback(FallbackSettings(), 1.6)
    for doubted in course:
        fallback.follow(STEP, doubted=doubted)
    for _ in range(300):
        fallback.follow(STEP, doubted=False)
    assert not fallback.lasts


def test_a_probe_that_finds_no_right_force_ends_at_a_quarter_of_the_range_and_waits() -> None:
    permit, approach, current, course = wrong_when_off(), Approach(0.0), 0.0, []
    wrong = Doubt(DoubtKind.WRONG, "said")
    for _ in range(1000):
        step = approach.follow(wrong, permit, current, STEP)
        current = min(current + step, approach.target) if approach.under_way else 0.0
        course.append(current)
    assert max(course) == pytest.approx(PROBED_PART * 1.6)
    starts = np.count_nonzero(np.diff(np.array(course) > 0.0) > 0)
    assert starts == 2, "one rise and one fall in ten seconds"


def test_unknown_currents_are_crossed_at_the_stated_rate_and_not_without_it() -> None:
    far = replace(WIDE, current_range=(1.0, 1.6))
    permit, outside = permit_of(candidate(far), LIMITS), Doubt(DoubtKind.OUT_OF_RANGE, "said")
    for rate in (0.0, 0.5):
        approach, current = Approach(rate), 0.0
        for _ in range(150):
            step = approach.follow(outside, permit, current, STEP)
            assert step <= rate * STEP
            current += step
        assert current == pytest.approx(min(1.0, 1.5 * rate))
        assert math.isnan(approach.target) is (rate == 0.0)


@pytest.mark.parametrize(("largest_error", "high"), [(math.inf, 1.6), (50.0, 0.75)])
def test_a_limit_in_newtons_limits_the_range_too(largest_error: float, high: float) -> None:
    made = candidate(largest_error=largest_error)
    seen(made, 0.8, 0.5 * LIMIT)
    assert permit_of(made, LIMITS).high == pytest.approx(high)
