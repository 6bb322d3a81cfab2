"""Programs that benchmarks start beside the nodes: ``python -m benchmarks.helper_programs NAME``.

relay            publishes each block's force again as a predicted force
command-relay    publishes a command of no current for each block
send-current A   commands a current twenty times a second, until it is stopped
view URL N       sends the requests of N browsers to a page

The relays do the minimum work of a node. They are the reference for the latency of the model and of
the controller, with the same messages and quality of service, on the default executor of rclpy.
"""

from __future__ import annotations

import http.client
import itertools
import json
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from urllib.parse import urlsplit

RELAY_SAMPLES, RELAY_FORCE, RELAY_COMMAND = "relay/samples", "relay/force", "relay/current_command"


def _relay(kind: str, topic: str) -> None:
    """Answer each block with its force or with a command, until a signal arrives."""
    import rclpy
    from mr_damper_msgs.msg import CurrentCommand, MtsSamples, PredictedForce
    from rclpy.executors import ExternalShutdownException
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    from mr_damper_ros.nodes.quality import use_profile

    quality = QoSProfile(reliability=ReliabilityPolicy.RELIABLE, depth=1000)
    use_profile()
    rclpy.init()
    node = rclpy.create_node(kind)
    message_type = CurrentCommand if topic == RELAY_COMMAND else PredictedForce
    publisher = node.create_publisher(message_type, topic, quality)

    def answer(message: MtsSamples) -> None:
        if message_type is CurrentCommand:
            publisher.publish(CurrentCommand(header=message.header, current=0.0))
            return
        publisher.publish(
            PredictedForce(
                header=message.header,
                seq=message.seq,
                period=message.period,
                force=message.force,
                parameter_set="relay",
                sample_doubts=bytes(len(message.force)),
                valid=True,
            )
        )

    node.create_subscription(MtsSamples, RELAY_SAMPLES, answer, quality)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def _send_current(current: str) -> None:
    from mr_damper_msgs.msg import CurrentCommand

    from mr_damper_ros.nodes.messages import header
    from mr_damper_ros.nodes.observer import Observer

    with Observer("current_sender") as observer:
        publisher = observer.node.create_publisher(CurrentCommand, "supply/current_command", 10)
        while True:
            now_ns = observer.node.get_clock().now().nanoseconds
            publisher.publish(
                CurrentCommand(header=header(now_ns, "damper"), current=float(current))
            )
            time.sleep(0.05)


class Viewer(threading.Thread):
    """Requests new data of the page as a browser does, until the page is gone."""

    def __init__(self, address: str) -> None:
        super().__init__(daemon=True)
        self._connection = http.client.HTTPConnection(urlsplit(address).netloc, timeout=30.0)
        self._has: dict[str, tuple[str, int]] = {}
        self._window = 0

    def run(self) -> None:
        """Ask for signals every 0.1 s, less often for samples, windows and their tables."""
        began = time.monotonic()
        for turn in itertools.count(1):
            try:
                self._ask("signals")
                if turn % 5 in (1, 3):
                    self._ask("samples")
                if turn % 5 == 1:
                    before = self._window
                    if self.windows() > before:
                        for table in ("windows", "coefficients", "parameters", "history"):
                            self._ask(table)
            except (OSError, http.client.HTTPException):
                return
            time.sleep(max(began + 0.1 * turn - time.monotonic(), 0.0))

    def windows(self) -> int:
        """Number of the newest window that the page has."""
        told = json.loads(self._get(f"/status?windows={self._window}")[1])
        if told["windows"]:
            self._window = told["windows"][-1]["number"]
        return self._window

    def _ask(self, table: str) -> None:
        generation, last = self._has.get(table, ("-1", -1))
        answer, body = self._get(f"/tables/{table}?after={last}&generation={generation}")
        if body:
            rows = memoryview(body).cast("d")
            width = answer.headers["X-Columns"].count(",") + 1
            self._has[table] = (answer.headers["X-Generation"], int(rows[len(rows) - width]))

    def _get(self, path: str) -> tuple[http.client.HTTPResponse, bytes]:
        self._connection.request("GET", path, headers={"User-Agent": "viewer", "Accept": "*/*"})
        answer = self._connection.getresponse()
        return answer, answer.read()


def _view(address: str, count: str) -> None:
    viewers = [Viewer(address) for _ in range(int(count))]
    for viewer in viewers:
        viewer.start()
    for viewer in viewers:
        viewer.join()


_PROGRAMS: dict[str, Callable[..., None]] = {
    "relay": partial(_relay, "relay", RELAY_FORCE),
    "command-relay": partial(_relay, "command_relay", RELAY_COMMAND),
    "send-current": _send_current,
    "view": _view,
}

if __name__ == "__main__":
    _PROGRAMS[sys.argv[1]](*sys.argv[2:])
