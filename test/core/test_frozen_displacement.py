"""A displacement that freezes: detected before a controller acts on it, unlike a rest."""

import math
from dataclasses import replace

import numpy as np
import pytest
from known import T0
from test_force_controller import BLOCK, PERIOD, WHOLE, ControlLoop, settings

from mr_damper_ros.control.force_controller import ForceController
from mr_damper_ros.emulation.emulator import EmulatedDamper
from mr_damper_ros.emulation.motions import ChangedMotion, Excitation, SineMotion
from mr_damper_ros.kinematics.motion_follower import FreezeDetector
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.validity import DoubtKind

AMPLITUDE, FREQUENCY = 5e-3, 1.0
PEAK = 2.0 * math.pi * FREQUENCY * AMPLITUDE

HIGHEST, SAFE_WITHIN = 1.1, 0.25
"""Highest current relative to that of the healthy sensor, and time [s] until it is safe."""


@pytest.mark.parametrize("phase", [0.0, 0.1, 0.25, 0.4], ids=lambda phase: f"{phase:g} cycles")
def test_a_frozen_displacement_without_a_load_cell_ends_control(phase: float) -> None:
    """The desired force goes on, and ever more current would be needed for it."""
    given = settings()
    controller = ForceController(
        replace(given, predictor=replace(given.predictor, maximum_error=0.0))
    )
    controller.predictor.set_parameters(WHOLE)
    motion = SineMotion(AMPLITUDE, FREQUENCY)
    loop = ControlLoop(
        controller, EmulatedDamper(WHOLE), excitation=motion, displacement_noise=1e-6
    )
    freeze, held, rows = 4.0 + phase / FREQUENCY, math.nan, []
    for block in loop.blocks(freeze + 0.5):
        times = (block.start_ns - T0) / NANOSECONDS + np.arange(BLOCK) * PERIOD
        seen = block.displacement[times < freeze]
        held = seen[-1] if seen.size else held
        shown = np.where(times < freeze, block.displacement, held)
        wanted = 12e3 * PEAK * math.cos(2.0 * math.pi * FREQUENCY * times[-1])
        controller.want(block.end_ns, wanted)
        command = controller.command(replace(block, displacement=shown))
        controller.predictor.catch_up()
        loop.command(command.current)
        rows.append((times[-1], command.current, command.doubt.kind))
    healthy = max(current for time, current, _ in rows if 2.5 < time < freeze)
    assert max(current for time, current, _ in rows if time >= freeze) <= HIGHEST * healthy
    assert all(current == 0.0 for time, current, _ in rows if time > freeze + SAFE_WITHIN)
    assert DoubtKind.FROZEN in {kind for *_, kind in rows}


def called_frozen(displacement: Array) -> bool:
    """Whether a displacement is called frozen at any block."""
    detector, called = FreezeDetector(PERIOD), False
    peak = math.sqrt(2.0) * float(np.std(np.diff(displacement[:2000]))) / PERIOD
    for block in displacement.reshape(-1, BLOCK):
        detector.follow(block, peak)
        called = called or detector.speed > 0.0
    return called


@pytest.mark.parametrize("resolution", [0.0, 1e-6, 1e-5], ids="{:g} m".format)
@pytest.mark.parametrize("noise", [0.0, 1e-6], ids="noise {:g} m".format)
def test_a_rest_is_not_called_frozen(noise: float, resolution: float) -> None:
    rng = np.random.default_rng(7)
    for _ in range(10):
        begin, length = rng.uniform(2.0, 3.0), rng.uniform(0.5, 5.0)
        moving: Excitation = SineMotion(AMPLITUDE, rng.uniform(0.5, 3.0))
        resting = ChangedMotion(moving, begin, begin + length, 0.1, tempo=0.0)
        displacement = resting.at(np.arange(9000) * PERIOD).displacement
        displacement = displacement + noise * rng.standard_normal(displacement.size)
        if resolution:
            displacement = resolution * np.round(displacement / resolution)
        assert not called_frozen(displacement)


@pytest.mark.parametrize("resolution", [0.0, 1e-6, 1e-5], ids="{:g} m".format)
def test_a_motion_that_stops_within_a_sample_is_called_frozen(resolution: float) -> None:
    time = np.arange(4000) * PERIOD
    displacement = AMPLITUDE * np.sin(2.0 * math.pi * np.minimum(time, 3.1))
    if resolution:
        displacement = resolution * np.round(displacement / resolution)
    assert called_frozen(displacement)
