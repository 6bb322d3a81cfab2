"""Temperature maps of bags: from those with a thermometer, and only from those."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from mr_damper_ros.api.findings import temperature_maps
from mr_damper_ros.api.measured_runs import measured_run
from mr_damper_ros.emulation.emulator import EmulatedDamper, EmulatedRig, ThermalModel
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.io.bag_writer import write_bag
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS, THESIS_71_CELSIUS
from mr_damper_ros.signals.recording import Recording

COLD_SET = ParameterSet(THESIS_28_CELSIUS)
COLD, HOT = 28.0, 71.0


def heated(current: float = 1.5, *, thermometer: bool = True) -> Recording:
    """Fifty seconds in which the damper heats from 28 °C to nearly 71 °C."""
    rig = EmulatedRig(
        EmulatedDamper(THESIS_28_CELSIUS, THESIS_71_CELSIUS),
        SineMotion(5e-3, 1.0),
        current,
        thermal=ThermalModel(capacity=25.0, conductance=0.0),
    )
    recording = rig.record(50.0)
    return recording if thermometer else replace(recording, temperature=None)


def test_a_bag_with_a_thermometer_gives_the_map(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", heated())
    (found,) = temperature_maps([measured_run(tmp_path / "bag")], COLD_SET)
    # [m/s] and [A] of the operating point of a steady run.
    assert found.operating_point == pytest.approx((0.0314, 1.5), abs=1e-3)
    # Force at 71 °C over that at 28 °C, as the loops of the two published sets have it.
    expected = 1.0 - (1.0 - 0.7561) * (found.high - found.low) / (HOT - COLD)
    # Kelvin of the 43 from cold to hot that the map must reach over: the last windows stay below.
    assert found.high - found.low > 35.0
    ratio = found.scale(found.high).value / found.scale(found.low).value
    # Of the ratio of two forces: noise, and a curve in ln s for a straight line in F.
    assert ratio == pytest.approx(expected, abs=0.01)


def test_a_bag_without_a_thermometer_gives_none(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", heated(thermometer=False))
    bag = measured_run(tmp_path / "bag")
    assert bag.temperatures == (None,)
    assert temperature_maps([bag], COLD_SET) == []
