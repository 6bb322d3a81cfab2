"""Plays a bag onto its topics, with /clock: for machines without ``ros2 bag``."""

from __future__ import annotations

import json
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from rclpy.duration import Duration
from rclpy.node import Node
from rosbags.interfaces import Connection, QosDurability
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from mr_damper_ros.io.bag_reader import OpenBag, opened_bag
from mr_damper_ros.live.live_record import ENDED
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.diagnostics import ERROR, OK, WARN, Diagnostics, Finding
from mr_damper_ros.nodes.messages import to_stamp
from mr_damper_ros.nodes.node_parameters import NodeParameters
from mr_damper_ros.nodes.pacing import PacedSender, PacingSettings
from mr_damper_ros.nodes.spinning import FAILURE, SUCCESS, run
from mr_damper_ros.settings.option_table import ParameterTable, group, option, with_default

INPUTS = "inputs"
"""Value of ``topics`` that selects the topics of a test machine by the ends of their names."""


def _definition_problem(connection: Connection) -> str:
    """Reason why messages of this type cannot be published here; empty if they can."""
    package, kind, name = connection.msgtype.split("/")
    try:
        import_module(f"{package}.{kind}")
        described = Path(get_package_share_directory(package), kind, f"{name}.json")
    except (ImportError, PackageNotFoundError):
        return f"the package {package} of its type {connection.msgtype} is not installed"
    if not described.exists():
        return f"its type {connection.msgtype} is not in the installed package {package}"
    hashes = {
        entry["type_name"]: entry["hash_string"]
        for entry in json.loads(described.read_text())["type_hashes"]
    }
    if connection.digest and hashes[connection.msgtype] != connection.digest:
        return f"it was recorded with a different definition of {connection.msgtype}"
    return ""


def _message_class(connection: Connection) -> type:
    package, _, name = connection.msgtype.split("/")
    found: type = getattr(import_module(f"{package}.msg"), name)
    return found


@dataclass(frozen=True)
class _Pacing(PacingSettings):
    wait_for_subscribers: int = with_default(PacingSettings, "wait_for_subscribers", 1)


@dataclass(frozen=True)
class ReplayParameters(ParameterTable):
    """Parameters of the replay node.

    It publishes the messages of a bag, unchanged, on their recorded topics, and the bag's time on
    /clock. Remapping changes the topics (``-r /mts/samples:=/left/mts/samples``). The node ends
    when all subscribers have received the last message. The services ~/pause, ~/resume and ~/step
    control it.
    """

    bag: str = option("", "Path of the bag to play: a folder or a file.")
    topics: str = option(
        "",
        f"Topics to play, as recorded, separated by blanks; {INPUTS}: only topics of the test "
        "machine, in any namespace; empty: all except /clock.",
    )
    pacing: _Pacing = group(_Pacing, flat=True)
    loop: bool = option(
        False,
        "Whether to repeat the bag for ever. Stamps and /clock jump back to the beginning at each "
        "repetition; identifier and model detect this, restart their windows and keep the "
        "parameters.",
    )
    start_paused: bool = option(
        False,
        "Whether to wait at the first message for ~/resume or ~/step, which plays one message.",
    )


