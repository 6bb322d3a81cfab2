"""What the work of a window's task brings home."""

from __future__ import annotations

import pickle
from dataclasses import replace

import known
import numpy as np
import pytest
from random_motion import BandLimitedRandom

from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.sigmoid.law import sine_force
from mr_damper_ros.tracking.tracker import WindowTracker
from mr_damper_ros.tracking.tracker_settings import TrackerSettings
from mr_damper_ros.tracking.window_assembler import RawWindow
from mr_damper_ros.tracking.window_task import run_fit

SAMPLES = 2000
START = ParameterSet(known.PLAUSIBLE * np.where(np.arange(16) == known.index("f0"), 0.9, 1.0))


def random_window() -> RawWindow:
    motion = BandLimitedRandom(3e-3, 0.5, 3.0).at(np.arange(SAMPLES) * known.PERIOD)
    current = np.full(SAMPLES, 1.0)
    clean = sine_force(
        known.PLAUSIBLE, motion.displacement, motion.velocity, motion.acceleration, current
    )
    noise = np.random.default_rng(3).normal(0.0, known.NOISE, SAMPLES)
    return RawWindow(known.T0, known.PERIOD, motion.displacement, clean + noise, current)


WINDOWS = {"sine": known.raw_window(known.run(samples=SAMPLES)), "random": random_window()}


@pytest.mark.parametrize("motion", WINDOWS)
def test_an_answer_does_not_bring_the_samples_home_again(motion: str) -> None:
    window = WINDOWS[motion]
    result = run_fit(WindowTracker(TrackerSettings(), START).window_task(window))
    assert result.fit is not None
    samples = window.displacement.nbytes + window.force.nbytes + window.current.nbytes
    # Of every fourth sample the force, the current and the motion: three quarters of this.
    assert len(pickle.dumps(result)) < samples


def test_a_look_brings_no_samples_at_all() -> None:
    tracker = WindowTracker(TrackerSettings(), START)
    tracker.follow(WINDOWS["sine"])
    weak = replace(
        WINDOWS["sine"],
        start_ns=known.T0 + 2 * 10**9,
        force=0.8 * WINDOWS["sine"].force,
        look=SAMPLES // 2,
    )
    result = run_fit(tracker.window_task(weak))
    assert result.fit is not None
    assert len(pickle.dumps(result)) < 0.2 * weak.force.nbytes
