"""The profile for Fast DDS, with which a node that was killed is soon back among the others."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mr_damper_ros.processes.programs import Program

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
"""Fast DDS's queue of what one process receives through shared memory."""


def run(profile: str) -> subprocess.CompletedProcess[str]:
    """Create publisher and subscriber with a profile; returns what is in the process's memory."""
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
    # One unknown word, and Fast DDS complains and ignores what goes with it.
    made = run(str(PROFILE))
    assert "XMLPARSER" not in made.stdout + made.stderr


def test_nothing_is_received_through_a_queue_that_a_killed_node_leaves_behind() -> None:
    if QUEUE not in run("").stdout:
        pytest.skip("this Fast DDS has no such queue anyway")
    assert QUEUE not in run(str(PROFILE)).stdout


TALKER = """
import sys, time, rclpy
from std_msgs.msg import UInt32
rclpy.init()
node = rclpy.create_node("talker")
publisher = node.create_publisher(UInt32, "counted", 5000)
while publisher.get_subscription_count() == 0:
    time.sleep(0.05)
for number in range(int(sys.argv[1])):
    publisher.publish(UInt32(data=number))
    time.sleep(0.01)
time.sleep(1000.0)
"""

LISTENER = """
import sys, rclpy
from std_msgs.msg import UInt32
rclpy.init()
node = rclpy.create_node("listener")
heard = []
node.create_subscription(UInt32, "counted", lambda message: heard.append(message.data), 5000)
while heard[-1:] != [int(sys.argv[1]) - 1]:
    rclpy.spin_once(node)
    if len(heard) == 1:
        print("first", file=sys.stderr, flush=True)
print(heard == list(range(heard[0], int(sys.argv[1]))))
"""

MESSAGES = 1500
"""One every ten milliseconds: they go on after the outage."""


def test_what_the_depth_holds_survives_an_outage() -> None:
    environment = {
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "FASTRTPS_DEFAULT_PROFILES_FILE": str(PROFILE),
    }
    listener = Program([sys.executable, "-c", LISTENER, str(MESSAGES)], environment)
    talker = Program([sys.executable, "-c", TALKER, str(MESSAGES)], environment)
    try:
        listener.wait_for_log("first")
        os.kill(listener.pid, signal.SIGSTOP)
        # Seconds: longer than the lease was when all was lost that a depth of 5000 could have kept.
        time.sleep(11.0)
        os.kill(listener.pid, signal.SIGCONT)
        assert listener.wait() == 0
        assert listener.output == "True\n"
    finally:
        for program in (listener, talker):
            if program.running:
                os.kill(program.pid, signal.SIGKILL)
            program.forget()
