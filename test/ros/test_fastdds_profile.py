"""The Fast DDS profile, with which a killed node is quickly replaced."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROFILE = Path(__file__).parents[2] / "config" / "fastdds.xml"

PROGRAM = """
import pathlib, rclpy
from std_msgs.msg import Empty
rclpy.init()
node = rclpy.create_node("node")
node.create_subscription(Empty, "topic", print, 1)
node.create_publisher(Empty, "other", 1)
print(pathlib.Path("/proc/self/maps").read_text())
"""

QUEUE = "/dev/shm/fastrtps_port"
"""Fast DDS's shared-memory queue of a receiving process."""


def run(profile: str) -> subprocess.CompletedProcess[str]:
    """Create publisher and subscriber with a profile; returns the memory map of the process."""
    return subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={
            **os.environ,
            "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
            "FASTRTPS_DEFAULT_PROFILES_FILE": profile,
        },
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )


def test_fast_dds_finds_no_fault_with_the_profile() -> None:
    # With one unknown word, Fast DDS prints an error and ignores the element.
    made = run(str(PROFILE))
    assert "XMLPARSER" not in made.stdout + made.stderr


def test_nothing_is_received_through_a_queue_that_a_killed_node_leaves_behind() -> None:
    if QUEUE not in run("").stdout:
        pytest.skip("this Fast DDS has no such queue anyway")
    assert QUEUE not in run(str(PROFILE)).stdout
