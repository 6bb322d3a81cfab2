"""A machine with commanded motion: always within its limits, and free of jumps."""

import math
from dataclasses import replace

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.emulation.motions import CommandedMotion, SineMotion
from mr_damper_ros.kinematics.periodic_motion import Kinematics, MotionKind, PeriodicMotion
from mr_damper_ros.rig.commander import MotionCommander

AMPLITUDE, VELOCITY = 0.01, 0.2
LIMITS = (AMPLITUDE, VELOCITY, 0.5)
BY_ITSELF = SineMotion(0.005, 2.0)
PERIOD = 2e-3

ROUNDING = 1e-9
"""Relative tolerance."""

Told = list[tuple[float, PeriodicMotion | None]]


def sine(amplitude: float, frequency: float) -> PeriodicMotion:
    return PeriodicMotion(MotionKind.SINE, amplitude, frequency)


SWEEP = PeriodicMotion(MotionKind.SWEEP, 0.008, 0.6, 3.4, 2.0)
RANDOM = PeriodicMotion(MotionKind.RANDOM, 0.008, 0.6, 3.4, 2.0, 3)


def moved(commands: Told, duration: float) -> Kinematics:
    """The motion when these commands arrive at their times [s]."""
    motion = CommandedMotion(BY_ITSELF, 0.0)
    time = np.arange(round(duration / PERIOD)) * PERIOD
    parts, done = [], 0
    for told, wanted in sorted(commands, key=lambda one: one[0]):
        place = int(np.searchsorted(time, told))
        parts.append(np.stack(motion.at(time[done:place])))
        motion.command(wanted, float(time[place]))
        done = place
    parts.append(np.stack(motion.at(time[done:])))
    return Kinematics(*np.concatenate(parts, axis=1))


@st.composite
def commands(draw: st.DrawFn) -> Told:
    """Commands within the limits, at arbitrary times."""
    found: Told = []
    for _ in range(draw(st.integers(1, 6))):
        time = draw(st.floats(0.0, 8.0))
        amplitude = draw(st.floats(1e-4, AMPLITUDE))
        frequency = draw(st.floats(0.5, VELOCITY / (2.0 * math.pi * amplitude)))
        wanted = draw(st.sampled_from([None, sine(amplitude, frequency), SWEEP, RANDOM]))
        found.append((time, wanted))
    return found


@known.fixed(30)
@given(commands())
def test_no_sample_leaves_the_limits_or_jumps_whatever_is_commanded(told: Told) -> None:
    u, v, a = moved(told, 10.0)
    assert np.abs(u).max() <= AMPLITUDE * (1.0 + ROUNDING)
    assert np.abs(v).max() <= VELOCITY * (1.0 + ROUNDING)
    # Displacement and velocity are continuous: their steps stay within what the next derivative
    # allows.
    assert np.abs(np.diff(u)).max() <= np.abs(v).max() * PERIOD * 1.01
    assert np.abs(np.diff(v)).max() <= np.abs(a).max() * PERIOD * 1.01


def test_the_machine_rests_when_the_commands_stop() -> None:
    commander = MotionCommander(*LIMITS)
    assert commander.command(sine(0.01, 1.0), 100, 0.0, 10.0) == ""
    assert commander.motion(10.4) == sine(0.01, 1.0)
    assert commander.motion(10.6) is None


@pytest.mark.parametrize(
    ("wanted", "sentence"),
    [
        (sine(0.011, 1.0), "beyond 0.01 m"),
        (sine(0.01, 4.0), "beyond 0.2 m/s"),
        (replace(SWEEP, highest_frequency=5.0), "beyond 0.2 m/s"),
        (replace(RANDOM, highest_frequency=20.0, frequency=5.0), "beyond 0.2 m/s"),
    ],
)
def test_what_cannot_be_made_is_refused(wanted: PeriodicMotion, sentence: str) -> None:
    commander = MotionCommander(*LIMITS)
    assert sentence in commander.command(wanted, 100, 0.0, 10.0)
    assert not commander.commanded
    assert commander.motion(10.0) is None
