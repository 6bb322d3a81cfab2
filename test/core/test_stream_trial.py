"""Streams of unknown dampers, of faulty rigs, and of the whole control loop."""

from functools import cache

import numpy as np
import pytest

from benchmarks import faults
from benchmarks.dampers import DAMPERS
from benchmarks.streams import StreamTrial, TrialSettings
from benchmarks.whole_loop import driven
from mr_damper_ros.emulation.emulator import CurrentSchedule
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.tracking.engine import EngineSettings
from mr_damper_ros.tracking.tracker import TrackerSettings

FAST = TrackerSettings(method="least_squares")
QUICK = TrialSettings(block_size=50, engine=EngineSettings(tracking=FAST))
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
    """Outcome of a fault of two seconds."""
    return faults.run(healthy_trial(), faults.Scenario(text, begin=6.5, end=8.5), DAMPER)


TROUBLE = [
    *("force_gain:1000", "force_gain:-1", "displacement_stuck", "displacement_gain:-1"),
    *("coil_factor:0", "force_loss:0.3", "tempo:0", "amplitude:0.1", "clock_jump:-60"),
]


@pytest.mark.parametrize("text", TROUBLE)
def test_a_fault_is_noticed_and_a_repaired_rig_soon_right_again(text: str) -> None:
    # Seconds: limit for the median of all scenarios.
    assert outcome(text).wrong.longest <= 0.5
    # Windows after the repair, as for all scenarios.
    assert outcome(text).recovery <= 4.0


STEP = 5.0
"""Seconds at the first current; after three, some windows have been fitted."""


@pytest.mark.parametrize("model", ["sigmoid", "sigmoid_lag"])
def test_the_next_current_is_given_no_force_beyond_what_a_damper_can(model: str) -> None:
    engine = QUICK.engine.for_law(model)
    trial = StreamTrial(
        DAMPERS["viscous_tanh"],
        SineMotion(0.005, 1.0),
        CurrentSchedule([0.0, STEP], [0.2, 1.2]),
        settings=TrialSettings(block_size=50, engine=engine),
    )
    result = trial.run(STEP + 2.0)
    known = result.time > 3.0
    # Multiple of the largest force of the whole run, which no other current can exceed.
    assert np.nanmax(np.abs(result.predicted[known])) < 2.0 * np.abs(result.true).max()


def test_an_identifier_that_starts_from_nothing_leaves_the_controller_its_set() -> None:
    """The controller has a parameter file; at first the identifier knows the damper at 0 A only.

    If its start, or what it has found at the safe current, took the place of the file, nothing but
    that current would be commanded, and nothing else ever be identified.
    """
    came = driven("C", 0, 8.0, given=False)
    assert came.reversals > 1.0
    assert came.safe == 0.0
