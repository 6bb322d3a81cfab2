"""What is wrong with a rig is named, and nothing is invented where nothing is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from troubled_rig import FAULTS, MOTIONS, RATE, record

from mr_damper_ros.rig_check.checks import check_rig
from mr_damper_ros.rig_check.record import RigRecord, Trouble, channel_lag


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
    """What comes of a source that leaves out the samples at a limit [N], and how many it left."""
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
    lag = channel_lag(*record(fault).stretch(), 1.0 / RATE)
    assert lag.determined
    # [s]: three standard errors of the method.
    assert abs(lag.skew - skew) < min(3.0 * lag.standard_error, 1.2e-3 + 1e-4)


@pytest.mark.parametrize("motion", ["sine", "chirp", "random"])
def test_motion_that_cannot_tell_skew_from_hysteresis_says_so(motion: str) -> None:
    assert not channel_lag(*record(motion=motion).stretch(), 1.0 / RATE).determined
