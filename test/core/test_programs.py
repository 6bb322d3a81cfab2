"""Programs as processes: their output, their end by signal or force, and domains of their own."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator

import pytest

from mr_damper_ros.processes.programs import Program, ProgramError, RosDomain, node_arguments

TALKS = "import sys; print('out'); sys.stdout.flush(); print('err', file=sys.stderr)"
WAITS = "import sys, time; print('ready', file=sys.stderr); sys.stderr.flush(); time.sleep(600)"
DEAF = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); " + WAITS
SHORT = 0.2
"""Seconds waited for what never comes."""


@pytest.fixture
def waiting() -> Iterator[Program]:
    program = Program([sys.executable, "-c", WAITS])
    program.wait_for_log("ready")
    yield program
    program.close()


def test_output_and_errors_are_kept_apart_and_together() -> None:
    program = Program([sys.executable, "-c", TALKS])
    assert program.wait() == 0
    assert (program.output, program.errors) == ("out\n", "err\n")
    assert program.last_words == "out / err"
    program.close()


def test_one_that_is_asked_to_stop_ends_by_an_interrupt(waiting: Program) -> None:
    assert waiting.running
    assert waiting.stop() != 0  # of this program: a KeyboardInterrupt
    assert "KeyboardInterrupt" in waiting.errors
    assert not waiting.running


def test_one_that_does_not_end_is_killed() -> None:
    program = Program([sys.executable, "-c", DEAF])
    program.wait_for_log("ready")
    assert program.stop(patience=SHORT) == -signal.SIGKILL
    program.close()


def test_waiting_for_what_never_comes_ends_with_the_log(waiting: Program) -> None:
    with pytest.raises(ProgramError, match="never logged 'more': ready"):
        waiting.wait_for_log("more", SHORT)
    with pytest.raises(ProgramError, match=r"did not end within 0\.2 s"):
        waiting.wait(SHORT)


def test_arguments_of_a_node() -> None:
    arguments = node_arguments({"loop": True, "a__b": 0.5, "path": "x y"}, {"__ns": "/left"})
    assert arguments == [
        *("--ros-args", "-r", "__ns:=/left"),
        *("-p", "loop:=true", "-p", "a.b:=0.5", "-p", "path:=x y"),
    ]


def test_after_a_domain_the_environment_is_what_it_was() -> None:
    before = dict(os.environ)
    with RosDomain() as domain, domain.entered():
        assert domain.environment.items() <= os.environ.items()
    assert dict(os.environ) == before


def test_two_domains_differ_until_one_is_closed() -> None:
    with RosDomain() as one, RosDomain() as other:
        assert one.number != other.number
        assert one.environment["ROS_DOMAIN_ID"] == str(one.number)
        freed = min(one.number, other.number)
    with RosDomain() as again:
        assert again.number <= freed


def test_a_program_that_is_not_there_is_an_error() -> None:
    with pytest.raises(FileNotFoundError):
        Program(["/nowhere/program"])