class ReplayNode(Node):  # type: ignore[misc]
    """Publishes the messages of a bag, unchanged, when they are due."""

    def __init__(self) -> None:
        super().__init__("replay")
        self.parameters = NodeParameters(self, ReplayParameters)
        values = self.parameters.values
        self._opened = ExitStack()
        self._connections: list[Connection] = []
        self._omitted: list[str] = []
        self._bag = self._open(values.bag, values.topics)
        log = self.get_logger()
        for sentence in self._omitted:
            log.warning(sentence)
        provenance = "; ".join(f"{key}: {value}" for key, value in self._bag.details.items())
        count = sum(connection.msgcount for connection in self._connections)
        log.info(
            f"playing {values.bag}: {count} messages, {self._bag.files.duration * 1e-9:.3g} s"
            f"{'; ' + provenance if provenance else ''}"
        )
        latched = {
            connection.topic
            for connection in self._connections
            for profile in connection.ext.offered_qos_profiles
            if profile.durability is QosDurability.TRANSIENT_LOCAL
        }
        self._sender = PacedSender(
            self,
            values.pacing,
            {connection.topic: _message_class(connection) for connection in self._connections},
            latched=latched,
            paused=values.start_paused,
        )
        self._clock_publisher = self.create_publisher(Clock, "/clock", 10)
        # A message each 10 ms, in the computer's time or the bag's, whichever is less.
        self._clock_step_ns = round(10_000_000 * max(values.pacing.rate, 1.0))
        self._sent = 0
        self._rounds = 0
        self._others: list[str] = []
        for name in ("pause", "resume", "step"):
            self.create_service(Trigger, f"~/{name}", partial(self._steer, name))
        self._diagnostics = Diagnostics(self, {"replay": self._find})
        self._sender.start(self._send)

    def _open(self, path: str, topics: str) -> OpenBag:
        """Open a bag, and choose its topics that can be published here.

        Raises ValueError if the bag cannot be read or lacks a requested topic.
        """
        if not path:
            raise ValueError("no bag is given: set the parameter bag to the path of a bag")
        bag = self._opened.enter_context(opened_bag(path, maximum_samples=None))
        recorded = {connection.topic for connection in bag.files.connections}
        wanted = recorded - {"/clock"}  # there must be only one clock
        if topics == INPUTS:
            ends = ("/mts/samples", "/supply/current", "/temperature")
            wanted = {topic for topic in recorded if topic.endswith(ends)}
        elif topics:
            wanted = set(topics.split())
        missing = wanted - recorded
        if missing:
            raise ValueError(f"the bag {path} has no topic {', '.join(sorted(missing))}")
        for connection in bag.files.connections:
            if connection.topic in wanted:
                problem = _definition_problem(connection)
                if problem:
                    self._omitted.append(f"{connection.topic} is omitted: {problem}")
                else:
                    self._connections.append(connection)
        if not self._connections:
            reasons = "; ".join(self._omitted) or "it is empty"
            raise ValueError(f"the bag {path} has nothing to play: {reasons}")
        return bag

    def destroy_node(self) -> None:
        """Stop sending before the publishers are destroyed."""
        self._sender.stop()
        self._opened.close()
        super().destroy_node()

    # --- sending, in its own thread -----------------------------------------------------------

    def _send(self) -> None:
        self._find_others()
        while True:
            self._sender.state = "plays"
            if not self._play_once():
                return
            self._rounds += 1
            if not self.parameters.values.loop:
                break
            self._sender.begin(None)
            self.get_logger().info("the bag starts again: stamps and /clock jump back")
        self._sender.state = "waiting until the subscribers have received the last message"
        self._sender.wait_for_acknowledgements()
        self.get_logger().info(f"end of the bag: {self._sent} messages were sent")

    def _find_others(self) -> None:
        """Warn of topics that another node also publishes; subscribers would receive a mixture."""
        own = self.get_fully_qualified_name()
        for topic in (each.topic_name for each in self._sender.publishers.values()):
            for name in sorted({*quality.publishing_nodes(self, topic)} - {own}):
                sentence = f"{topic} is also published by {name}: choose other topics to play"
                self._others.append(sentence)
                self.get_logger().warning(sentence)

    def _play_once(self) -> bool:
        tick: int | None = None
        for connection, stamp, data in self._bag.files.messages(self._connections):
            tick = stamp if tick is None else tick
            # The clock also advances between messages, but never beyond the next one.
            while tick <= stamp:
                if not self._sender.wait_until(tick, is_step=False):
                    return False
                self._clock_publisher.publish(Clock(clock=to_stamp(tick)))
                tick += self._clock_step_ns
            if not self._sender.wait_until(stamp):
                return False
            self._sender.publish(connection.topic, data)
            self._sent += 1
        return True

    # --- control ------------------------------------------------------------------------------

    def _steer(
        self, asked: str, _: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        sender = self._sender
        response.success = asked != "step" or sender.paused
        if not response.success:
            response.message = "only a paused bag can be stepped: call ~/pause first"
        elif asked == "step":
            sender.step()
            response.message = "one more message is played"
        else:
            sender.pause(paused=asked == "pause")
            response.message = "paused" if sender.paused else "playing"
        return response

    # --- state --------------------------------------------------------------------------------

    def exit_code(self) -> int | None:
        """Return None while there is something to send, then the exit code of the replay."""
        if not self._sender.finished:
            return None
        # The last one says that the silence to follow is no fault. Destroying the publisher would
        # drop it if it has not been received.
        self._diagnostics.publish()
        self._diagnostics.publisher.wait_for_all_acked(Duration(seconds=1.0))
        return FAILURE if self._sender.failure else SUCCESS

    def _find(self) -> Finding:
        figures = {
            "bag": self.parameters.values.bag,
            "messages sent": self._sent,
            "rounds": self._rounds,
        }
        if self._sender.failure:
            return Finding(ERROR, self._sender.failure, figures)
        if self._sender.finished:
            return Finding(OK, "the recording has ended", {**figures, ENDED: "yes"})
        if self._others or self._omitted:
            return Finding(WARN, "; ".join(self._others + self._omitted), figures)
        if self._sender.paused:
            return Finding(OK, "paused: call ~/resume or ~/step", figures)
        return Finding(OK, self._sender.state, figures)


main = partial(run, ReplayNode, ReplayParameters, ended=ReplayNode.exit_code)
