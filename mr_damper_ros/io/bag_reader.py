"""Recordings from bags, with rosbags alone: ROS is not needed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mr_damper_ros.io.bag_files import (
    CURRENT_TOPIC,
    CURRENT_TYPE,
    MTS_TOPIC,
    SAMPLES_TYPE,
    TEMPERATURE_TOPIC,
    TEMPERATURE_TYPE,
    BagError,
    opened_bag,
)
from mr_damper_ros.io.columns import MAXIMUM_SAMPLES
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, BlockError, SampleBlock
from mr_damper_ros.signals.recording import (
    CurrentReading,
    Recording,
    StreamItem,
    TemperatureReading,
)
from mr_damper_ros.signals.uniform_grid import Placed, UniformGrid
from mr_damper_ros.signals.zero_order_hold import CurrentError, ZeroOrderHold

_FOREVER = 1e9
"""Seconds; longer than any recording."""

_HOLD_BACK = 1.0
"""Seconds for which blocks that overtook others wait for them: a file is in no hurry."""

_JUMP_BACK = 1.0
"""A current stamped earlier than the one before by more than this [s] opens a new round."""


def read_bag(path: str | Path, *, maximum_samples: int = MAXIMUM_SAMPLES) -> list[Recording]:
    """Read the recordings in a bag, which is a folder or a single ``.mcap`` or ``.db3`` file.

    There are several where samples are missing (for more than 0.05 s: less is bridged),
    stamps jump back, or the period changes. Topics
    are found in any namespace: ``/rig1/mts/samples`` matches ``/mts/samples``. The current holds
    from each stamp to the next; samples before its first stamp are left out. The temperature,
    where the bag has it, is interpolated. A bag with more than ``maximum_samples`` is refused.

    Raises BagError, in one sentence, where the bag is damaged or does not hold the streams.
    """
    with opened_bag(path, maximum_samples) as bag:
        samples = bag.topic(MTS_TOPIC, SAMPLES_TYPE)
        current = bag.topic(CURRENT_TOPIC, CURRENT_TYPE)
        temperature = bag.topic(TEMPERATURE_TOPIC, TEMPERATURE_TYPE, required=False)
        segments = _Segments(bag.name, samples, maximum_samples)
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
        segments.finish()
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


def bag_stream(path: str | Path, *, maximum_samples: int = MAXIMUM_SAMPLES) -> Iterator[StreamItem]:
    """The messages of the test machine in a bag, in the order in which they were recorded.

    Topics are found as by :func:`read_bag`. Raises BagError, in one sentence, where the bag is
    damaged, holds more than ``maximum_samples`` or lacks the streams.
    """
    with opened_bag(path, maximum_samples) as bag:
        samples = bag.topic(MTS_TOPIC, SAMPLES_TYPE)
        current = bag.topic(CURRENT_TOPIC, CURRENT_TYPE)
        temperature = bag.topic(TEMPERATURE_TOPIC, TEMPERATURE_TYPE, required=False)
        for topic, message in bag.decoded({samples, current, temperature} - {""}):
            if topic == samples:
                yield _block(message, bag.name, topic)
            elif topic == current:
                yield CurrentReading(_stamp_ns(message), float(message.current))
            else:
                yield TemperatureReading(float(message.temperature))


def _block(message: Any, bag: str, topic: str) -> SampleBlock:
    try:
        return SampleBlock(
            start_ns=_stamp_ns(message),
            sequence=int(message.seq),
            period=float(message.period),
            displacement=np.asarray(message.displacement, dtype=float),
            force=np.asarray(message.force, dtype=float),
        )
    except BlockError as error:
        raise BagError(
            f"the bag '{bag}' cannot be used: in the block on {topic} that "
            f"starts at sample {message.seq}, {error}"
        ) from error


def _stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * NANOSECONDS + int(message.header.stamp.nanosec)


@dataclass
class _Segment:
    """Blocks that follow each other; ``round`` counts how often time was set back before."""

    round: int
    blocks: list[SampleBlock]


class _Segments:
    def __init__(self, bag: str, topic: str, maximum_samples: int) -> None:
        self._bag, self._topic = bag, topic
        self._left = maximum_samples
        self._sequence = UniformGrid(hold_back=_HOLD_BACK)
        self._round = 0
        self.found: list[_Segment] = []

    def add(self, message: Any) -> None:
        block = _block(message, self._bag, self._topic)
        self._left -= block.sample_count
        if self._left < 0:
            raise BagError(
                f"the bag '{self._bag}' is too large: make bags of parts of it with "
                "ros2 bag convert"
            )
        for placed in self._sequence.follow(block):
            self._add(placed)

    def finish(self) -> None:
        """Take what still waits for samples that never came."""
        for placed in self._sequence.flush():
            self._add(placed)

    def _add(self, placed: Placed) -> None:
        kind = placed.continuity.kind
        if kind == "repeat":
            return
        if kind == "jump_back":
            self._round += 1
        if kind in ("next", "bridged"):
            self.found[-1].blocks.append(placed.block)
        else:
            self.found.append(_Segment(self._round, [placed.block]))


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
        last = self.rounds[-1].held.last_stamp_ns if self.rounds else None
        if last is None or stamp < last - _JUMP_BACK * NANOSECONDS:
            self.rounds.append(_Round(stamp, ZeroOrderHold(keep=_FOREVER)))
        try:
            self.rounds[-1].held.add(stamp, value)
        except CurrentError as error:
            raise BagError(
                f"the bag '{self._bag}' cannot be used: the current on {self._topic} stamped "
                f"{stamp / NANOSECONDS:.3f} s is {value}"
            ) from error


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
