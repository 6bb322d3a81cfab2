"""The program that listens to a rig: on the emulated one, sound and not."""

from __future__ import annotations

from typing import Any

STEPS = {"emulated__excitation": "steps", "emulated__sweep_time": 8.0, "wait_for_subscribers": 1}


def test_a_sound_rig_has_nothing_wrong(start: Any) -> None:
    start("bridge", **STEPS)
    check = start("check_rig", "--seconds", "6")
    check.wait()
    found = [line for line in check.output.splitlines() if line.startswith("- ")]
    # A busy computer may hold up the samples, which is then told.
    assert [line for line in found if "nothing came for" not in line] == [], check.errors
    assert "Begin with a sine" in check.output


def test_what_is_wrong_is_said_and_the_exit_code_tells(start: Any) -> None:
    start("bridge", emulated__faults="force_gain:-1 force_clip:600", **STEPS)
    check = start("check_rig", "--seconds", "6")
    assert check.wait() == 1, check.errors
    assert "reverse the sign of force or displacement" in check.output
    assert "the force is cut off at" in check.output


def test_without_a_rig_it_says_what_to_start(start: Any) -> None:
    check = start("check_rig", "--seconds", "1")
    assert check.wait() == 1, check.errors
    assert "no samples come on mts/samples: start the bridge" in check.output
