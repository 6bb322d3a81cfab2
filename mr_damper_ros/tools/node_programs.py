"""The installed nodes as processes of a tool, in a ROS domain of its own."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from pathlib import Path

from mr_damper_ros.processes.programs import Program, ProgramError, node_arguments


class NodeError(ValueError):
    """A node is not there, or has failed; the message says why."""


def start_node(name: str, **parameters: object) -> Program:
    """Start a node of this installation; raises NodeError where it is not built."""
    program = Path(sys.argv[0]).resolve().parent / name
    if not program.exists():
        raise NodeError(f"{program} is not there: build the package with `make setup`")
    return Program([str(program), *node_arguments(parameters)])


def check_running(running: Mapping[str, Program]) -> None:
    """Raise NodeError where a node has failed, with the end of what it said."""
    for name, program in running.items():
        if program.exit_code:
            raise NodeError(f"{name} ended with code {program.exit_code}: {program.last_words}")


def page_of(live: Program) -> str:
    """Address of the page that a node live serves; raises NodeError where it serves none."""
    try:
        live.wait_for_log("the page is at")
    except ProgramError as error:
        raise NodeError(live.last_words) from error
    found = re.search(r"the page is at (\S+)", live.log)
    assert found
    return found[1]
