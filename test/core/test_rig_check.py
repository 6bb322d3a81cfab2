"""Faults of a rig are named, and none are reported for a sound rig."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from mr_damper_ros.data_check.findings import Kind
from mr_damper_ros.data_check.lag import channel_skew
from mr_damper_ros.data_check.streams import (
    ReceivedBlock,
    RigRecord,
    check_rig,
)
from mr_damper_ros.emulation.emulator import EmulatedDamper, EmulatedRig, RigSettings
from mr_damper_ros.emulation.faults import Instruments, faults_of
from mr_damper_ros.emulation.motions import Excitation, SineMotion, SteppedSine
from mr_damper_ros.kinematics.periodic_motion import MotionKind, PeriodicMotion
from mr_damper_ros.models.published import THESIS_28_CELSIUS

SECONDS = 30.0
RATE = 1000.0
BLOCK = 20
MOTIONS: dict[str, Excitation] = {
    "steps": SteppedSine(0.005, 0.5, 3.0, SECONDS),
    "sine": SineMotion(0.005, 1.0),
    "fast": SineMotion(0.002, 4.0),
    "chirp": PeriodicMotion(MotionKind.SWEEP, 0.005, 0.5, 3.0, SECONDS),
    "random": PeriodicMotion(MotionKind.RANDOM, 0.01, 0.3, 4.0, SECONDS, 1),
}


@cache
def record(
    faults: str = "", motion: str = "steps", current: float = 1.0, seed: int = 0
) -> RigRecord:
    """Messages of an emulated rig with these faults."""
    found = faults_of(faults.split(), seed)
    rig = EmulatedRig(
        EmulatedDamper(THESIS_28_CELSIUS),
        MOTIONS[motion],
        current,
        settings=RigSettings(displacement_noise=2e-6, seed=seed),
        faults=found,
    )
    instruments = Instruments(found)
    heard = RigRecord()
    for count in range(round(SECONDS * RATE / BLOCK)):
        made = rig.next_block(BLOCK)
        arrival = made.stamp_ns(BLOCK - 1)
        for block, _ in instruments.read(made):
            rows = block.displacement, block.force
            heard.blocks.append(
                ReceivedBlock(block.start_ns, block.sequence, block.period, *rows, arrival)
            )
            if count % 5 == 0 and np.isfinite(block.current[0]):
                stamp = block.start_ns + block.supply_ahead_ns
                heard.measured.append((stamp, float(block.current[0])))
                heard.commanded.append((made.start_ns, current))
    return heard


FAULTS = {
    "swapped": Kind.SWAPPED,
    "force_gain:-1": Kind.INVERTED,
    "displacement_gain:-1": Kind.INVERTED,
    "displacement_gain:1000": Kind.UNIT,
    "force_gain:0.001": Kind.UNIT,
    "force_offset:800": Kind.OFFSET,
    "force_delay:0.003": Kind.SKEW,
    "displacement_delay:0.004": Kind.SKEW,
    "force_noise:60": Kind.NOISE,
    "displacement_noise:3e-5": Kind.NOISE,
    "force_hum:40": Kind.HUM,
    "displacement_hum:2e-5": Kind.HUM,
    "force_clip:600": Kind.CLIPPED,
    "displacement_clip:0.004": Kind.CLIPPED,
    "force_coarse:40": Kind.COARSE,
    "displacement_coarse:0.0005": Kind.COARSE,
    "force_spikes:500": Kind.SPIKES,
    "force_stuck": Kind.STUCK,
    "force_nan": Kind.NOT_FINITE,
    "wrong_period:2": Kind.RATE,
    "stamp_jitter:0.5": Kind.JITTER,
    "lost_blocks:0.02": Kind.LOST,
    "doubled_blocks:0.05": Kind.REPEATED,
    "reordered_blocks:0.05": Kind.REPEATED,
    "clock_jump:60@15": Kind.RESTARTED,
    "late_blocks": Kind.BURSTS,
    "current_missing": Kind.NO_CURRENT,
    "current_offset:0.2": Kind.CURRENT,
    "supply_clock:2": Kind.CURRENT_CLOCK,
    "tempo:0": Kind.AT_REST,
}
"""Expected finding for each fault."""


def troubles(heard: RigRecord) -> list[Kind]:
    return [finding.kind for finding in check_rig(heard).findings]


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("current", [0.0, 1.0])
def test_nothing_is_invented_on_a_sound_rig(motion: str, current: float) -> None:
    assert troubles(record(motion=motion, current=current)) == []


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named_and_no_other(fault: str) -> None:
    assert set(troubles(record(fault))) == {FAULTS[fault]}


@pytest.mark.parametrize("seed", [1, 2])
def test_several_faults_are_all_named(seed: int) -> None:
    heard = record("force_gain:-1 force_hum:40 lost_blocks:0.02 current_offset:0.3", seed=seed)
    assert set(troubles(heard)) == {Kind.INVERTED, Kind.HUM, Kind.LOST, Kind.CURRENT}


def without_large_forces(heard: RigRecord, limit: float) -> tuple[RigRecord, int]:
    """The record without samples whose force reaches a limit [N], and the number left out."""
    kept = RigRecord(measured=heard.measured, commanded=heard.commanded)
    left_out = 0
    for block in heard.blocks:
        below = np.abs(block.force) < limit
        left_out += int(np.count_nonzero(~below))
        for run in np.split(np.arange(below.size), np.flatnonzero(np.diff(below)) + 1):
            if below[run[0]]:
                kept.blocks.append(
                    replace(
                        block,
                        start_ns=block.start_ns + int(run[0] * 1e9 / RATE),
                        sequence=block.sequence + int(run[0]),
                        displacement=block.displacement[run],
                        force=block.force[run],
                    )
                )
    return kept, left_out


def test_what_a_source_left_out_at_the_end_of_a_range_is_cut_off_and_not_lost() -> None:
    kept, left_out = without_large_forces(record(), 600.0)
    assert Kind.LOST in troubles(kept)
    kept.saturated["force"] = (40, 40 + left_out)
    found = check_rig(kept).findings
    assert [(finding.kind, finding.channel) for finding in found] == [(Kind.CLIPPED, "force")]
    assert str(left_out) in found[0].sentence


def test_where_nothing_comes_that_is_all_that_is_said_of_the_samples() -> None:
    assert troubles(RigRecord()) == [Kind.SILENT, Kind.NO_CURRENT]


def test_every_finding_is_a_sentence_and_there_is_advice() -> None:
    check = check_rig(record("force_hum:40"))
    assert "at 50.1 Hz" in str(check)
    assert "Begin with a sine of" in str(check)
    assert "No fault found" in str(check_rig(record()))


@pytest.mark.parametrize("skew", [-0.005, -0.002, 0.0, 0.002, 0.005])
def test_the_skew_is_told_with_an_error_that_holds(skew: float) -> None:
    fault = f"{'force' if skew > 0.0 else 'displacement'}_delay:{abs(skew)}" if skew else ""
    found, error = channel_skew(*record(fault).stretch(), 1.0 / RATE)
    assert error <= 5e-4
    # [s]: three standard errors of the method.
    assert abs(found - skew) < min(3.0 * error, 1.2e-3 + 1e-4)


@pytest.mark.parametrize("motion", ["sine", "chirp", "random"])
def test_motion_that_cannot_tell_skew_from_hysteresis_says_so(motion: str) -> None:
    assert channel_skew(*record(motion=motion).stretch(), 1.0 / RATE)[1] > 5e-4
