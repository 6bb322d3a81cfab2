"""Bags, checked and opened, and their recordings; needs rosbags, but not ROS."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from lz4.frame import LZ4FrameFile
from mcap.records import Chunk, DataEnd, Footer
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from zstandard import ZstdDecompressor

from mr_damper_ros.io.columns import MAXIMUM_SAMPLES
from mr_damper_ros.processes.files import irregularity
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import (
    LATE_NS,
    NANOSECONDS,
    BlockError,
    CurrentError,
    SampleBlock,
    ZeroOrderHold,
)
from mr_damper_ros.signals.recording import (
    CurrentReading,
    Recording,
    StreamItem,
    TemperatureReading,
)
from mr_damper_ros.signals.uniform_grid import Placed, UniformGrid

TOPICS: dict[type, tuple[str, str]] = {
    SampleBlock: ("/mts/samples", "mr_damper_msgs/msg/MtsSamples"),
    CurrentReading: ("/supply/current", "mr_damper_msgs/msg/SupplyCurrent"),
    TemperatureReading: ("/temperature", "sensor_msgs/msg/Temperature"),
}
"""Topic and message type of each kind of item in a stream."""

_SAMPLES, _CURRENT = (TOPICS[kind][0] for kind in (SampleBlock, CurrentReading))


class BagError(ValueError):
    """An error in reading or writing a bag; the message says what to change."""


_BAG_FILES = (".mcap", ".db3")

_BYTES_PER_SAMPLE = 100
"""Size [B] of a message with a single sample; blocks need less per sample."""

_LARGEST_METADATA = 10_000_000
"""Largest size of metadata.yaml [B]."""


def check_bag_files(path: Path, maximum_samples: int | None) -> None:
    """Check that the files of a bag are readable and undamaged.

    ``path`` is a folder or a single file. Raises BagError if a file is not a regular file, because
    reading it may never end; if a checksum is wrong; or if the unpacked data exceed the size of
    ``maximum_samples`` (None: no limit).
    """
    limit = None if maximum_samples is None else _BYTES_PER_SAMPLE * maximum_samples
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    # The library reports broken links itself, and does not enter folders.
    for file in (each for each in files if each.exists() and not each.is_dir()):
        kind = irregularity(file)
        if kind:
            raise BagError(f"the bag '{path.name}' cannot be read: {file.name} is {kind}")
        if file.name == "metadata.yaml" and file.stat().st_size > _LARGEST_METADATA:
            raise BagError(
                f"the bag '{path.name}' cannot be read: its metadata.yaml has more than "
                f"{_LARGEST_METADATA // 1_000_000} MB"
            )
        if file.suffix == ".mcap":
            with failures_in_words(path.name):
                _check_mcap(file, path.name, limit)


_AFTER_SUMMARY = 12
"""Size [B] of the summary's checksum and the mark at the end of an MCAP file."""


def _check_mcap(path: Path, bag: str, maximum_bytes: int | None) -> None:
    """Check the checksums of a file and its unpacked size, which compressed chunks may misstate.

    The checksums of the chunks are checked when their messages are read. Raises BagError about the
    bag of this name if the unpacked size exceeds ``maximum_bytes``; other exceptions mean damage.
    """
    last: dict[type, Any] = {}
    unpacked = 0
    with path.open("rb") as file:
        reader = StreamReader(
            file, emit_chunks=True, validate_crcs=True, record_size_limit=path.stat().st_size
        )
        for record in reader.records:
            last[type(record)] = record
            if isinstance(record, Chunk):
                unpacked += record.uncompressed_size
                if maximum_bytes is not None and unpacked > maximum_bytes:
                    raise BagError(
                        f"the bag '{bag}' is too large: it unpacks to more than "
                        f"{maximum_bytes // 1_000_000} MB; split it with ros2 bag convert"
                    )
                _check_size(record)
        if DataEnd not in last:
            raise ValueError("the end of its data is missing")
        # The reader does not check the summary.
        footer = last[Footer]
        if footer.summary_start and footer.summary_crc:
            file.seek(footer.summary_start)
            if crc32(file.read()[:-_AFTER_SUMMARY]) != footer.summary_crc:
                raise ValueError("the checksum of its summary is wrong")


def _check_size(chunk: Chunk) -> None:
    """Raise ValueError if a compressed chunk does not unpack to its stated size."""
    if chunk.compression == "zstd":
        unpacker: Any = ZstdDecompressor().stream_reader(chunk.data, read_across_frames=True)
    elif chunk.compression == "lz4":
        unpacker = LZ4FrameFile(BytesIO(chunk.data))
    else:
        return
    # Never more is unpacked than the stated size.
    if len(unpacker.read(chunk.uncompressed_size + 1)) != chunk.uncompressed_size:
        raise ValueError("a chunk does not unpack to its stated size")


@contextmanager
def failures_in_words(name: str) -> Iterator[None]:
    """Convert the exceptions of the library to a BagError about the bag ``name``."""
    # For damaged data, the library raises exceptions of many kinds.
    try:
        yield
    except BagError:
        raise
    except Exception as error:
        told = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
        raise BagError(
            f"the bag '{name}' is damaged or incomplete: record it again, or repair it with "
            f"'mcap recover' ({told})"
        ) from error


