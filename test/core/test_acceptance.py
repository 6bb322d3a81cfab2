"""Bad windows are rejected with a reason, and good ones are accepted."""

import dataclasses
import math
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from mr_damper_ros.tracking.acceptance import (
    ACCEPTED,
    AcceptanceSettings,
    Evidence,
    Gatekeeper,
    Judgement,
    Verdict,
)
from mr_damper_ros.tracking.operating_point import KnownForce

ROOT = Path(__file__).resolve().parents[2]

SPREAD = 500.0
"""Standard deviation of the force [N] in the evidence below."""


def evidence(before: float, after: float, change: float = 0.0) -> Evidence:
    """Evidence from the RMSE [N] of the running and of the new set on the validation samples."""
    return Evidence(before / SPREAD, after / SPREAD, after, change)


def new() -> Gatekeeper:
    """An acceptance test without history."""
    return Gatekeeper(AcceptanceSettings(maximum_nrmse=0.3))


OTHER_SHAPE = Evidence(0.45, 0.01, 5.0, -0.1, shape_change=0.4)


def experienced(residual: float = 5.0, **settings: float) -> Gatekeeper:
    """An acceptance test after five normal windows."""
    gatekeeper = Gatekeeper(AcceptanceSettings(**settings))
    for _ in range(5):
        assert gatekeeper.judge(evidence(2.0 * residual, residual)) == ACCEPTED
    return gatekeeper


def test_the_message_has_the_same_verdicts() -> None:
    text = (ROOT / "msg_defs" / "msg" / "FitReport.msg").read_text(encoding="utf-8")
    constants = re.findall(r"^uint8 ([A-Z_]+) = (\d+)", text, re.MULTILINE)
    assert {name: int(value) for name, value in constants} == dict(Verdict.__members__)


@pytest.mark.parametrize(
    ("judged", "verdict", "part"),
    [
        (
            lambda: new().judge(evidence(5.0, 5.0)),
            Verdict.NO_BETTER,
            "running set predicts the validation samples as well",
        ),
        (lambda: new().judge(evidence(500.0, 0.31 * SPREAD)), Verdict.POOR_FIT, "31%"),
        (lambda: new().judge(Evidence(1.0, math.nan, 5.0, 0.0)), Verdict.POOR_FIT, "not finite"),
        (lambda: new().judge(Evidence(1.0, math.inf, 5.0, 0.0)), Verdict.POOR_FIT, "not finite"),
        (lambda: new().judge_global(Evidence(0.9, 0.4)), Verdict.POOR_FIT, "maximum_nrmse (30%)"),
        (lambda: new().judge_global(Evidence(0.9, math.nan)), Verdict.POOR_FIT, "maximum_nrmse"),
        (lambda: new().judge_global(Evidence(0.1, 0.1)), Verdict.NO_BETTER, ""),
        (lambda: new().judge_global(Evidence(0.2, 0.1)), Verdict.ACCEPTED, ""),
        (
            lambda: experienced().judge(evidence(100.0, 20.0)),
            Verdict.DISTURBED,
            "4.0 times the residual baseline",
        ),
        (
            lambda: experienced().judge(evidence(400.0, 5.0, change=-0.7)),
            Verdict.UNCONFIRMED,
            "changed by -70% at once: waiting for the next window",
        ),
        (
            lambda: experienced().judge(OTHER_SHAPE, force(), holds=True),
            Verdict.UNCONFIRMED,
            "at once: waiting",
        ),
        (lambda: experienced().judge(OTHER_SHAPE, force(), holds=False), Verdict.ACCEPTED, ""),
    ],
)
def test_a_window_is_judged_with_its_reason(
    judged: Callable[[], Judgement], verdict: Verdict, part: str
) -> None:
    found = judged()
    assert found.verdict is verdict
    assert part in found.sentence


def test_a_sensor_that_stays_noisy_is_believed_in_the_end() -> None:
    gatekeeper = experienced()
    verdicts = [gatekeeper.judge(evidence(100.0, 20.0)).verdict for _ in range(6)]
    assert verdicts == [Verdict.DISTURBED] * 4 + [Verdict.ACCEPTED] * 2


