"""The program that checks a rig, on the emulated one with and without faults."""

import signal
import subprocess
import threading
import time
from typing import Any

import pytest
from support import PATIENCE, Listener, installed_programs

STEPS = {"emulated__excitation": "steps", "emulated__sweep_time": 8.0, "wait_for_subscribers": 1}


def check(seconds: float) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [installed_programs() / "mr-damper", "check", "--seconds", str(seconds)],
        capture_output=True,
        text=True,
        timeout=seconds + 2.0 * PATIENCE,
        check=False,
    )


def test_a_sound_rig_has_nothing_wrong(start: Any) -> None:
    start("bridge", **STEPS)
    done = check(6.0)
    found = [line for line in done.stdout.splitlines() if line.startswith("- ")]
    # A busy computer may delay the samples, which is then reported.
    assert [line for line in found if "the stream paused" not in line] == [], done.stderr
    assert "Begin with a sine" in done.stdout


def test_what_is_wrong_is_said_and_the_exit_code_tells(start: Any) -> None:
    start("bridge", emulated__faults="force_gain:-1 force_clip:600", **STEPS)
    done = check(6.0)
    assert done.returncode == 1, done.stderr
    assert "reverse the sign of the force" in done.stdout
    assert "the force is clipped at" in done.stdout


def test_without_a_rig_it_says_what_to_start() -> None:
    done = check(1.0)
    assert done.returncode == 1, done.stderr
    assert "no samples arrive on mts/samples: start the bridge" in done.stdout


def test_an_interrupt_ends_it_also_if_nothing_arrives(listener: Listener) -> None:
    deadline = time.monotonic() + PATIENCE
    threading.Timer(0.5, signal.raise_signal, [signal.SIGINT]).start()
    with pytest.raises(KeyboardInterrupt):
        listener.spin_for(2.0 * PATIENCE)
    assert time.monotonic() < deadline
