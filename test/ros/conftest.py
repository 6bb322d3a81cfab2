"""Fixtures of the tests over real DDS."""

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

# The test modules are no package; this adds `support` to the path.
sys.path.insert(0, str(Path(__file__).parent))

pytest.importorskip("rclpy", reason="these tests need ROS")

from support import Listener, TriedProgram, installed_programs

from mr_damper_ros.nodes.quality import use_profile
from mr_damper_ros.processes.programs import RosDomain

_DOMAIN = RosDomain()
"""Locked while this process lives, so that concurrent tests use different domains."""

# Set before any context exists, and for all programs that the tests start.
os.environ.update(_DOMAIN.environment)
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"

# As the programs do, also in contexts that a test makes itself.
use_profile()

Start = Callable[..., TriedProgram]


@pytest.fixture
def start() -> Iterator[Start]:
    """Start installed programs: ``start("bridge", rate=0.0, remap={"a": "b"})``."""
    folder = installed_programs()
    running: list[TriedProgram] = []

    def starter(name: str, *arguments: str, **parameters: object) -> TriedProgram:
        program = TriedProgram(folder / name, *arguments, **parameters)
        running.append(program)
        return program

    yield starter
    for program in reversed(running):
        program.end()


@pytest.fixture
def listener() -> Iterator[Listener]:
    """A node of the test with a separate context."""
    with Listener() as node:
        yield node
