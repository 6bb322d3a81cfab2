"""A trial of a stream: it is right about a healthy damper and notices a wrong force."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks import faults
from benchmarks.fault_scenarios import Scenario
from benchmarks.other_dampers import DAMPERS
from benchmarks.stream_trial import StreamTrial, TrialResult, TrialSettings
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.signals.recording import DEFAULT_START_NS
from mr_damper_ros.tracking.tracker import TrackerSettings
from mr_damper_ros.tracking.validity import DoubtKind

QUICK = TrialSettings(block_size=50, tracker=TrackerSettings(method="least_squares"))
DAMPER = "viscous_tanh"


def trial(settings: TrialSettings = QUICK) -> StreamTrial:
    return StreamTrial(DAMPERS[DAMPER], SineMotion(0.005, 1.0), 1.5, settings=settings)


@cache
def healthy_trial() -> StreamTrial:
    """Six seconds in which the damper is identified."""
    base = trial()
    base.advance(6.0)
    return base


def made_up(valid: np.ndarray, error: np.ndarray) -> TrialResult:
    """A result of 1 kHz whose true force is a sine of 100 N, with this error [N]."""
    result = healthy_trial().result()
    count = valid.size
    true = 100.0 * np.sin(2.0 * np.pi * np.arange(count) / 1000.0)
    cut = {name: getattr(result, name)[:count] for name in ("time", "current", "measured")}
    doubts = np.where(valid, DoubtKind.NONE, DoubtKind.WRONG)
    return replace(result, **cut, true=true, predicted=true + error, doubts=doubts)


def test_a_healthy_damper_is_identified_and_predicted() -> None:
    result = healthy_trial().result()
    assert result.error[result.time > 5.0].max() < 0.1


def test_a_branch_without_faults_goes_on_as_the_trial() -> None:
    branch = healthy_trial().branch()
    np.testing.assert_array_equal(branch.run(1.0).predicted, trial().run(7.0).predicted)


def test_a_set_counts_only_after_its_delay() -> None:
    first = healthy_trial().result().sets[1]
    late = (first.time * 1e9 - (first.parameters.stamp_ns - DEFAULT_START_NS)) * 1e-9
    # A window waits for the next reading of the supply, a tenth of a second, and for a block.
    assert QUICK.delay - 1e-6 <= late <= QUICK.delay + 0.1 + 2.0 * 0.05


def test_the_longest_wrong_stretch_is_found() -> None:
    error = np.zeros(3000)
    error[1500:1800], error[2500:2600] = 50.0, 50.0
    stretch = made_up(np.ones(3000, dtype=bool), error).wrong_valid()
    assert (stretch.longest, stretch.total) == pytest.approx((0.3, 0.4))


def test_a_force_that_swings_through_the_right_one_is_wrong_all_along() -> None:
    swinging = 100.0 * np.sin(2.0 * np.pi * np.arange(3000) / 100.0)
    stretch = made_up(np.ones(3000, dtype=bool), swinging).wrong_valid(since=1.0)
    assert stretch.longest == pytest.approx(2.0, abs=0.02)  # to a part of a swing


def test_a_set_that_is_worse_is_seen() -> None:
    result = healthy_trial().result()
    good = result.sets[-1].parameters
    doubled = replace(good, values=good.values * np.where(np.arange(16) == 0, 2.0, 1.0))
    after = [*result.sets, result.sets[-1]._replace(time=5.0, parameters=doubled)]
    assert len(list(faults.bad_sets(replace(result, sets=after), 4.5))) == 1


def test_a_repair_is_seen() -> None:
    error = np.zeros(6000)
    error[2000:4000] = 90.0
    result = made_up(np.ones(6000, dtype=bool), error)
    assert faults.good_since(result, 1.0) == pytest.approx(4.0)


@cache
def outcome(text: str) -> faults.Outcome:
    """What comes of a fault of two seconds."""
    return faults.run(healthy_trial(), Scenario(text, begin=6.5, end=8.5), DAMPER)


TROUBLE = [
    *("force_gain:1000", "force_gain:-1", "displacement_stuck", "displacement_gain:-1"),
    *("coil_factor:0", "force_loss:0.3", "tempo:0", "amplitude:0.1", "clock_jump:-60"),
]


@pytest.mark.parametrize("text", TROUBLE)
def test_a_fault_is_noticed_and_a_repaired_rig_soon_right_again(text: str) -> None:
    # Seconds: what the median of all scenarios may take at most.
    assert outcome(text).wrong_valid <= 0.5
    # Windows after the repair, as for all scenarios.
    assert outcome(text).recovery <= 4.0
