"""Records everything that a replay of a run needs into a bag, while the nodes run."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mr_damper_msgs.msg import (
    CurrentCommand,
    DamperParameters,
    DesiredForce,
    ExcitationCommand,
    FitReport,
    MtsSamples,
    PredictedForce,
    SupplyCurrent,
)
from rclpy.node import Node
from sensor_msgs.msg import Temperature

from mr_damper_ros.io.bag_writer import BagStream
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.command_topic import COMMAND_TOPIC, DEMAND_TOPIC, EXCITATION_TOPIC

_TOPICS: tuple[tuple[type, str], ...] = (
    (MtsSamples, "mts/samples"),
    (SupplyCurrent, "supply/current"),
    (Temperature, "temperature"),
    (PredictedForce, "damper/predicted_force"),
    (FitReport, "damper/fit_report"),
    (DamperParameters, "damper/parameters"),
    (CurrentCommand, COMMAND_TOPIC),
    (DesiredForce, DEMAND_TOPIC),
    (ExcitationCommand, EXCITATION_TOPIC),
)


class BagRecorder:
    """One recording, from its creation until it is closed; messages are written in serialised form.

    ``failure`` gives the reason if the recording stopped by itself. Raises OSError if the folder
    cannot be written.
    """

    def __init__(self, node: Node, folder: Path, details: Mapping[str, str]) -> None:
        plain = re.sub(r"[^\w.+-]+", "_", details["name"]).strip("._")[:60] or "run"
        self.path = folder / f"{time.strftime('%Y%m%d_%H%M%S')}_{plain}"
        self.failure = ""
        self._node = node
        names = {topic: node.resolve_topic_name(topic) for _, topic in _TOPICS}
        kinds = {
            names[topic]: f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"
            for kind, topic in _TOPICS
        }
        self._bag = BagStream(self.path, kinds, details)
        self._subscriptions = [
            node.create_subscription(
                kind,
                topic,
                lambda data, name=names[topic]: self._write(name, data),
                quality.latched() if kind is DamperParameters else quality.stream(),
                raw=True,
            )
            for kind, topic in _TOPICS
        ]

    def _write(self, topic: str, data: Any) -> None:
        if self.failure:
            return
        try:
            self._bag.write(topic, self._node.get_clock().now().nanoseconds, bytes(data))
        except OSError as error:
            self.failure = error.strerror or str(error)

    def close(self) -> None:
        """End the recording; the finished bag is at ``path``. Raises OSError."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._bag.close()