class OpenBag:
    """An open bag; exceptions of the library become a BagError."""

    def __init__(self, name: str, reader: AnyReader) -> None:
        self.name = name
        self.reader = reader
        custom = reader.readers[0].storage.metadata.custom if reader.is2 else None
        self.details: dict[str, str] = {str(k): str(v) for k, v in (custom or {}).items()}

    def topic(self, wanted: str, message_type: str, *, required: bool = True) -> str:
        """Name of the topic in the bag, in any namespace.

        Returns an empty string if the topic is missing and not required; otherwise raises BagError.
        """
        types = {connection.topic: connection.msgtype for connection in self.reader.connections}
        found = [wanted] if wanted in types else sorted(t for t in types if t.endswith(wanted))
        if len(found) == 1 and types[found[0]] == message_type:
            return found[0]
        if not required:
            return ""
        if len(found) > 1:
            raise BagError(
                f"the bag '{self.name}' has several topics that end in {wanted} "
                f"({', '.join(found)}): make a bag with the topics of one rig by ros2 bag convert"
            )
        if found:
            raise BagError(
                f"the topic {found[0]} in the bag '{self.name}' has the type {types[found[0]]}, "
                f"not {message_type}: record that type, or convert a text or MAT file to a bag "
                "with mr-damper import"
            )
        listed = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(types.items())) or "none"
        raise BagError(
            f"the bag '{self.name}' has no topic {wanted} in any namespace with the type "
            f"{message_type}: record it; the topics of the bag are {listed}"
        )

    def decoded(self, topics: set[str]) -> Iterator[tuple[str, Any]]:
        """Topic and message of all messages on these topics, in recording order."""
        connections = [c for c in self.reader.connections if c.topic in topics]
        with failures_in_words(self.name):
            for connection, _, data in self.reader.messages(connections=connections):
                yield connection.topic, self.reader.deserialize(data, connection.msgtype)


def stamp_of(message: Any) -> int:
    """The stamp of a decoded message [ns]."""
    stamp = message.header.stamp
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


@contextmanager
def opened_bag(
    path: str | Path, maximum_samples: int | None = MAXIMUM_SAMPLES
) -> Iterator[OpenBag]:
    """Open the folder of a bag or its single file.

    Raises BagError if the bag is missing, damaged, empty, or larger than ``maximum_samples`` need
    (None: no limit).
    """
    path = Path(path)
    # The folder of a single file also holds the metadata of the bag.
    if (
        path.suffix in _BAG_FILES
        and path.is_file()
        and (path.parent / "metadata.yaml").is_file()
        and len(list(path.parent.glob(f"*{path.suffix}"))) == 1
    ):
        path = path.parent
    name = Path(os.path.abspath(path)).name.removesuffix(".mcap").removesuffix(".db3")
    if not path.exists():
        raise BagError(f"there is no bag at {path}")
    is_bag = (path / "metadata.yaml").is_file() if path.is_dir() else path.suffix in _BAG_FILES
    if not is_bag:
        raise BagError(
            f"{path} is not a bag: give the folder that holds metadata.yaml, or its .mcap or .db3 "
            "file; mr-damper import makes a bag from a text, CSV or MAT file"
        )
    check_bag_files(path, maximum_samples)
    with failures_in_words(name):
        reader = AnyReader([path])
        reader.open()
    with closing(reader):
        if reader.message_count == 0:
            raise BagError(f"the bag '{name}' holds no messages")
        with failures_in_words(name):
            bag = OpenBag(name, reader)
        yield bag


_HOLD_BACK = 1.0
"""Longest time [s], by the stamps, that a block waits for missing earlier blocks."""


def read_bag(path: str | Path, *, maximum_samples: int = MAXIMUM_SAMPLES) -> list[Recording]:
    """Read the recordings in a bag, which is a folder or a single ``.mcap`` or ``.db3`` file.

    A new recording starts where samples are missing for more than 0.05 s, stamps jump back, or the
    period changes; shorter gaps are bridged. Topics may be in any namespace: ``/rig1/mts/samples``
    matches ``/mts/samples``. The current holds from each stamp to the next, and samples before its
    first stamp are omitted. The temperature is interpolated, if the bag has it.

    Raises BagError if the bag is damaged, has more than ``maximum_samples``, or lacks a stream.
    """
    with opened_bag(path, maximum_samples) as bag:
        # The stamps jump back at each repetition of a looped replay. A segment has the number of
        # earlier jumps and consecutive blocks; a round has the current held until the next jump.
        segments: list[tuple[int, list[SampleBlock]]] = []
        rounds: list[ZeroOrderHold] = []
        celsius: list[TemperatureReading] = []
        grid = UniformGrid(hold_back=_HOLD_BACK)
        for item in _items(bag, maximum_samples):
            if isinstance(item, SampleBlock):
                _place(segments, grid.follow(item))
            elif isinstance(item, TemperatureReading):
                celsius.append(item)
            else:
                _hold(bag.name, rounds, item)
        _place(segments, grid.flush())
        name, details = bag.details.pop("name", bag.name), dict(bag.details)
    if not segments:
        raise BagError(f"the bag '{bag.name}' holds no samples: the topic {_SAMPLES} is empty")
    if not rounds:
        raise BagError(
            f"the bag '{bag.name}' holds no current: the topic {_CURRENT} is empty; "
            "record at least one message of the supply's current"
        )
    assembled = (
        _assemble(name, joined, rounds[min(number, len(rounds) - 1)], celsius, details)
        for number, joined in segments
    )
    recordings = [recording for recording in assembled if recording is not None]
    if not recordings:
        raise BagError(
            f"all samples in the bag '{bag.name}' are older than the first current: stamp both "
            "with the same clock, and record the current from the beginning"
        )
    if len(recordings) == 1:
        return recordings
    return [
        replace(recording, name=f"{name}, part {number}")
        for number, recording in enumerate(recordings, start=1)
    ]


