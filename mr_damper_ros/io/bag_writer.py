"""Writes recordings to bags; needs rosbags, but not ROS.

A bag holds the same streams as a live rig publishes. The recording time of a block is the time of
its last sample, at which the block becomes available. The current is stamped by the clock of the
samples. It is written at the start, at every change, and with every block, so that it is known for
the whole recording.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import ClassVar

from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer

from mr_damper_ros.io.bag_files import BagError
from mr_damper_ros.io.bag_messages import known_types
from mr_damper_ros.io.bag_reader import TOPICS
from mr_damper_ros.processes.files import named_errors
from mr_damper_ros.signals.blocks import NANOSECONDS, STAMP_LIMIT, SampleBlock
from mr_damper_ros.signals.recording import (
    CurrentReading,
    Recording,
    StreamItem,
    TemperatureReading,
    stream_of,
)

_FRAME = "damper"
"""Frame in the headers of all messages."""

_INFINITE = QosTime(9223372036, 854775807)

# The live publishers have the same depth, so that a fast replay loses no blocks.
_STREAM_QUALITY = Qos(
    history=QosHistory.KEEP_LAST,
    depth=1000,
    reliability=QosReliability.RELIABLE,
    durability=QosDurability.VOLATILE,
    deadline=_INFINITE,
    lifespan=_INFINITE,
    liveliness=QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=_INFINITE,
    avoid_ros_namespace_conventions=False,
)


class _McapFile:
    """An MCAP file with checksums, which the storage of rosbags does not write."""

    def __init__(self, path: Path, _compression: object) -> None:
        self.path = path / f"{path.name}.mcap"
        self._file = self.path.open("xb")
        self._mcap = McapWriter(self._file, compression=CompressionType.NONE, enable_data_crcs=True)
        self._mcap.start("ros2")
        self._schemas: dict[str, int] = {}
        self._channels: dict[int, int] = {}

    def add_msgtype(self, connection: Connection) -> None:
        self._schemas[connection.msgtype] = self._mcap.register_schema(
            connection.msgtype, "ros2msg", connection.msgdef.data.encode()
        )

    def add_connection(self, connection: Connection, quality: str) -> None:
        self._channels[connection.id] = self._mcap.register_channel(
            connection.topic,
            "cdr",
            self._schemas[connection.msgtype],
            {"offered_qos_profiles": quality},
        )

    def write(self, connection: Connection, time_ns: int, data: bytes | memoryview) -> None:
        self._mcap.add_message(self._channels[connection.id], time_ns, bytes(data), time_ns)

    def close(self, _version: int, metadata: str) -> None:
        self._mcap.add_metadata("rosbag2", {"serialized_metadata": metadata})
        self._mcap.finish()
        self._file.close()

    def abort(self) -> None:
        self._file.close()


class _Writer(Writer):
    STORAGE_PLUGINS: ClassVar = {StoragePlugin.MCAP: _McapFile}


class BagStream:
    """A bag that is written message by message in ``fresh``, and moved to ``path`` when closed.

    ``topics`` holds the message type of each topic. Raises BagError if ``path`` exists, and OSError
    if the files cannot be written.
    """

    def __init__(self, path: Path, topics: Mapping[str, str], details: Mapping[str, str]) -> None:
        _check_free(path, overwrite=False)
        self._path, self.fresh = path, path.with_name(f".{path.name}.part") / path.name
        self.fresh.parent.mkdir(parents=True)
        store = known_types()
        self._writer = _Writer(self.fresh, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()
        for key, value in details.items():
            self._writer.set_custom_data(key, value)
        self._connections = {
            topic: self._writer.add_connection(
                topic, message_type, typestore=store, offered_qos_profiles=[_STREAM_QUALITY]
            )
            for topic, message_type in topics.items()
        }

    def write(self, topic: str, time_ns: int, data: bytes) -> None:
        """Write a serialised message (CDR with its header)."""
        self._writer.write(self._connections[topic], time_ns, data)

    def close(self) -> None:
        """Close the bag and move it to its path."""
        self._writer.close()
        self.fresh.rename(self._path)
        self.fresh.parent.rmdir()


def write_bag(
    path: str | Path,
    recording: Recording,
    *,
    block_size: int = 100,
    overwrite: bool = False,
    progress: Callable[[float], None] | None = None,
) -> None:
    """Write a recording as a bag folder (MCAP, rosbag2 version 9).

    Each message holds ``block_size`` samples. The metadata of the bag hold ``recording.name`` and
    ``recording.details``. The bag has checksums and is written atomically. An existing bag is
    replaced only with ``overwrite``. ``progress`` receives the fraction that is written.

    Raises BagError if the path exists and may not be replaced, the block size is less than 1, the
    stamps are out of range, or the arguments are interchanged; raises OSError if the files cannot
    be written.
    """
    if not isinstance(recording, Recording):
        raise BagError(
            f"write_bag was given a {type(path).__name__} and a {type(recording).__name__}: give "
            "the path first, then the recording"
        )
    if block_size < 1:
        raise BagError(f"the block size is {block_size}: give at least 1 sample")
    if not 0 <= recording.start_ns <= recording.stamp_ns(recording.sample_count) < STAMP_LIMIT:
        raise BagError(
            f"'{recording.name}' starts {recording.start_ns / NANOSECONDS:.0f} s after 1970, but "
            "the stamps of messages reach from 1970 to 2038: change start_ns"
        )
    path = Path(os.path.abspath(path))
    _check_free(path, overwrite)
    topics = dict(TOPICS.values())
    if recording.temperature is None:
        del topics[TOPICS[TemperatureReading][0]]
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        fresh = Path(folder) / path.name
        bag = BagStream(fresh, topics, {"name": recording.name, **recording.details})
        with named_errors(path):
            for item in stream_of(recording, block_size):
                bag.write(*_message(item))
                if progress is not None and isinstance(item, SampleBlock):
                    progress((item.sequence + item.sample_count) / recording.sample_count)
            bag.close()
        if path.exists():
            path.rename(Path(folder) / "replaced")
        fresh.rename(path)


def _check_free(path: Path, overwrite: bool) -> None:
    if not path.exists():
        return
    if not (path / "metadata.yaml").is_file():
        raise BagError(f"{path} exists and is not a bag: choose another name")
    if not overwrite:
        raise BagError(
            f"{path} exists already: choose another name, or allow overwriting "
            "(overwrite=True, --overwrite)"
        )


def _message(item: StreamItem) -> tuple[str, int, bytes]:
    """Topic, recording time [ns] and serialised message of a block or a reading."""
    topic, kind = TOPICS[type(item)]
    stamp_ns = time_ns = item.start_ns if isinstance(item, SampleBlock) else item.stamp_ns
    if isinstance(item, SampleBlock):
        time_ns += round((item.sample_count - 1) * item.period * NANOSECONDS)
        rows = {"displacement": item.displacement, "force": item.force}
        fields: dict[str, object] = {"seq": item.sequence, "period": item.period, **rows}
    elif isinstance(item, CurrentReading):
        fields = {"current": item.current}
    else:
        fields = {"temperature": item.celsius, "variance": 0.0}
    store = known_types()
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
    stamp = store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    header = store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=_FRAME)
    message = store.types[kind](header=header, **fields)
    return topic, time_ns, bytes(store.serialize_cdr(message, kind))
