"""The emulated rig: true kinematics, true physics, and streams independent of the block size."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_motion import ROUNDED_TRIANGLE, BandLimitedRandom

from mr_damper_ros.emulation.emulator import (
    CurrentSchedule,
    EmulatedDamper,
    EmulatedRig,
    RigSettings,
    ThermalModel,
)
from mr_damper_ros.emulation.faults import fault_of
from mr_damper_ros.emulation.motions import Excitation, SampledMotion, SineMotion
from mr_damper_ros.models.published import LITERATURE, THESIS_28_CELSIUS, THESIS_71_CELSIUS

SINE = SineMotion(0.005, 1.0, phase=0.3)
SILENT = RigSettings(force_noise=0.0)
THERMAL = ThermalModel(heat_capacity=20.0)

MOTIONS = [
    pytest.param(SineMotion(0.005, 3.0, phase=4.481), id="sine"),
    pytest.param(ROUNDED_TRIANGLE, id="triangle"),
    pytest.param(BandLimitedRandom(0.003, 0.2, 4.0, seed=3), id="random"),
    pytest.param(
        SampledMotion(0.004 * np.sin(np.linspace(0.0, 30.0, 301)) ** 2, 0.02), id="sampled"
    ),
]


@pytest.mark.parametrize("motion", MOTIONS)
def test_a_motion_has_its_own_derivatives(motion: Excitation) -> None:
    time, step = np.linspace(0.0131, 5.871, 400), 1e-6
    _, velocity, acceleration = motion.at(time)
    later, earlier = motion.at(time + step), motion.at(time - step)
    slopes = np.subtract(later, earlier) / 2 / step
    # [m/s] and [m/s²]: curvature and rounding in differences of a 10 mm motion over 2 µs.
    np.testing.assert_allclose(velocity, slopes[0], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(acceleration, slopes[1], rtol=0.0, atol=1e-7)


# ---- the stream ----


def warm_rig() -> EmulatedRig:
    return EmulatedRig(
        EmulatedDamper(THESIS_28_CELSIUS, THESIS_71_CELSIUS),
        SINE,
        CurrentSchedule((0.0, 0.15), (0.5, 1.5)),
        settings=RigSettings(displacement_noise=1e-6, seed=4),
        thermal=THERMAL,
        faults=[fault_of("force_loss:0.8@0.2")],
    )


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(1, 230), min_size=1, max_size=6))
def test_the_size_of_the_blocks_does_not_change_the_stream(sizes: list[int]) -> None:
    rig = warm_rig()
    blocks = [rig.next_block(size) for size in sizes]
    whole = warm_rig().next_block(sum(sizes))
    for name in ("displacement", "force", "current", "temperature"):
        parts = np.concatenate([getattr(block, name) for block in blocks])
        np.testing.assert_array_equal(parts, getattr(whole, name))
    firsts = np.cumsum([0, *sizes[:-1]])
    assert [block.sequence for block in blocks] == firsts.tolist()
    assert [block.start_ns - whole.start_ns for block in blocks] == (firsts * 10**6).tolist()


def test_the_heat_balance_closes() -> None:
    # Without convection all the work of the stroke heats the damper.
    thermal = ThermalModel(heat_capacity=100.0, conductance=0.0)
    rig = EmulatedRig(
        EmulatedDamper(THESIS_28_CELSIUS), SINE, 1.5, settings=SILENT, thermal=thermal
    )
    block = rig.next_block(2001)
    velocity = SINE.at(np.arange(2000) * 1e-3).velocity
    energy = float(np.sum(block.force[:2000] * velocity) * 1e-3)
    # Relative: 2000 random roundings of 28 °C add up to 2e-13 of the rise.
    assert block.temperature[2000] - 28.0 == pytest.approx(energy / 100.0, rel=1e-12, abs=0.0)
    assert energy > 0.0


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: SampledMotion(np.array([0.0, 1.0, np.nan, 0.0]), 0.01), "four finite samples"),
        (lambda: RigSettings(sample_rate=0.0), "sample_rate must be from 1"),
        (lambda: RigSettings(force_noise=-1.0), "force_noise must be from 0"),
        (lambda: ThermalModel(heat_capacity=0.0), "heat_capacity must be from"),
        (lambda: ThermalModel(conductance=-1.0), "conductance must be from 0"),
        (lambda: CurrentSchedule((), ()), "give equal numbers of both"),
        (lambda: CurrentSchedule((1.0, 0.0), (0.0, 1.0)), "must increase"),
        (lambda: CurrentSchedule.constant(float("nan")), "not finite"),
        (lambda: EmulatedRig(EmulatedDamper(LITERATURE), SINE, 0.0).next_block(0), "at least one"),
    ],
)
def test_settings_out_of_range_are_refused(make: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        make()
