"""Messages of a bag as they were recorded, for topics of any type that is installed here."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from rosbags.interfaces import Connection, QosDurability
from rosbags.rosbag2 import Reader

from mr_damper_ros.io.bag_files import BagError, check_bag_files
from mr_damper_ros.nodes.node_parameters import ConfigurationError

INPUTS = "inputs"
"""Stands for the topics of a test machine: those of a bag that end in one of these names."""

_INPUT_TOPICS = ("/mts/samples", "/supply/current", "/temperature")


@dataclass(frozen=True)
class RecordedTopic:
    """A topic in a bag, with the message class to publish it with."""

    name: str
    message_type: type
    latched: bool


class RecordedBag:
    """An open bag: its topics, its provenance, its messages in the order of recording.

    ``topics`` names the topics to read, separated by blanks: all where it is empty, those of the
    test machine where it is ``INPUTS``. Raises ConfigurationError where the bag cannot be read, or
    lacks a wanted topic. ``omitted`` says in sentences which topics cannot be published here and
    why.
    """

    def __init__(self, path: str, topics: str = "") -> None:
        self.path = path
        if not path:
            raise ConfigurationError("no bag is given: set the parameter bag to the path of one")
        if not Path(path).exists():
            raise ConfigurationError(f"there is no bag {path}")
        try:
            check_bag_files(Path(path), maximum_samples=None)
            self._reader = Reader(path)
            self._reader.open()
        except BagError as error:
            raise ConfigurationError(f"{path}: {error}") from error
        except Exception as error:  # a damaged file fails in many ways
            raise ConfigurationError(f"the bag {path} cannot be read: {error}") from error
        self.details: dict[str, str] = {
            str(key): str(value) for key, value in (self._custom_data() or {}).items()
        }
        self.topics: list[RecordedTopic] = []
        self.omitted: list[str] = []
        self._connections: list[Connection] = []
        recorded = {connection.topic for connection in self._reader.connections}
        wanted = recorded - {"/clock"}  # two clocks would contradict each other
        if topics == INPUTS:
            wanted = {topic for topic in recorded if topic.endswith(_INPUT_TOPICS)}
        elif topics:
            wanted = set(topics.split())
        missing = wanted - recorded
        if missing:
            raise ConfigurationError(f"the bag {path} has no topic {', '.join(sorted(missing))}")
        for connection in self._reader.connections:
            if connection.topic in wanted:
                self._add(connection)
        if not self._connections or not self._reader.message_count:
            reasons = "; ".join(self.omitted) or "it is empty"
            raise ConfigurationError(f"the bag {path} has nothing to play: {reasons}")

    @property
    def message_count(self) -> int:
        """Number of messages of the topics in ``topics``."""
        return sum(connection.msgcount for connection in self._connections)

    @property
    def duration(self) -> float:
        """Time [s] from the first message to the last."""
        return float(self._reader.duration * 1e-9)

    def messages(self) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time of recording [ns] and serialised message of each message."""
        for connection, stamp, data in self._reader.messages(self._connections):
            yield connection.topic, stamp, data

    def close(self) -> None:
        """Close the bag."""
        self._reader.close()

    def _custom_data(self) -> dict[str, Any] | None:
        return self._reader.storage.metadata.custom

    def _add(self, connection: Connection) -> None:
        problem = _definition_problem(connection)
        if problem:
            self.omitted.append(f"{connection.topic} is left out: {problem}")
            return
        self._connections.append(connection)
        if connection.topic not in (topic.name for topic in self.topics):
            package, _, name = connection.msgtype.split("/")
            message_type = getattr(import_module(f"{package}.msg"), name)
            latched = any(
                profile.durability is QosDurability.TRANSIENT_LOCAL
                for profile in connection.ext.offered_qos_profiles
            )
            self.topics.append(RecordedTopic(connection.topic, message_type, latched))


def _definition_problem(connection: Connection) -> str:
    """Why messages of this type cannot be published here; empty where they can."""
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
        return f"it was recorded with another definition of {connection.msgtype}"
    return ""