def test_a_set_that_fits_is_confirmed_by_an_unusual_window_that_teaches_nothing() -> None:
    gatekeeper = experienced(5.0)
    before = gatekeeper.known.residuals
    found = gatekeeper.judge(evidence(0.14 * SPREAD, 0.13 * SPREAD))
    assert found.verdict is Verdict.NO_BETTER
    assert "13.0 times the residual baseline: the running set stays in use" in found.sentence
    assert not found.teaches
    assert gatekeeper.known.residuals == before


# -- limits on change ------------------------------------------------------------------------


def force(factor: float = 1.0, speed: float = 0.03, current: float = 1.0) -> KnownForce:
    """The initial force envelope at 0.03 m/s and 1 A, times ``factor``."""
    return KnownForce(speed, current, factor * SPREAD, factor * 1.6 * SPREAD)


def used_to(*known: KnownForce, **settings: float) -> Gatekeeper:
    """An acceptance test that has accepted these forces."""
    gatekeeper = Gatekeeper(AcceptanceSettings(**settings))
    for each in known or (force(),):
        assert gatekeeper.judge(evidence(10.0, 5.0), each) == ACCEPTED
    return gatekeeper


@pytest.mark.parametrize("factor", [1000.0, 10.0, 3.5, 0.3, 0.1, 1e-3])
def test_a_force_beyond_the_limit_is_not_taken_by_repetition(factor: float) -> None:
    gatekeeper = used_to()
    for _ in range(20):
        judgement = gatekeeper.judge(evidence(400.0, 5.0, factor - 1.0), force(factor))
        assert judgement.verdict is Verdict.BEYOND_LIMITS
    assert "more than change_limit (3) allows" in judgement.sentence
    assert "call reset" in judgement.sentence


def test_a_force_does_not_creep_beyond_the_limit() -> None:
    gatekeeper, factor = used_to(), 1.0
    while gatekeeper.judge(evidence(60.0, 5.0, 0.1), force(1.1 * factor)) == ACCEPTED:
        factor *= 1.1
    assert 3.0 / 1.1 < factor <= 3.0


@pytest.mark.parametrize(
    ("factor", "speed", "current"),
    [(0.1, 0.03, 0.0), (8.0, 0.03, 2.0), (4.0, 0.12, 1.0), (0.3, 0.003, 1.0), (1.5, 0.3, 1.0)],
)
def test_another_operating_point_may_have_another_force(
    factor: float, speed: float, current: float
) -> None:
    found = used_to().judge(evidence(10.0, 5.0), force(factor, speed, current))
    assert found == ACCEPTED


@pytest.mark.parametrize(
    ("factor", "speed", "current"), [(1000.0, 0.03, 2.0), (1e-3, 0.03, 0.0), (10.0, 0.015, 1.0)]
)
def test_another_operating_point_does_not_explain_any_force(
    factor: float, speed: float, current: float
) -> None:
    found = used_to().judge(evidence(10.0, 5.0), force(factor, speed, current))
    assert found.verdict is Verdict.BEYOND_LIMITS


def test_a_rig_that_became_noisier_is_believed_later_where_the_set_holds() -> None:
    gatekeeper = experienced(25.0)
    noisy = evidence(100.5, 100.0, change=0.01)
    verdicts = [gatekeeper.judge(noisy, force(), holds=True).verdict for _ in range(14)]
    assert verdicts == [Verdict.DISTURBED] * 12 + [Verdict.ACCEPTED] * 2


def test_a_loop_that_is_another_at_once_is_not_taken_by_repetition() -> None:
    gatekeeper = used_to()
    late = Evidence(0.63, 0.01, 5.0, -0.2, shape_change=0.6)
    for _ in range(20):
        found = gatekeeper.judge(late, force(), holds=True, same_motion=True)
        assert found.verdict is Verdict.BEYOND_LIMITS
    found = gatekeeper.judge(late, force(), holds=True, same_motion=False)
    assert found.verdict is Verdict.UNCONFIRMED


