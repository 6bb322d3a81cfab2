"""Faults of a rig are named, and none are reported for a sound rig."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from mr_damper_ros.emulation.emulator import EmulatedDamper, EmulatedRig, RigSettings
from mr_damper_ros.emulation.faults import Instruments, faults_of
from mr_damper_ros.emulation.motions import Excitation, SineMotion, SteppedSine
from mr_damper_ros.kinematics.periodic_motion import MotionKind, PeriodicMotion
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.rig_check.checks import (
    ReceivedBlock,
    RigRecord,
    Trouble,
    channel_skew,
    check_rig,
)

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
    "swapped": Trouble.SWAPPED,
    "force_gain:-1": Trouble.INVERTED,
    "displacement_gain:-1": Trouble.INVERTED,
    "displacement_gain:1000": Trouble.UNIT,
    "force_gain:0.001": Trouble.UNIT,
    "force_offset:800": Trouble.OFFSET,
    "force_delay:0.003": Trouble.SKEW,
    "displacement_delay:0.004": Trouble.SKEW,
    "force_noise:60": Trouble.NOISE,
    "displacement_noise:3e-5": Trouble.NOISE,
    "force_hum:20": Trouble.HUM,
    "displacement_hum:2e-5": Trouble.HUM,
    "force_clip:600": Trouble.CLIPPED,
    "displacement_clip:0.004": Trouble.CLIPPED,
    "force_coarse:40": Trouble.COARSE,
    "displacement_coarse:0.0005": Trouble.COARSE,
    "force_spikes:500": Trouble.SPIKES,
    "force_stuck": Trouble.STUCK,
    "force_nan": Trouble.NOT_FINITE,
    "wrong_period:2": Trouble.RATE,
    "stamp_jitter:0.5": Trouble.JITTER,
    "lost_blocks:0.02": Trouble.LOST,
    "doubled_blocks:0.05": Trouble.REPEATED,
    "reordered_blocks:0.05": Trouble.REPEATED,
    "clock_jump:60@15": Trouble.RESTARTED,
    "late_blocks": Trouble.BURSTS,
    "current_missing": Trouble.NO_CURRENT,
    "current_offset:0.2": Trouble.CURRENT,
    "supply_clock:2": Trouble.CURRENT_CLOCK,
    "tempo:0": Trouble.AT_REST,
}
"""Expected finding for each fault."""


def troubles(heard: RigRecord) -> list[Trouble]:
    return [finding.trouble for finding in check_rig(heard).findings]


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("current", [0.0, 1.0])
def test_nothing_is_invented_on_a_sound_rig(motion: str, current: float) -> None:
    assert troubles(record(motion=motion, current=current)) == []


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named_and_no_other(fault: str) -> None:
    assert set(troubles(record(fault))) == {FAULTS[fault]}


@pytest.mark.parametrize("seed", [1, 2])
def test_several_faults_are_all_named(seed: int) -> None:
    heard = record("force_gain:-1 force_hum:20 lost_blocks:0.02 current_offset:0.3", seed=seed)
    assert set(troubles(heard)) == {Trouble.INVERTED, Trouble.HUM, Trouble.LOST, Trouble.CURRENT}


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
    assert Trouble.LOST in troubles(kept)
    kept.saturated["force"] = (40, 40 + left_out)
    found = check_rig(kept).findings
    assert [(finding.trouble, finding.channel) for finding in found] == [(Trouble.CLIPPED, "force")]
    assert str(left_out) in found[0].sentence


def test_where_nothing_comes_that_is_all_that_is_said_of_the_samples() -> None:
    assert troubles(RigRecord()) == [Trouble.SILENT, Trouble.NO_CURRENT]


def test_every_finding_is_a_sentence_and_there_is_advice() -> None:
    check = check_rig(record("force_hum:20"))
    assert "50 Hz" in str(check)
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
