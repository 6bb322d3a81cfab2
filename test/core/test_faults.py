"""The fault library: each fault has the named effect at the given time, and no other."""

import math
from pathlib import Path

import numpy as np
import pytest
from known import PLAUSIBLE

from mr_damper_ros.emulation.emulator import EmulatedDamper, EmulatedRig, RigSettings
from mr_damper_ros.emulation.faults import (
    CHANNELS,
    FAULTS,
    KINDS,
    FaultError,
    Instruments,
    Kind,
    fault_of,
    faults_of,
)
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.signals.blocks import RigBlock

BEGIN, END, DURATION = 0.5, 0.8, 1.2
SIZE = 10
SETTINGS = RigSettings(force_noise=0.0)
PAGE = Path(__file__).parents[2] / "doc" / "faults.md"

HARMLESS = {
    *(f"{channel}_{kind}" for channel in ("current", "temperature") for kind in ("stuck", "delay")),
    *("current_sluggish", "temperature_sluggish"),
}
"""Faults that do not show in a constant signal."""

STRONG = {
    **{f"{channel}_clip": 1e-3 for channel in CHANNELS},
    **{f"{channel}_coarse": 3.0 for channel in CHANNELS},
    **{f"{channel}_{kind}": 50.0 for channel in CHANNELS for kind in ("dropouts", "nan")},
    "lost_blocks": 0.5,
}
"""Values that show within 0.3 s; the default ones may not."""

OTHER_MOTION = {"amplitude", "tempo"}


def sent_each_time(text: str = "", size: int = SIZE) -> list[list[RigBlock]]:
    """Blocks that a rig with a fault sends during 1.2 s, as one list per block made."""
    faults = faults_of(text.split())
    rig = EmulatedRig(
        EmulatedDamper(PLAUSIBLE), SineMotion(0.005, 2.0), 1.0, settings=SETTINGS, faults=faults
    )
    instruments = Instruments(faults)
    made = [rig.next_block(size) for _ in range(round(DURATION * 1000) // size)]
    return [[block for block, _ in instruments.read(each)] for each in made]


def sent(text: str = "", size: int = SIZE) -> list[RigBlock]:
    """All blocks that a rig with a fault sends during 1.2 s."""
    return [block for blocks in sent_each_time(text, size) for block in blocks]


HEALTHY = sent()


def same(one: list[RigBlock], other: list[RigBlock]) -> bool:
    """Whether two streams are identical to the last bit, stamps and order included."""
    return len(one) == len(other) and all(
        (a.start_ns, a.sequence, a.period, a.supply_ahead_ns)
        == (b.start_ns, b.sequence, b.period, b.supply_ahead_ns)
        and all(
            np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True) for name in CHANNELS
        )
        for a, b in zip(one, other, strict=True)
    )


@pytest.mark.parametrize("name", ["force_loss", "friction", "spring", "coil_factor", "coil_offset"])
def test_a_damper_changes_within_a_tenth_of_a_second(name: str) -> None:
    fault, time = fault_of(f"{name}@0.5-0.8"), np.arange(120) / 100.0
    share = fault.share(time)
    assert share[[50, 55, 60, 80, 85, 90]] == pytest.approx([0.0, 0.5, 1.0, 1.0, 0.5, 0.0])
    assert fault_of(name).share(time).tolist() == [1.0] * 120, "present from the start"


@pytest.mark.parametrize("name", sorted(set(FAULTS) - OTHER_MOTION))
def test_a_fault_leaves_what_comes_before_it_alone(name: str) -> None:
    early = sent(f"{name}@{BEGIN}-{END}")[:50]
    assert same(early, HEALTHY[:50])


@pytest.mark.parametrize("name", sorted(set(FAULTS) - HARMLESS))
def test_a_fault_shows(name: str) -> None:
    value = f":{STRONG[name]}" if name in STRONG else ""
    came = sent_each_time(f"{name}{value}@{BEGIN}-{END}")
    assert not all(same(blocks, [block]) for blocks, block in zip(came, HEALTHY, strict=True))


@pytest.mark.parametrize("name", ["amplitude:0.2", "tempo:0.5"])
def test_a_change_of_motion_does_not_jump(name: str) -> None:
    moved = np.concatenate([block.displacement for block in sent(f"{name}@{BEGIN}-{END}")])
    fastest = 2.0 * np.pi * 2.0 * 0.005 * 1e-3
    # The ramp of 0.1 s adds speed: 5 mm in 0.1 s, twice that at its steepest.
    assert np.abs(np.diff(moved)).max() < fastest + 2.0 * 0.005 / 100.0


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("force_gain:10@20-30", (10.0, 20.0, 30.0, "force")),
        ("force_gain:-1e-3@2.5", (-1e-3, 2.5, math.inf, "force")),
        ("displacement_stuck", (1.0, 0.0, math.inf, "displacement")),
    ],
)
def test_a_text_is_read(text: str, expected: tuple[float, float, float, str]) -> None:
    fault = fault_of(text)
    assert (fault.amount, fault.begin, fault.end, fault.channel) == expected


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("force_gain=10", "cannot be read"),
        ("gain:10", "is unknown"),
        ("force_stuck:3", "takes no value"),
        ("force_gain:1e999", "must be finite"),
        ("force_gain:2@30-20", "end after its beginning"),
        ("force_noise:-1", "at least 0"),
    ],
)
def test_a_text_that_cannot_be_had_is_refused_in_a_sentence(text: str, problem: str) -> None:
    with pytest.raises(FaultError, match=problem):
        fault_of(text)


@pytest.mark.parametrize("kind", KINDS)
def test_the_documentation_has_every_kind(kind: Kind) -> None:
    assert f"_{kind.name}`" in PAGE.read_text() or f"`{kind.name}`" in PAGE.read_text()
