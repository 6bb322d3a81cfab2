"""A trial of a stream: it is right about a healthy damper and notices a wrong force."""

from __future__ import annotations

from functools import cache

import pytest

from benchmarks import faults
from benchmarks.other_dampers import DAMPERS
from benchmarks.stream_trial import StreamTrial, TrialSettings
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.tracking.tracker import TrackerSettings

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


@cache
def outcome(text: str) -> faults.Outcome:
    """What comes of a fault of two seconds."""
    return faults.run(healthy_trial(), faults.Scenario(text, begin=6.5, end=8.5), DAMPER)


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
