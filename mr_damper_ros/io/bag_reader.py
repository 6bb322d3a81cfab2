"""Recordings from bags; needs rosbags, but not ROS."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
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
    OpenBag,
    opened_bag,
)
from mr_damper_ros.io.columns import MAXIMUM_SAMPLES
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
        # earlier jumps and consecutive blocks; a round has the first stamp [ns] of the current
        # after a jump, and the current held until the next jump.
        segments: list[tuple[int, list[SampleBlock]]] = []
        rounds: list[tuple[int, ZeroOrderHold]] = []
        celsius: list[TemperatureReading] = []
        grid, blocks = UniformGrid(hold_back=_HOLD_BACK), 0
        for item in _items(bag, maximum_samples):
            if isinstance(item, SampleBlock):
                blocks += 1
                _place(segments, grid.follow(item))
            elif isinstance(item, TemperatureReading):
                celsius.append(item)
            else:
                _hold(bag.name, rounds, item)
        _place(segments, grid.flush())
        name, details = bag.details.pop("name", bag.name), dict(bag.details)
    if not blocks:
        raise BagError(f"the bag '{bag.name}' holds no samples: the topic {MTS_TOPIC} is empty")
    if not rounds:
        raise BagError(
            f"the bag '{bag.name}' holds no current: the topic {CURRENT_TOPIC} is empty; "
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


def bag_stream(path: str | Path, *, maximum_samples: int = MAXIMUM_SAMPLES) -> Iterator[StreamItem]:
    """The messages of the test machine in a bag, in the order in which they were recorded.

    Topics may be in any namespace, as in :func:`read_bag`. Raises BagError if the bag is damaged,
    has more than ``maximum_samples``, or lacks a stream.
    """
    with opened_bag(path, maximum_samples) as bag:
        yield from _items(bag, maximum_samples)


def _items(bag: OpenBag, maximum_samples: int) -> Iterator[StreamItem]:
    samples = bag.topic(MTS_TOPIC, SAMPLES_TYPE)
    current = bag.topic(CURRENT_TOPIC, CURRENT_TYPE)
    temperature = bag.topic(TEMPERATURE_TOPIC, TEMPERATURE_TYPE, required=False)
    left = maximum_samples
    for topic, message in bag.decoded({samples, current, temperature} - {""}):
        stamp = message.header.stamp
        stamp_ns = int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)
        if topic == current:
            yield CurrentReading(stamp_ns, float(message.current))
        elif topic == temperature:
            yield TemperatureReading(stamp_ns, float(message.temperature))
        else:
            block = _block(message, stamp_ns, bag.name, topic)
            left -= block.sample_count
            if left < 0:
                raise BagError(f"the bag '{bag.name}' is too large: split it with ros2 bag convert")
            yield block


def _block(message: Any, stamp_ns: int, bag: str, topic: str) -> SampleBlock:
    try:
        return SampleBlock(
            start_ns=stamp_ns,
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


def _place(segments: list[tuple[int, list[SampleBlock]]], placed: Iterable[Placed]) -> None:
    """Add blocks of the grid to the last segment, or to a new one after a discontinuity."""
    for one in placed:
        if one.kind in ("next", "bridged"):
            segments[-1][1].append(one.block)
        elif one.kind != "repeat":
            before = segments[-1][0] if segments else 0
            segments.append((before + (one.kind == "jump_back"), [one.block]))


def _hold(bag: str, rounds: list[tuple[int, ZeroOrderHold]], reading: CurrentReading) -> None:
    """Add a value of the current."""
    stamp_ns, value = reading
    last = rounds[-1][1].last_stamp_ns if rounds else None
    if last is None or stamp_ns < last - LATE_NS:
        rounds.append((stamp_ns, ZeroOrderHold(keep=math.inf)))
    try:
        rounds[-1][1].add(stamp_ns, value)
    except CurrentError as error:
        raise BagError(
            f"the bag '{bag}' cannot be used: the current on {CURRENT_TOPIC} stamped "
            f"{stamp_ns / NANOSECONDS:.3f} s is {value}"
        ) from error


def _assemble(
    name: str,
    blocks: list[SampleBlock],
    current: tuple[int, ZeroOrderHold],
    celsius: list[TemperatureReading],
    details: dict[str, str],
) -> Recording | None:
    """Recording of consecutive blocks; None if their current is unknown throughout."""
    known_ns, held = current
    displacement = np.concatenate([block.displacement for block in blocks])
    force = np.concatenate([block.force for block in blocks])
    start_ns, period = blocks[0].start_ns, blocks[0].period
    # Because of the tolerance, no sample is lost by rounding of the stamps to nanoseconds.
    unknown = math.ceil((known_ns - start_ns) / (period * NANOSECONDS) - 1e-3)
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
        current=held.at(start_ns, period, count),
        temperature=_interpolated(celsius, start_ns, period, count),
        details=details,
    )


def _interpolated(
    celsius: list[TemperatureReading], start_ns: int, period: float, count: int
) -> Array | None:
    known = sorted((stamp - start_ns, value) for stamp, value in celsius if math.isfinite(value))
    if not known:
        return None
    seconds = np.array([stamp for stamp, _ in known]) / NANOSECONDS
    return np.interp(np.arange(count) * period, seconds, [value for _, value in known])