def test_one_set_for_all_waits_where_the_running_set_is_good_and_nobody_asked() -> None:
    gatekeeper = Gatekeeper(AcceptanceSettings())
    good, poor = (Evidence(0.2, 0.1, recent=(before, 0.1)) for before in (0.2, 0.4))
    for each in (good, dataclasses.replace(poor, newest=0.1)):
        assert gatekeeper.judge_global(each, tentative=True).verdict is Verdict.UNCONFIRMED
    assert gatekeeper.judge_global(good) == ACCEPTED
    assert gatekeeper.judge_global(poor, tentative=True) == ACCEPTED


def test_one_set_for_all_that_is_worse_where_the_damper_is_now_is_refused() -> None:
    gatekeeper = Gatekeeper(AcceptanceSettings())
    assert gatekeeper.judge_global(Evidence(0.2, 0.1, recent=(0.05, 0.07))) == ACCEPTED
    assert (
        gatekeeper.judge_global(Evidence(0.2, 0.1, recent=(0.05, 0.11))).verdict
        is Verdict.NO_BETTER
    )


def test_a_force_that_is_known_where_the_motion_has_come_back_to_needs_no_confirmation() -> None:
    gatekeeper = used_to(force(), force(0.3, speed=0.006))
    # The running set belongs to the other motion: half of its force is no change here.
    judgement = gatekeeper.judge(evidence(400.0, 5.0, -0.7), force(0.31, speed=0.006))
    assert judgement == ACCEPTED
    # Nor is the loss of force that the first motion has already shown.
    for before, after in ((1.0, 0.6), (0.6, 0.4)):
        weaker = evidence(60.0, 5.0, after / before - 1.0)
        assert gatekeeper.judge(weaker, force(after)) == ACCEPTED
    judgement = gatekeeper.judge(evidence(400.0, 5.0, -0.7), force(0.12, speed=0.006))
    assert judgement == ACCEPTED


# -- residual baseline of an operating point --------------------------------------------------


def test_what_a_law_leaves_at_another_operating_point_is_no_disturbance() -> None:
    gatekeeper = used_to()
    small = evidence(100.0, 0.12 * SPREAD)
    assert gatekeeper.judge(small, force(speed=0.006)) == ACCEPTED
    assert gatekeeper.judge(small, force()).verdict is Verdict.DISTURBED


def test_a_window_of_several_currents_is_no_new_operating_point() -> None:
    small = evidence(100.0, 0.12 * SPREAD)
    found = used_to().judge(small, force(current=1.25), one_point=False)
    assert found.verdict is Verdict.DISTURBED


def test_a_set_that_nobody_could_use_is_refused() -> None:
    gatekeeper = Gatekeeper(AcceptanceSettings())
    judgement = gatekeeper.judge(evidence(20.0, 5.0), objection=lambda: "no damper gives 1e9 N")
    assert judgement == Judgement(Verdict.POOR_FIT, "no damper gives 1e9 N")
    assert gatekeeper.judge(evidence(5.0, 5.0), objection=lambda: "no").verdict.confirms
    sudden = evidence(400.0, 5.0, change=0.8)
    assert experienced().judge(sudden).verdict is Verdict.UNCONFIRMED
    found = experienced().judge(sudden, objection=lambda: "no damper gives 1e9 N")
    assert found.verdict is Verdict.POOR_FIT
    found = gatekeeper.judge_global(Evidence(0.2, 0.1), objection=lambda: "no damper gives 1e9 N")
    assert found.verdict is Verdict.POOR_FIT


@pytest.mark.parametrize(
    ("loss", "verdict"), [(0.5, Verdict.ACCEPTED), (2.0, Verdict.NO_BETTER)], ids=["little", "much"]
)
def test_a_set_may_lose_no_more_elsewhere_than_it_gains_here(loss: float, verdict: Verdict) -> None:
    here = dataclasses.replace(evidence(50.0, 20.0), loss=loss)
    assert Gatekeeper(AcceptanceSettings()).judge(here).verdict is verdict


@pytest.mark.parametrize("after", [0.4, math.inf, math.nan])
def test_one_set_for_all_that_explains_too_little_is_refused(after: float) -> None:
    gatekeeper = Gatekeeper(AcceptanceSettings(maximum_nrmse=0.3))
    judgement = gatekeeper.judge_global(Evidence(0.9, after))
    assert judgement.verdict is Verdict.POOR_FIT
    assert "more than maximum_nrmse (30%)" in judgement.sentence
