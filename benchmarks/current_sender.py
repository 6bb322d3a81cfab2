"""Commands a current for ever, twenty times a second: a process that can be killed and frozen."""

from __future__ import annotations

import sys
import time

from mr_damper_msgs.msg import CurrentCommand

from mr_damper_ros.nodes.messages import header
from mr_damper_ros.nodes.observer import Observer


def main() -> None:
    """Send until the process is ended."""
    with Observer("current_sender") as observer:
        publisher = observer.node.create_publisher(CurrentCommand, "supply/current_command", 10)
        while True:
            now_ns = observer.node.get_clock().now().nanoseconds
            publisher.publish(
                CurrentCommand(header=header(now_ns, "damper"), current=float(sys.argv[1]))
            )
            time.sleep(0.05)


if __name__ == "__main__":
    main()
