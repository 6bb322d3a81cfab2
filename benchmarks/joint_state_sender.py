"""Publishes samples as joint states, one each, as ros2_control does: BAG, or COUNT RATE.

The samples of a bag go out as fast as they are taken, with their stamps; a count goes out at its
rate [Hz], each sample with its number as position [um]. Waits for a subscriber first, and stays
until it is ended, so that nothing is lost at the end.
"""

from __future__ import annotations

import sys
import time

import numpy as np
from sensor_msgs.msg import JointState

from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import header
from mr_damper_ros.nodes.observer import Observer
from mr_damper_ros.signals.recording import Recording

TOPIC = "press/joint_states"
JOINT = "rod"
_AT_ONCE = 100


def counted(count: int, rate: float) -> Recording:
    """Samples that tell their number, from now on."""
    numbers = np.arange(count, dtype=np.float64)
    return Recording("count", time.time_ns(), 1.0 / rate, 1e-6 * numbers, numbers, np.zeros(count))


def main() -> None:
    """Send, and stay until the process is ended."""
    arguments = sys.argv[1:]
    paced = len(arguments) == 2
    with Observer("press") as observer:
        publisher = observer.node.create_publisher(JointState, TOPIC, quality.stream())
        observer.wait_for_subscribers(TOPIC)
        if paced:
            run = counted(int(arguments[0]), float(arguments[1]))
        else:
            (run,) = read_bag(arguments[0])
        began = time.monotonic()
        for k, (position, effort) in enumerate(
            zip(run.displacement.tolist(), run.force.tolist(), strict=True)
        ):
            if paced:
                time.sleep(max(began + k * run.period - time.monotonic(), 0.0))
            publisher.publish(
                JointState(
                    header=header(run.stamp_ns(k), "press"),
                    name=[JOINT],
                    position=[position],
                    effort=[effort],
                )
            )
            if not paced and k % _AT_ONCE == 0:
                # What is played faster than it happened must not overrun the queue.
                publisher.wait_for_all_acked()
        print("all sent", file=sys.stderr, flush=True)
        while True:
            time.sleep(1.0)


if __name__ == "__main__":
    main()
