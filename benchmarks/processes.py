"""The installed nodes as processes of a benchmark."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import rclpy
from ament_index_python.packages import get_package_prefix
from rclpy.node import Node

from mr_damper_ros.processes.programs import Program, RosDomain, node_arguments

_PROFILES = Path(__file__).parents[1] / "config" / "fastdds.xml"
"""Fast DDS profile with which restarted nodes are found sooner; the file explains it."""


class ProfiledDomain(RosDomain):
    """A separate domain for nodes with the Fast DDS profile of the package."""

    @property
    def environment(self) -> dict[str, str]:
        """Environment variables with which a program joins the domain."""
        return {**super().environment, "FASTRTPS_DEFAULT_PROFILES_FILE": str(_PROFILES)}


def driver_node(stack: ExitStack, domain: RosDomain) -> Node:
    """A node of this process with its own context in a domain; the stack closes both."""
    context = rclpy.Context()
    with domain.entered():
        context.init()
        node = rclpy.create_node("driver", context=context)
    stack.callback(context.try_shutdown)
    stack.callback(node.destroy_node)
    return node


def start_node(program: str, domain: RosDomain, *arguments: str, **parameters: object) -> Program:
    """Start an installed node, such as "bridge", in a domain; see ``node_arguments``."""
    path = Path(get_package_prefix("mr_damper_ros")) / "lib" / "mr_damper_ros" / program
    return Program([str(path), *arguments, *node_arguments(parameters)], domain.environment)


def resident_bytes(pid: int) -> int:
    """Memory in use [B] of a process (resident set), shared libraries included."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def cpu_seconds(pid: int) -> float:
    """Processor time used so far [s] by a process, without child processes."""
    # The name of the program, in parentheses, may contain blanks.
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextmanager
def on_cores(cores: Sequence[int] | None) -> Iterator[None]:
    """Context in which started programs run on these cores only; None means any core."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, before if cores is None else cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
