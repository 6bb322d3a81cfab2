"""Bag contents as rosbags' own reader and the bag metadata give them, for tests of the writer."""

from pathlib import Path
from typing import Any, NamedTuple

import yaml
from rosbags.highlevel import AnyReader


class Message(NamedTuple):
    """One serialised message and the bag time [ns] it was written at."""

    topic: str
    message_type: str
    time_ns: int
    data: bytes


def messages(bag: Path, topic: str = "") -> list[Message]:
    """Messages of a bag, or of one topic in it, in the order of their bag time."""
    with AnyReader([bag]) as reader:
        return [
            Message(connection.topic, connection.msgtype, time_ns, bytes(data))
            for connection, time_ns, data in reader.messages()
            if topic in ("", connection.topic)
        ]


def information(bag: Path) -> dict[str, Any]:
    """The bag's metadata file."""
    metadata = yaml.safe_load((bag / "metadata.yaml").read_text(encoding="utf-8"))
    return dict(metadata["rosbag2_bagfile_information"])
