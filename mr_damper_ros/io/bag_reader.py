"""The recordings in a bag; needs rosbags, but not ROS."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mr_damper_ros.io.bag_blocks import Blocks, Readings, block_of
from mr_damper_ros.io.bag_files import METADATA, BagError, BagFiles, DamageError, Progress, is_bag
from mr_damper_ros.io.bag_messages import CURRENT, SAMPLES, TEMPERATURE, decoder
from mr_damper_ros.io.columns import MAXIMUM_SAMPLES
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import (
    LATE_NS,
    NANOSECONDS,
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
    SampleBlock: ("/mts/samples", SAMPLES),
    CurrentReading: ("/supply/current", CURRENT),
    TemperatureReading: ("/temperature", TEMPERATURE),
}
"""Topic and message type of each kind of item in a stream."""

_SAMPLES, _CURRENT = (TOPICS[kind][0] for kind in (SampleBlock, CurrentReading))

_BYTES_PER_SAMPLE = 100
"""Size [B] of a message with a single sample; blocks need less per sample."""


_CHECKING = 0.3
"""Part of the reading time that the check of the files takes."""

_BETWEEN_REPORTS = 1000
"""Number of messages between two reports of the progress."""


class OpenBag:
    """An open bag: its ``files``, its ``name``, and ``details`` from its metadata."""

    def __init__(self, files: BagFiles) -> None:
        self.files = files
        self.name = files.name
        self.details = dict(files.custom)

    def topic(self, wanted: str, message_type: str, *, required: bool = True) -> str:
        """Name of the topic in the bag, in any namespace.

        Returns an empty string if the topic is missing and not required; otherwise raises BagError.
        """
        types = {connection.topic: connection.msgtype for connection in self.files.connections}
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

    def decoded(self, topics: set[str]) -> Iterator[tuple[str, int, Any]]:
        """Topic, recording time [ns] and content of all messages on these topics, in their order.

        The content is as in :func:`mr_damper_ros.io.bag_messages.decoder`. Only the definitions of
        these topics are needed. Raises BagError.
        """
        connections = [each for each in self.files.connections if each.topic in topics]
        with self._damage():
            decoders = {each.topic: decoder(each) for each in connections}
        for connection, time_ns, data in self.files.messages(connections):
            topic: str = connection.topic
            try:
                yield topic, time_ns, decoders[topic](data)
            except DamageError as error:
                with self._damage():
                    raise error

    @contextmanager
    def _damage(self) -> Iterator[None]:
        try:
            yield
        except DamageError as error:
            raise BagError(f"the bag '{self.name}' is damaged: {error}; record it again") from error


@contextmanager
def opened_bag(
    path: str | Path,
    maximum_samples: int | None = MAXIMUM_SAMPLES,
    progress: Progress | None = None,
) -> Iterator[OpenBag]:
    """Open the folder of a bag or its single file; ``progress`` receives the checked fraction.

    Raises BagError if the bag is missing, damaged, empty, or larger than ``maximum_samples`` need
    (None: no limit).
    """
    path = Path(path)
    if not path.exists():
        raise BagError(f"there is no bag at {path}")
    if not is_bag(path):
        raise BagError(
            f"{path} is not a bag: give the folder that holds {METADATA}, or its .mcap or .db3 "
            "file; mr-damper import makes a bag from a text, CSV or MAT file"
        )
    most = _BYTES_PER_SAMPLE * maximum_samples if maximum_samples else None
    with BagFiles(path, most, progress) as files:
        if files.message_count == 0:
            raise BagError(f"the bag '{files.name}' holds no messages")
        yield OpenBag(files)


def read_bag(
    path: str | Path,
    *,
    maximum_samples: int = MAXIMUM_SAMPLES,
    progress: Progress | None = None,
) -> list[Recording]:
    """Read the recordings in a bag, which is a folder or a single ``.mcap`` or ``.db3`` file.

    A new recording starts where samples are missing for more than 0.05 s, stamps jump back, or the
    period changes; shorter gaps are bridged. The sequence numbers order the blocks. Topics may be
    in any namespace: ``/rig1/mts/samples`` matches ``/mts/samples``. The current holds from each
    stamp to the next, and samples before its first stamp are omitted. The temperature is
    interpolated, if the bag has it. ``details["note"]`` says what is missing in the bag.
    ``progress`` receives the fraction that has been read.

    Raises BagError if the bag is damaged, has more than ``maximum_samples``, or lacks a stream.
    """

    def checked(fraction: float) -> None:
        if progress is not None:
            progress(_CHECKING * fraction)

    with opened_bag(path, maximum_samples, checked) as bag:
        samples, current, temperature = _topics(bag)
        blocks = Blocks(bag.name, samples)
        readings = Readings()
        celsius: list[TemperatureReading] = []
        topics = {samples, current, temperature} - {""}
        total = sum(each.msgcount for each in bag.files.connections if each.topic in topics)
        for number, (topic, time_ns, message) in enumerate(bag.decoded(topics)):
            if progress is not None and number % _BETWEEN_REPORTS == 0:
                progress(_CHECKING + (1.0 - _CHECKING) * number / total)
            if topic == samples:
                blocks.add(time_ns, message)
                if blocks.sample_count > maximum_samples:
                    raise _too_large(bag)
            elif topic == current:
                readings.add(time_ns, message)
            else:
                celsius.append(TemperatureReading(*message))
        notes = [*bag.files.notes, *bag.files.lacking(topics)]
        name, details = bag.details.pop("name", bag.name), dict(bag.details)
    if not blocks.sample_count:
        raise BagError(f"the bag '{bag.name}' holds no samples: the topic {_SAMPLES} is empty")
    if not readings.stamps:
        raise BagError(
            f"the bag '{bag.name}' holds no current: the topic {_CURRENT} is empty; "
            "record at least one message of the supply's current"
        )
    # A segment has the number of earlier jumps of the stamps and consecutive blocks; a round has
    # the current held until the next jump.
    segments: list[tuple[int, list[SampleBlock]]] = []
    grid = UniformGrid()
    for block in blocks.in_order():
        _place(segments, grid.follow(block))
    rounds = _held(bag.name, blocks.on_the_clock_of_samples(readings))
    notes += blocks.notes
    if grid.lost_samples:
        notes.append(
            f"{grid.lost_samples} samples are missing in the bag; of these, "
            f"{grid.bridged_samples} in short gaps were interpolated"
        )
    assembled = [
        _assemble(name, joined, rounds[min(number, len(rounds) - 1)], celsius, details)
        for number, joined in segments
    ]
    recordings = [recording for recording in assembled if recording is not None]
    if not recordings:
        raise BagError(
            f"all samples in the bag '{bag.name}' are older than the first current: stamp both "
            "with the same clock, and record the current from the beginning"
        )
    left = sum(b.sample_count for _, joined in segments for b in joined)
    left -= sum(recording.sample_count for recording in recordings)
    if left:
        notes.append(f"{left} samples before the first current were left out")
    if notes:
        noted = "; ".join(filter(None, [details.get("note", ""), *notes]))
        recordings = [replace(r, details={**r.details, "note": noted}) for r in recordings]
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
        samples, current, temperature = _topics(bag)
        left = MAXIMUM_SAMPLES
        for topic, _, message in bag.decoded({samples, current, temperature} - {""}):
            if topic == current:
                yield CurrentReading(*message)
            elif topic == temperature:
                yield TemperatureReading(*message)
            else:
                block = block_of(message, bag.name, topic)
                left -= block.sample_count
                if left < 0:
                    raise _too_large(bag)
                yield block


def _topics(bag: OpenBag) -> tuple[str, str, str]:
    """The topics of samples, current and temperature; the last may be empty."""
    samples, current = (bag.topic(*TOPICS[kind]) for kind in (SampleBlock, CurrentReading))
    return samples, current, bag.topic(*TOPICS[TemperatureReading], required=False)


def _too_large(bag: OpenBag) -> BagError:
    return BagError(f"the bag '{bag.name}' is too large: split it with ros2 bag convert")


def _place(segments: list[tuple[int, list[SampleBlock]]], placed: Iterable[Placed]) -> None:
    """Add blocks of the grid to the last segment, or to a new one after a discontinuity."""
    for one in placed:
        if one.kind in ("next", "bridged", "displaced"):
            segments[-1][1].append(one.block)
        elif one.kind != "repeat":
            before = segments[-1][0] if segments else 0
            segments.append((before + (one.kind == "jump_back"), [one.block]))


def _held(bag: str, readings: Iterable[tuple[int, float]]) -> list[ZeroOrderHold]:
    """The current in each round; a round ends where the stamps jump back."""
    rounds: list[ZeroOrderHold] = []
    last_ns = None
    for stamp_ns, value in readings:
        if last_ns is None or stamp_ns < last_ns - LATE_NS:
            rounds.append(ZeroOrderHold(keep=math.inf))
        try:
            rounds[-1].add(stamp_ns, value)
        except CurrentError as error:
            raise BagError(
                f"the bag '{bag}' cannot be used: the current on {_CURRENT} stamped "
                f"{stamp_ns / NANOSECONDS:.3f} s is {value}"
            ) from error
        last_ns = rounds[-1].last_stamp_ns
    return rounds


def _assemble(
    name: str,
    blocks: list[SampleBlock],
    current: ZeroOrderHold,
    celsius: list[TemperatureReading],
    details: dict[str, str],
) -> Recording | None:
    """Recording of consecutive blocks; None if their current is unknown throughout."""
    displacement, force = (
        rows[0] if len(rows) == 1 else np.concatenate(rows)
        for rows in zip(*((block.displacement, block.force) for block in blocks), strict=True)
    )
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