def bag_stream(path: str | Path) -> Iterator[StreamItem]:
    """The messages of the test machine in a bag, in the order in which they were recorded.

    Topics may be in any namespace, as in :func:`read_bag`. Raises BagError if the bag is damaged,
    too large, or lacks a stream.
    """
    with opened_bag(path) as bag:
        yield from _items(bag, MAXIMUM_SAMPLES)


def _items(bag: OpenBag, maximum_samples: int) -> Iterator[StreamItem]:
    samples, current = (bag.topic(*TOPICS[kind]) for kind in (SampleBlock, CurrentReading))
    temperature = bag.topic(*TOPICS[TemperatureReading], required=False)
    left = maximum_samples
    for topic, message in bag.decoded({samples, current, temperature} - {""}):
        # A damaged definition in the bag gives messages with other fields.
        with failures_in_words(bag.name):
            stamp_ns = stamp_of(message)
            item: StreamItem
            if topic == current:
                item = CurrentReading(stamp_ns, float(message.current))
            elif topic == temperature:
                item = TemperatureReading(stamp_ns, float(message.temperature))
            else:
                item = _block(message, stamp_ns, bag.name, topic)
                left -= item.sample_count
        if left < 0:
            raise BagError(f"the bag '{bag.name}' is too large: split it with ros2 bag convert")
        yield item


def _block(message: Any, stamp_ns: int, bag: str, topic: str) -> SampleBlock:
    try:
        rows = message.displacement, message.force
        return SampleBlock(stamp_ns, int(message.seq), float(message.period), *rows)
    except BlockError as error:
        raise BagError(
            f"the bag '{bag}' cannot be used: in the block on {topic} that "
            f"starts at sample {message.seq}, {error}"
        ) from error


def _place(segments: list[tuple[int, list[SampleBlock]]], placed: Iterable[Placed]) -> None:
    """Add blocks of the grid to the last segment, or to a new one after a discontinuity."""
    for one in placed:
        if one.kind in ("next", "bridged", "displaced"):
            segments[-1][1].append(one.block)
        elif one.kind != "repeat":
            before = segments[-1][0] if segments else 0
            segments.append((before + (one.kind == "jump_back"), [one.block]))


def _hold(bag: str, rounds: list[ZeroOrderHold], reading: CurrentReading) -> None:
    stamp_ns, value = reading
    last_ns = rounds[-1].last_stamp_ns if rounds else None
    if last_ns is None or stamp_ns < last_ns - LATE_NS:
        rounds.append(ZeroOrderHold(keep=math.inf))
    try:
        rounds[-1].add(stamp_ns, value)
    except CurrentError as error:
        raise BagError(
            f"the bag '{bag}' cannot be used: the current on {_CURRENT} stamped "
            f"{stamp_ns / NANOSECONDS:.3f} s is {value}"
        ) from error


def _assemble(
    name: str,
    blocks: list[SampleBlock],
    current: ZeroOrderHold,
    celsius: list[TemperatureReading],
    details: dict[str, str],
) -> Recording | None:
    """Recording of consecutive blocks; None if their current is unknown throughout."""
    displacement = np.concatenate([block.displacement for block in blocks])
    force = np.concatenate([block.force for block in blocks])
    start_ns, period = blocks[0].start_ns, blocks[0].period
    known_ns, _ = current.around(start_ns)
    # Because of the tolerance, no sample is lost by rounding of the stamps to nanoseconds.
    first = max(math.ceil((known_ns - start_ns) / (period * NANOSECONDS) - 1e-3), 0)
    count = force.size - first
    if count <= 0:
        return None
    start_ns += round(first * period * NANOSECONDS)
    temperature = _interpolated(celsius, start_ns, period, count)
    rows = displacement[first:], force[first:], current.at(start_ns, period, count), temperature
    return Recording(name, start_ns, period, *rows, details)


def _interpolated(
    celsius: list[TemperatureReading], start_ns: int, period: float, count: int
) -> Array | None:
    known = sorted((stamp - start_ns, value) for stamp, value in celsius if math.isfinite(value))
    if not known:
        return None
    seconds = np.array([stamp for stamp, _ in known]) / NANOSECONDS
    return np.interp(np.arange(count) * period, seconds, [value for _, value in known])
