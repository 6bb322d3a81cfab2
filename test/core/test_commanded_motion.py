"""A machine that is told how to move: never beyond its limits, never with a jerk."""

from __future__ import annotations

import math
import time as clock

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.rig.commanded_motion import CYCLES, CommandedMotion
from mr_damper_ros.rig.excitation import Kinematics, SineMotion
from mr_damper_ros.rig.motion_commander import MotionCommander, MotionLimits
from mr_damper_ros.rig.sources.emulated_source import EmulatedOptions, EmulatedSource
from mr_damper_ros.rig.sources.source import StreamSettings

AMPLITUDE, VELOCITY = 0.01, 0.2
LIMITS = MotionLimits(AMPLITUDE, VELOCITY, 0.5)
BY_ITSELF = SineMotion(0.005, 2.0)
PERIOD = 2e-3

ROUNDING = 1e-9
"""Relative."""


def moved(commands: list[tuple[float, float, float]], duration: float) -> Kinematics:
    """The motion with (time, amplitude, frequency) commanded in between."""
    motion = CommandedMotion(BY_ITSELF, 0.0)
    time = np.arange(round(duration / PERIOD)) * PERIOD
    parts, done = [], 0
    for told, amplitude, frequency in sorted(commands):
        place = int(np.searchsorted(time, told))
        parts.append(np.stack(motion.at(time[done:place])))
        motion.command(amplitude, frequency, float(time[place]))
        done = place
    parts.append(np.stack(motion.at(time[done:])))
    return Kinematics(*np.concatenate(parts, axis=1))


@st.composite
def commands(draw: st.DrawFn) -> list[tuple[float, float, float]]:
    """Commands within the limits, at any times."""
    found = []
    for _ in range(draw(st.integers(1, 6))):
        amplitude = draw(st.one_of(st.just(0.0), st.floats(1e-4, AMPLITUDE)))
        fastest = VELOCITY / (2.0 * math.pi * max(amplitude, 1e-4))
        found.append((draw(st.floats(0.0, 8.0)), amplitude, draw(st.floats(0.5, fastest))))
    return found


@known.fixed(60)
@given(commands())
def test_no_sample_leaves_the_limits_whatever_is_commanded(
    told: list[tuple[float, float, float]],
) -> None:
    u, v, _ = moved(told, 10.0)
    assert np.abs(u).max() <= AMPLITUDE * (1.0 + ROUNDING)
    assert np.abs(v).max() <= VELOCITY * (1.0 + ROUNDING)


@known.fixed(60)
@given(commands())
def test_the_motion_has_no_jump(told: list[tuple[float, float, float]]) -> None:
    u, v, a = moved(told, 10.0)
    # What the velocity makes of a displacement within a period, and the acceleration of it.
    assert np.abs(np.diff(u)).max() <= np.abs(v).max() * PERIOD * 1.01
    assert np.abs(np.diff(v)).max() <= np.abs(a).max() * PERIOD * 1.01


def test_it_moves_as_commanded_once_it_has_grown() -> None:
    u, v, _ = moved([(0.0, 0.008, 3.0)], 4.0)
    begin = round((CYCLES / BY_ITSELF.frequency + CYCLES / 3.0) / PERIOD)
    assert np.abs(u[begin:]).max() == pytest.approx(0.008, rel=1e-3)
    assert np.abs(v[begin:]).max() == pytest.approx(2.0 * math.pi * 3.0 * 0.008, rel=1e-3)


def test_it_comes_to_rest() -> None:
    u, v, _ = moved([(0.0, 0.008, 3.0), (3.0, 0.0, 0.0)], 5.0)
    end = round((3.0 + CYCLES / 3.0) / PERIOD) + 1
    assert np.abs(u[end:]).max() < ROUNDING
    assert np.abs(v[end:]).max() < ROUNDING


def test_the_machine_rests_when_the_commands_stop() -> None:
    commander = MotionCommander(LIMITS)
    assert commander.command(0.01, 1.0, 100, 0.0, 10.0) == ""
    assert commander.wanted(10.4) == (0.01, 1.0)
    assert commander.wanted(10.6) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("amplitude", "frequency", "age", "sentence"),
    [
        (0.011, 1.0, 0.0, "beyond 0.01 m"),
        (0.01, 4.0, 0.0, "beyond 0.2 m/s"),
        (0.01, 1.0, 0.6, "0.6 s old"),
        (0.01, 1.0, -0.6, "in the future"),
        (math.nan, 1.0, 0.0, "must be a size"),
        (-0.001, 1.0, 0.0, "must be a size"),
        (0.01, math.inf, 0.0, "must be positive"),
        (0.01, 0.0, 0.0, "must be positive"),
    ],
)
def test_what_cannot_be_made_is_refused(
    amplitude: float, frequency: float, age: float, sentence: str
) -> None:
    commander = MotionCommander(LIMITS)
    assert sentence in commander.command(amplitude, frequency, 100, age, 10.0)
    assert not commander.commanded
    assert commander.wanted(10.0) == (0.0, 0.0)


def test_a_command_that_was_overtaken_is_refused() -> None:
    commander = MotionCommander(LIMITS)
    commander.command(0.01, 1.0, 200, 0.0, 10.0)
    assert "after a newer one" in commander.command(0.005, 1.0, 100, 0.0, 10.1)
    assert commander.wanted(10.1) == (0.01, 1.0)


def test_the_emulated_rig_moves_by_itself_until_a_command_comes() -> None:
    source = EmulatedSource(EmulatedOptions(force_noise=0.0), StreamSettings(100))
    source.open()
    assert source.mover is not None
    blocks = source.blocks(0)
    before = np.concatenate([next(blocks).displacement for _ in range(20)])
    time = np.arange(before.size) * 1e-3
    assert before == pytest.approx(0.005 * np.sin(2.0 * np.pi * time), abs=1e-12)


def test_the_emulated_rig_obeys() -> None:
    given_options = EmulatedOptions(force_noise=0.0, frequency=5.0, command_timeout=3600.0)
    source = EmulatedSource(given_options, StreamSettings(100))
    source.open()
    assert source.mover is not None
    blocks = source.blocks(0)
    next(blocks)
    assert source.mover.command(0.002, 4.0, 1, 0.0, clock.monotonic()) == ""
    parts = [next(blocks).displacement for _ in range(30)]
    joined = np.concatenate(parts)
    assert np.abs(np.diff(joined)).max() <= 2.0 * math.pi * 5.0 * 0.005 * 1.01e-3
    assert np.abs(joined[-1000:]).max() == pytest.approx(0.002, rel=1e-3)
