"""Topics of other nodes as a source of samples: joint states, wrenches, any number with a stamp.

A press or a shaker driven by ros2_control publishes `sensor_msgs/JointState` and
`geometry_msgs/WrenchStamped`. Displacement and force may come in one message or on two topics, each
with its own stamps; they are joined at the sample times of the force.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any

from rclpy.node import Node

from mr_damper_ros.data_check.findings import Kind
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.inputs import Stream
from mr_damper_ros.nodes.messages import to_nanoseconds
from mr_damper_ros.nodes.rclpy_internals import NodeClock
from mr_damper_ros.rig.joined_topics import CHANNELS, JoinedTopics
from mr_damper_ros.rig.sources.source import Source, SourceState, StreamSettings
from mr_damper_ros.settings.option_table import ParameterTable, option
from mr_damper_ros.signals.blocks import RigBlock


@dataclass(frozen=True)
class TopicOptions(ParameterTable):
    """The topics of ``source: topics``."""

    displacement_topic: str = option("", "Topic of the displacement.")
    displacement_type: str = option(
        "sensor_msgs/JointState",
        "Message type; it must have a header, whose stamp is the time of the value.",
    )
    displacement_field: str = option(
        "position[0]",
        "Field of the message: names separated by dots, such as wrench.force.x; in brackets "
        "the index of an element or, in a joint state, the name of a joint, such as "
        "position[rod].",
    )
    displacement_scale: float = option(
        1.0, "Metres per unit of the field; negative if compression is positive."
    )
    force_topic: str = option("", "Topic of the force; empty: the topic of the displacement.")
    force_type: str = option("sensor_msgs/JointState", "Message type of the force topic.")
    force_field: str = option("effort[0]", "Field of the force, as for displacement_field.")
    force_scale: float = option(
        1.0, "Newtons per unit of the field; negative if compression is positive."
    )
    stamps: str = option(
        "clock",
        "Meaning of stamp jitter. clock: the sampling is uniform and the stamps are inaccurate; "
        "sampling: each sample was taken at the time of its stamp.",
        choices=("clock", "sampling"),
    )
    own_clocks: bool = option(
        False,
        "Whether each topic has its own clock. If so, both clocks are mapped to the clock of this "
        "computer by arrival times.",
    )
    hold_back: float = option(
        0.0,
        "Time [s] for which values wait, so that delayed values can be sorted in. Messages of one "
        "ROS topic are always in order.",
        within=(0.0, 1.0),
    )

    def objection(self) -> str:
        """Return the reason if an option is missing or invalid, or an empty string."""
        if not self.displacement_topic:
            return (
                "source is topics, but topics.displacement_topic is empty: name the topic with the "
                "displacement"
            )
        for name, scale in (("displacement", self.displacement_scale), ("force", self.force_scale)):
            if scale == 0.0:
                return f"topics.{name}_scale is 0: give the unit of the {name}, such as 0.001"
        return ""


class TopicSource(Source):
    """Samples from the topics of other nodes; the thread that spins the node receives them."""

    options = TopicOptions
    prefix = "topics."
    live = True

    def __init__(self, settings: TopicOptions, stream: StreamSettings, node: Node) -> None:
        super().__init__(settings, stream)
        self._node = node
        self._inputs: list[_Input] = []
        self._joined = self._new_join()

    def open(self) -> list[str]:
        """Subscribe; raises ValueError if a type or a field is invalid."""
        try:
            for name in CHANNELS:
                self._inputs.append(_Input(self._node, name, self.settings, self._current_join))
        except ValueError:
            self.close()
            raise
        return [f"{item.name} from {item.topic}, {item.field}" for item in self._inputs]

    def blocks(self, start_ns: int) -> Iterator[RigBlock]:
        """Yield the samples as they arrive, with the stamps of the force."""
        joined = self._joined = self._new_join()
        while True:
            made = joined.take()
            if not made[0].sample_count:
                time.sleep(0.005)
            yield from made

    def state(self) -> SourceState:
        """The counts of received, lost and unusable messages, and what is wrong."""
        absences = [found for item in self._inputs if (found := item.absence()) is not None]
        of_network = (each for each in absences if each.kind is not Kind.STOPPED)
        causes = [*of_network, *self._joined.findings(time.monotonic()), *absences]
        return SourceState(causes[0] if causes else None, self._joined.figures())

    def close(self) -> None:
        """End the subscriptions."""
        for item in self._inputs:
            item.close()
        self._inputs = []

    def _current_join(self) -> JoinedTopics:
        return self._joined

    def _new_join(self) -> JoinedTopics:
        given, node = self.settings, self._node
        topics = (given.displacement_topic, given.force_topic or given.displacement_topic)
        joined = JoinedTopics(
            dict(zip(CHANNELS, map(node.resolve_topic_name, topics), strict=True)),
            self.stream.block_size,
            partial(quality.publishing_nodes, node),
            hold_back=given.hold_back,
            own_clocks=given.own_clocks,
            sampled_at_stamps=given.stamps == "sampling",
        )
        self.watch = joined.watch
        return joined


class _Input:
    """One topic: reads the value of each received message, and passes it on."""

    def __init__(
        self, node: Node, name: str, settings: TopicOptions, joined: Callable[[], JoinedTopics]
    ) -> None:
        given = vars(settings)
        self.name, self.field = name, given[f"{name}_field"]
        self._node, self._joined = node, joined
        self._clock = NodeClock(node)
        self._scale = given[f"{name}_scale"]
        self._value = _reader(self.field, name)
        self._stream: Stream[Any] = Stream(
            node,
            _message_type(given[f"{name}_type"], name),
            given[f"{name}_topic"] or settings.displacement_topic,
            lambda message: message,
            self._take,
            # A busy computer may fall behind by more than a queue of fixed length.
            quality.lossless(),
            f"it must contain the {name}",
        )
        self.topic = self._stream.topic = self._stream.subscription.topic_name
        self.absence = self._stream.absence

    def close(self) -> None:
        """End the subscription."""
        self._node.destroy_subscription(self._stream.subscription)

    def _take(self, message: Any) -> None:
        """Pass on the value of a message, or the reason why there is none."""
        stamp_ns, now = to_nanoseconds(message.header.stamp), time.monotonic()
        try:
            value = self._scale * self._value(message)
        except (AttributeError, IndexError, ValueError, TypeError):
            reason = (
                f"they have no field {self.field} for the {self.name}: correct "
                f"topics.{self.name}_field, or let the driver fill it"
            )
            self._joined().watch.reject(self.name, now, reason)
            return
        self._joined().arrive(self.name, now, self._clock.now_ns(), stamp_ns, value)


def _reader(field: str, name: str) -> Callable[[Any], float]:
    """Return a function that reads a number from a message; raises ValueError for a bad field."""
    match = re.fullmatch(r"(\w+(?:\.\w+)*)(?:\[([^\]]+)\])?", field.strip())
    if match is None:
        raise ValueError(
            f"topics.{name}_field is '{field}': write it like position[0], effort[rod] or "
            "wrench.force.x"
        )
    path, element = match[1].split("."), match[2]

    def read(message: Any) -> float:
        value = message
        for part in path:
            value = getattr(value, part)
        if element is None:
            return float(value)
        index = int(element) if element.isdigit() else list(message.name).index(element)
        return float(value[index])

    return read


def _message_type(text: str, name: str) -> type:
    """The message type of a name such as sensor_msgs/JointState; raises ValueError."""
    package, _, kind = text.replace("/msg/", "/").partition("/")
    try:
        found: Any = getattr(import_module(f"{package}.msg"), kind)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(
            f"topics.{name}_type is '{text}', which is not an installed message type: write it "
            "like geometry_msgs/WrenchStamped"
        ) from error
    if "header" not in found.get_fields_and_field_types():
        raise ValueError(
            f"topics.{name}_type is '{text}', whose messages have no header with a stamp"
        )
    return found  # type: ignore[no-any-return]
