"""Recordings to bags and back, with rosbags alone: ROS is not needed.

A bag holds the streams as a live rig would have published them: blocks of samples, written at the
time of their last sample (when the block became available), and the supply's current with its
stamps on the clock of the samples: at the start, at every change, in between at a fixed period,
and once more at the end, so that the current is known for the whole recording.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, BlockError, BlockSequence, SampleBlock
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.signals.zero_order_hold import ZeroOrderHold

MTS_TOPIC = "/mts/samples"
CURRENT_TOPIC = "/supply/current"
TEMPERATURE_TOPIC = "/temperature"

SAMPLES_TYPE = "mr_damper_msgs/msg/MtsSamples"
CURRENT_TYPE = "mr_damper_msgs/msg/SupplyCurrent"
TEMPERATURE_TYPE = "sensor_msgs/msg/Temperature"

_FRAME = "damper"
"""The frame that the stamps of all messages name."""

_CURRENT_PERIOD = 0.1
"""Seconds after which a current that did not change is written again."""

_TEMPERATURE_PERIOD = 1.0

_FOREVER = 1e9
"""Seconds; longer than any recording."""

_JUMP_BACK = 1.0
"""A current stamped earlier than the one before by more than this [s] opens a new round."""

_STAMP_LIMIT = 2**31 * NANOSECONDS
"""The seconds of a stamp are a signed number of 32 bits."""

_INFINITE = QosTime(9223372036, 854775807)

# A fast replay must not lose blocks: the depth is that of the live publishers.
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


class BagError(ValueError):
    """A bag that cannot be read or written; the message says what to change."""


@dataclass(frozen=True)
class _Message:
    """One serialised message: ``data`` is what a publisher sends (CDR with its header)."""

    topic: str
    message_type: str
    time_ns: int
    data: bytes


# ---------------------------------------------------------------------------------------------
# Writing
# ---------------------------------------------------------------------------------------------


def _message_folder() -> Path:
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    folders = [Path(prefix) / "share" / "mr_damper_msgs" / "msg" for prefix in prefixes if prefix]
    folders.append(Path(__file__).resolve().parents[2] / "msg_defs" / "msg")
    for folder in folders:
        if (folder / "MtsSamples.msg").is_file():
            return folder
    raise BagError(
        "the message definitions of mr_damper_msgs are not installed: "
        "source the setup file of the workspace that holds mr_damper_msgs"
    )


@lru_cache(maxsize=1)
def _typestore() -> Any:
    store = get_typestore(Stores.ROS2_JAZZY)
    folder = _message_folder()
    for message_type in (SAMPLES_TYPE, CURRENT_TYPE):
        text = (folder / f"{message_type.rpartition('/')[2]}.msg").read_text(encoding="utf-8")
        store.register(get_types_from_msg(text, message_type))
    return store


def write_bag(
    path: str | Path,
    recording: Recording,
    *,
    block_size: int = 100,
    overwrite: bool = False,
) -> None:
    """Write a recording as a bag folder (MCAP, rosbag2 version 9).

    ``block_size`` samples go into one message. The bag's metadata carry ``recording.name`` and
    ``recording.details``. The bag appears whole or not at all; one that exists is replaced only
    with ``overwrite``.

    Raises BagError where the bag exists, is something else, or the block size is below 1, and
    OSError where the file system refuses.
    """
    if block_size < 1:
        raise BagError(f"the block size is {block_size}: give at least 1 sample")
    if not 0 <= recording.start_ns <= recording.stamp_ns(recording.sample_count) < _STAMP_LIMIT:
        raise BagError(
            f"'{recording.name}' starts {recording.start_ns / NANOSECONDS:.0f} s after 1970, and "
            "the stamps of messages reach from 1970 to 2038: give it another start"
        )
    path = Path(os.path.abspath(path))
    _check_free(path, overwrite)
    messages = [
        *_current_messages(recording),
        *_temperature_messages(recording),
        *_sample_messages(recording, block_size),
    ]
    # The order of the list decides between equal times: current first, it applies to the block.
    messages.sort(key=lambda message: message.time_ns)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        fresh = Path(folder) / path.name
        _write_messages(fresh, messages, {"name": recording.name, **recording.details})
        if path.exists():
            path.rename(Path(folder) / "replaced")
        fresh.rename(path)


def _check_free(path: Path, overwrite: bool) -> None:
    if not path.exists():
        return
    if not (path / "metadata.yaml").is_file():
        raise BagError(f"{path} exists and is not a bag: choose another name")
    if not overwrite:
        raise BagError(f"{path} exists already: choose another name or ask to overwrite it")


def _write_messages(path: Path, messages: list[_Message], details: dict[str, str]) -> None:
    store = _typestore()
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for key, value in details.items():
            writer.set_custom_data(key, value)
        connections = {
            topic: writer.add_connection(
                topic, message_type, typestore=store, offered_qos_profiles=[_STREAM_QUALITY]
            )
            for topic, message_type in sorted({(m.topic, m.message_type) for m in messages})
        }
        for message in messages:
            writer.write(connections[message.topic], message.time_ns, message.data)


def _message(
    topic: str, message_type: str, time_ns: int, stamp_ns: int, **fields: object
) -> _Message:
    store = _typestore()
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
    header = store.types["std_msgs/msg/Header"](
        stamp=store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds),
        frame_id=_FRAME,
    )
    message = store.types[message_type](header=header, **fields)
    return _Message(topic, message_type, time_ns, bytes(store.serialize_cdr(message, message_type)))


def _sample_messages(recording: Recording, block_size: int) -> Iterator[_Message]:
    for first in range(0, recording.sample_count, block_size):
        displacement = recording.displacement[first : first + block_size]
        yield _message(
            MTS_TOPIC,
            SAMPLES_TYPE,
            recording.stamp_ns(first + displacement.size - 1),
            recording.stamp_ns(first),
            seq=first,
            period=recording.period,
            displacement=displacement,
            force=recording.force[first : first + block_size],
        )


def _indices(recording: Recording, period: float, always: Iterable[int] = ()) -> list[int]:
    """Samples every ``period`` seconds, the last one, and those of ``always``."""
    step = max(round(period / recording.period), 1)
    regular = range(0, recording.sample_count, step)
    return sorted({*regular, *always, recording.sample_count - 1})


def _current_messages(recording: Recording) -> Iterator[_Message]:
    changes = (np.flatnonzero(np.diff(recording.current)) + 1).tolist()
    for index in _indices(recording, _CURRENT_PERIOD, changes):
        stamp = recording.stamp_ns(index)
        current = float(recording.current[index])
        yield _message(CURRENT_TOPIC, CURRENT_TYPE, stamp, stamp, current=current)


def _temperature_messages(recording: Recording) -> Iterator[_Message]:
    if recording.temperature is None:
        return
    for index in _indices(recording, _TEMPERATURE_PERIOD):
        stamp = recording.stamp_ns(index)
        celsius = float(recording.temperature[index])
        yield _message(
            TEMPERATURE_TOPIC, TEMPERATURE_TYPE, stamp, stamp, temperature=celsius, variance=0.0
        )


# ---------------------------------------------------------------------------------------------
# Reading
# ---------------------------------------------------------------------------------------------


def read_bag(path: str | Path) -> list[Recording]:
    """Read the recordings in a bag, which is a folder or a single ``.mcap`` or ``.db3`` file.

    There are several where samples are missing, stamps jump back, or the period changes. Topics
    are found in any namespace: ``/rig1/mts/samples`` matches ``/mts/samples``. The current holds
    from each stamp to the next; samples before its first stamp are left out. The temperature,
    where the bag has it, is interpolated.

    Raises BagError, in one sentence, where the bag is damaged or does not hold the streams.
    """
    with _opened(path) as bag:
        samples = bag.topic(MTS_TOPIC, SAMPLES_TYPE)
        current = bag.topic(CURRENT_TOPIC, CURRENT_TYPE)
        temperature = bag.topic(TEMPERATURE_TOPIC, TEMPERATURE_TYPE, required=False)
        segments = _Segments(bag.name, samples)
        currents = _Currents(bag.name, current)
        celsius: list[tuple[int, float]] = []
        wanted = {samples, current, temperature} - {""}
        for topic, message in bag.decoded(wanted):
            if topic == samples:
                segments.add(message)
            elif topic == current:
                currents.add(message)
            else:
                celsius.append((_stamp_ns(message), float(message.temperature)))
        details = dict(bag.details)
    if not segments.found:
        raise BagError(f"the bag '{bag.name}' holds no samples: the topic {samples} is empty")
    if not currents.rounds:
        raise BagError(
            f"the bag '{bag.name}' holds no current: the topic {current} is empty; "
            "record at least one message of the supply's current"
        )
    name = details.pop("name", bag.name)
    recordings = []
    for segment in segments.found:
        current_round = currents.rounds[min(segment.round, len(currents.rounds) - 1)]
        recording = _assemble(name, segment, current_round, celsius, details)
        if recording is not None:
            recordings.append(recording)
    if not recordings:
        raise BagError(
            f"every sample in the bag '{bag.name}' is older than the first current: "
            "stamp both with the same clock and record the current from the beginning"
        )
    if len(recordings) == 1:
        return recordings
    return [
        Recording(**{**vars(recording), "name": f"{name}, part {number}"})
        for number, recording in enumerate(recordings, start=1)
    ]


class _OpenBag:
    """A bag that is open; failures of the library become sentences."""

    def __init__(self, name: str, reader: AnyReader) -> None:
        self.name = name
        self._reader = reader
        custom = reader.readers[0].storage.metadata.custom if reader.is2 else None
        self.details: dict[str, str] = {str(k): str(v) for k, v in (custom or {}).items()}

    def topic(self, wanted: str, message_type: str, *, required: bool = True) -> str:
        """Name of the topic in the bag; empty where it is missing and not required."""
        types = {connection.topic: connection.msgtype for connection in self._reader.connections}
        found = [wanted] if wanted in types else sorted(t for t in types if t.endswith(wanted))
        if len(found) > 1:
            if not required:
                return ""
            raise BagError(
                f"the bag '{self.name}' has several topics that end in {wanted} "
                f"({', '.join(found)}): make a bag of the topics of one rig with ros2 bag convert"
            )
        if found and types[found[0]] == message_type:
            return found[0]
        if not required:
            return ""
        if found:
            raise BagError(
                f"the topic {found[0]} in the bag '{self.name}' carries {types[found[0]]}, "
                f"not {message_type}: record that type, or make a bag of a text or MAT file with "
                "ros2 run mr_damper_ros import_record"
            )
        listed = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(types.items())) or "none"
        raise BagError(
            f"the bag '{self.name}' has no topic {wanted}, in whatever namespace, with "
            f"{message_type}: record it; its topics are {listed}"
        )

    def decoded(self, topics: set[str]) -> Iterator[tuple[str, Any]]:
        connections = [c for c in self._reader.connections if c.topic in topics]
        with _failures_in_words(self.name):
            for connection, _, data in self._reader.messages(connections=connections):
                yield connection.topic, self._reader.deserialize(data, connection.msgtype)


@contextmanager
def _failures_in_words(name: str) -> Iterator[None]:
    # Damaged bytes surface in the library as exceptions of many kinds.
    try:
        yield
    except BagError:
        raise
    except Exception as error:
        raise BagError(
            f"the bag '{name}' is damaged or was cut off while it was written: record it again "
            f"or mend it with 'mcap recover' ({_first_line(error)})"
        ) from error


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")


@contextmanager
def _opened(path: str | Path) -> Iterator[_OpenBag]:
    path = Path(path)
    # Under its folder a file comes with the metadata of the bag.
    if (
        path.suffix in (".mcap", ".db3")
        and path.is_file()
        and (path.parent / "metadata.yaml").is_file()
        and len(list(path.parent.glob(f"*{path.suffix}"))) == 1
    ):
        path = path.parent
    name = Path(os.path.abspath(path)).name.removesuffix(".mcap").removesuffix(".db3")
    if not path.exists():
        raise BagError(f"there is no bag at {path}")
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise BagError(
            f"{path} is not a bag: give the folder that holds metadata.yaml, or the .mcap file"
        )
    if path.is_file() and path.suffix not in (".mcap", ".db3"):
        raise BagError(
            f"{path} is not a bag: give a bag's folder or its .mcap or .db3 file; "
            "import_record makes a bag from a text, CSV or MAT file"
        )
    with _failures_in_words(name):
        reader = AnyReader([path])
        reader.open()
    try:
        if reader.message_count == 0:
            raise BagError(f"the bag '{name}' holds no messages")
        with _failures_in_words(name):
            bag = _OpenBag(name, reader)
        yield bag
    finally:
        reader.close()


def _stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * NANOSECONDS + int(message.header.stamp.nanosec)


@dataclass
class _Segment:
    """Blocks that follow each other; ``round`` counts how often time was set back before."""

    round: int
    blocks: list[SampleBlock]


class _Segments:
    def __init__(self, bag: str, topic: str) -> None:
        self._bag, self._topic = bag, topic
        self._sequence = BlockSequence()
        self._round = 0
        self.found: list[_Segment] = []

    def add(self, message: Any) -> None:
        try:
            block = SampleBlock(
                start_ns=_stamp_ns(message),
                sequence=int(message.seq),
                period=float(message.period),
                displacement=np.asarray(message.displacement, dtype=float),
                force=np.asarray(message.force, dtype=float),
            )
        except BlockError as error:
            raise BagError(
                f"the bag '{self._bag}' cannot be used: in the block on {self._topic} that "
                f"starts at sample {message.seq}, {error}"
            ) from error
        verdict = self._sequence.follow(block)
        if verdict.kind == "repeat":
            return
        if verdict.kind == "jump_back":
            self._round += 1
        if verdict.kind == "next":
            self.found[-1].blocks.append(block)
        else:
            self.found.append(_Segment(self._round, [block]))


@dataclass
class _Round:
    """The held current from ``first_ns`` until time is set back."""

    first_ns: int
    held: ZeroOrderHold


class _Currents:
    """The current; a bag that was recorded from a loop has several rounds of it."""

    def __init__(self, bag: str, topic: str) -> None:
        self._bag, self._topic = bag, topic
        self.rounds: list[_Round] = []

    def add(self, message: Any) -> None:
        stamp, value = _stamp_ns(message), float(message.current)
        if not math.isfinite(value):
            raise BagError(
                f"the bag '{self._bag}' cannot be used: the current on {self._topic} stamped "
                f"{stamp / NANOSECONDS:.3f} s is {value}"
            )
        last = self.rounds[-1].held.last_stamp_ns if self.rounds else None
        if last is None or stamp < last - _JUMP_BACK * NANOSECONDS:
            self.rounds.append(_Round(stamp, ZeroOrderHold(keep=_FOREVER)))
        self.rounds[-1].held.add(stamp, value)


def _assemble(
    name: str,
    segment: _Segment,
    current: _Round,
    celsius: list[tuple[int, float]],
    details: dict[str, str],
) -> Recording | None:
    """Recording of a segment, or None where the current is not known for any of it."""
    displacement = np.concatenate([block.displacement for block in segment.blocks])
    force = np.concatenate([block.force for block in segment.blocks])
    start_ns, period = segment.blocks[0].start_ns, segment.blocks[0].period
    # Rounding of the stamps to nanoseconds must not cost a sample.
    unknown = math.ceil((current.first_ns - start_ns) / (period * NANOSECONDS) - 1e-3)
    first = max(unknown, 0)
    if first >= force.size:
        return None
    start_ns += round(first * period * NANOSECONDS)
    count = force.size - first
    return Recording(
        name=name,
        start_ns=start_ns,
        period=period,
        displacement=displacement[first:],
        force=force[first:],
        current=current.held.at(start_ns, period, count),
        temperature=_interpolated(celsius, start_ns, period, count),
        details=details,
    )


def _interpolated(
    celsius: list[tuple[int, float]], start_ns: int, period: float, count: int
) -> Array | None:
    known = sorted((stamp - start_ns, value) for stamp, value in celsius if math.isfinite(value))
    if not known:
        return None
    seconds = np.array([stamp for stamp, _ in known]) / NANOSECONDS
    return np.interp(np.arange(count) * period, seconds, [value for _, value in known])
