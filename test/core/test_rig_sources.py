"""The sources of samples: what they open, the blocks they produce, and rejected options."""

import math
import time
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from streamed import START, source_of

from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.rig.blocks import Meter
from mr_damper_ros.rig.sources import SOURCES
from mr_damper_ros.settings.option_table import build
from mr_damper_ros.signals.blocks import RigBlock

BAG = Path(__file__).parents[2] / "bags" / "5.0mm_1Hz_1.5A"


def joined(blocks: list[RigBlock], quantity: str) -> np.ndarray:
    return np.concatenate([getattr(block, quantity) for block in blocks])


def test_the_recordings_of_a_bag_come_as_they_are() -> None:
    bag = source_of("bag", bag=str(BAG))
    assert "provenance: re-synthesised" in bag.open()[0]
    blocks = list(bag.blocks(START))
    expected = read_bag(BAG)[0]
    for quantity in ("displacement", "force", "current"):
        np.testing.assert_array_equal(joined(blocks, quantity), getattr(expected, quantity))
    assert np.isnan(joined(blocks, "temperature")).all()
    assert blocks[0].start_ns == START
    bag.close()


def test_a_record_comes_in_si_units(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("".join(f"{k % 7},{k % 5}\n" for k in range(100)), encoding="utf-8")
    record = source_of(
        "record", file=str(path), columns="displacement:mm,force:kN", current=0.5, period=0.002
    )
    assert record.open() == [
        "run: 100 samples, 0.2 s; provenance: imported from run.csv; "
        "columns: displacement:mm,force:kN"
    ]
    blocks = list(record.blocks(START))
    np.testing.assert_allclose(joined(blocks, "displacement"), 1e-3 * (np.arange(100) % 7))
    assert {block.period for block in blocks} == {0.002}
    assert set(joined(blocks, "current")) == {0.5}


def test_a_command_changes_the_current_with_the_next_block_and_holds_for_its_time() -> None:
    rig = source_of("emulated", block_size=10, current=0.5, command_timeout=0.01)
    rig.open()
    blocks = rig.blocks(START)
    assert set(next(blocks).current) == {0.5}
    rig.commander.command(1.0, 0, 0.0, time.monotonic() + 3600.0)
    list(islice(blocks, 10))  # blocks made before the command, up to a hundred samples
    assert set(next(blocks).current) == {1.0}
    # From now on the rig makes each sample only on request.
    rig.commander.command(0.8, 1, 0.0, time.monotonic() + 3600.0)
    assert set(next(blocks).current) == {0.8}
    rig.commander.command(0.8, 2, 0.0, time.monotonic() - 3600.0)
    assert set(next(blocks).current) == {0.0}


@pytest.mark.parametrize("excitation", ["chirp", "steps", "random"])
def test_the_emulated_rig_moves_within_its_amplitude_and_band(excitation: str) -> None:
    rig = source_of(
        "emulated", 20_000, excitation=excitation, frequency=0.5, highest_frequency=4.0,
        sweep_time=20.0,
    )  # fmt: skip
    rig.open()
    moved = next(rig.blocks(START)).displacement
    assert 0.002 < np.abs(moved).max() < 0.0075
    spectrum = np.abs(np.fft.rfft(moved * np.hanning(moved.size))) ** 2
    frequencies = np.fft.rfftfreq(moved.size, 1e-3)
    within = (frequencies > 0.3) & (frequencies < 5.0)
    assert spectrum[within].sum() > 0.98 * spectrum.sum()
    # The result is no longer a single sine.
    share = np.cumsum(spectrum) / spectrum.sum()
    low, high = np.interp((0.1, 0.9), share, frequencies)
    assert high > 1.5 * low


def test_the_emulated_rig_moves_as_recorded_and_then_stands_still(tmp_path: Path) -> None:
    time = np.arange(500) * 1e-3
    recorded = 2.0 * np.sin(2.0 * np.pi * 4.0 * time) ** 2
    path = tmp_path / "motion.csv"
    rows = zip(time, recorded, strict=True)
    path.write_text("".join(f"{t:.6f},{u:.9f},{9.0 + t}\n" for t, u in rows), encoding="utf-8")
    rig = source_of(
        "emulated", 1000, excitation="recorded", motion_file=str(path),
        motion_columns="time:s,displacement:mm,force:N",
    )  # fmt: skip
    rig.open()
    moved = next(rig.blocks(START)).displacement
    np.testing.assert_allclose(moved[:500], 1e-3 * recorded, atol=1e-8)
    assert np.ptp(moved[500:]) == 0.0


@pytest.mark.parametrize("damper", ["thesis_temperatures", "5.0mm_1Hz_0.5A", "file"])
def test_the_emulated_damper_is_the_one_that_was_named(damper: str, tmp_path: Path) -> None:
    if damper == "file":
        damper = str(tmp_path / "set.yaml")
        Path(damper).write_text(ParameterSet(THESIS_28_CELSIUS).to_yaml(), encoding="utf-8")
    rig = source_of("emulated", block_size=1000, damper=damper, current=0.5, force_noise=0.0)
    assert rig.open() == []
    force = next(rig.blocks(START)).force
    assert np.isfinite(force).all()
    assert np.ptp(force) > 100.0


@pytest.mark.parametrize(
    ("name", "settings", "part"),
    [
        ("bag", {}, "no bag is given"),
        ("record", {}, "no file is given"),
        ("record", {"file": "x"}, "record.columns is empty"),
        ("emulated", {}, ""),
        ("emulated", {"excitation": "recorded"}, "emulated.motion_file"),
        ("emulated", {"excitation": "chirp", "frequency": 5.0}, "must be above"),
    ],
)
def test_what_is_missing_is_said(name: str, settings: dict[str, Any], part: str) -> None:
    objection = build(SOURCES[name].options, settings).objection()
    assert part in objection
    assert bool(objection) == bool(part)


def block_of(values: np.ndarray, sequence: int = 0) -> RigBlock:
    nothing = np.zeros(values.size)
    start_ns = START + sequence * 1_000_000
    return RigBlock(start_ns, sequence, 1e-3, nothing, nothing, values, nothing)


def test_a_meter_reads_at_its_own_rate_whatever_the_blocks() -> None:
    meter = Meter(0.01)
    readings = []
    for first in range(0, 35, 7):
        block = block_of(np.arange(first, first + 7.0), first)
        readings += [value for _, value in meter.read(block, block.current)]
    assert readings == [0.0, 10.0, 20.0, 30.0]


def test_a_meter_reports_a_step_at_once_and_unknown_values_not_at_all() -> None:
    values = np.array([0.5, 0.5, 0.502, 0.6, 0.6, math.nan])
    readings = Meter(1.0, step=0.005).read(block_of(values), values)
    assert readings == [(START, 0.5), (START + 3_000_000, 0.6)]
