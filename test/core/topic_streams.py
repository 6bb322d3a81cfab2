"""A family of streams on two topics, healthy and faulty, which drives joined topics without ROS."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from mr_damper_ros.data_check.findings import Kind
from mr_damper_ros.rig.joined_topics import JoinedTopics
from mr_damper_ros.signals.blocks import NANOSECONDS, RigBlock

EPOCH_NS = 1_700_000_000 * NANOSECONDS
TICK = 0.2
"""Time [s] between two looks, as in the nodes."""

BOTH = {"displacement": "/press/joint_states", "force": "/press/joint_states"}
TWO = {"displacement": "/press/joint_states", "force": "/cell/wrench"}


class Message(NamedTuple):
    """A value on a channel: its arrival [s], its stamp [s] and the value, None without them."""

    arrival: float
    channel: str
    stamp: float | None
    value: float | None


Messages = Sequence[Message]
Change = Callable[[Message, int, np.random.Generator], Sequence[Message]]
"""What becomes of message number k of a channel."""


def _same(message: Message, k: int, rng: np.random.Generator) -> Sequence[Message]:
    return [message]


@dataclass(frozen=True)
class TopicStream:
    """A stream of ``seconds`` at ``rate`` [Hz], sent ``speed`` times as fast as it is stamped.

    ``force`` and ``displacement`` change the messages of a channel from ``since`` [s] on.
    """

    force: Change = _same
    displacement: Change = _same
    rate: float = 200.0
    seconds: float = 3.0
    speed: float = 1.0
    since: float = 0.0
    topics: dict[str, str] = field(default_factory=lambda: TWO)
    block_size: int = 10
    publishers: Sequence[str] = ("/press",)
    frequency: float = 1.0
    amplitude: float = 0.005
    largest: float = 600.0
    noise: float = 0.0

    def messages(self, seed: int) -> list[Message]:
        """All messages in the order of their arrival."""
        rng = np.random.default_rng(seed)
        found = []
        for k in range(round(self.seconds * self.rate * self.speed)):
            time = k / self.rate
            phase = 2.0 * math.pi * self.frequency * time
            values = {
                "displacement": self.amplitude * math.sin(phase),
                "force": self.largest * math.tanh(3.0 * math.cos(phase)),
            }
            for channel, value in values.items():
                noise = self.noise * self.largest if channel == "force" else self.noise * 0.005
                value += noise * float(rng.standard_normal())
                message = Message(time / self.speed, channel, time, value)
                change = _same if message.arrival < self.since else getattr(self, channel)
                found += change(message, k, rng)
        return sorted(found, key=lambda message: message.arrival)


@dataclass
class Outcome:
    """What was found, with the time [s] of the first look that found it, and what left."""

    first: dict[Kind, float] = field(default_factory=dict)
    sentences: dict[Kind, str] = field(default_factory=dict)
    blocks: list[RigBlock] = field(default_factory=list)
    left_at: list[float] = field(default_factory=list)


def run(stream: TopicStream, seed: int = 0) -> Outcome:
    """Drive joined topics as the bridge does."""
    joined = JoinedTopics(stream.topics, stream.block_size, lambda topic: list(stream.publishers))
    outcome, look = Outcome(), TICK
    start = 1000.0
    for message in stream.messages(seed):
        while message.arrival >= look:
            for found in joined.findings(start + look):
                outcome.first.setdefault(found.kind, look)
                outcome.sentences.setdefault(found.kind, found.sentence)
            look += TICK
        now = start + message.arrival
        if message.value is None:
            joined.watch.reject(message.channel, now, "they have no field effort[0]")
            continue
        arrival_ns = EPOCH_NS + round(message.arrival * NANOSECONDS)
        stamp_ns = 0
        if message.stamp is not None:
            stamp_ns = EPOCH_NS + round(message.stamp * NANOSECONDS)
        joined.arrive(message.channel, now, arrival_ns, stamp_ns, message.value)
        if message.channel == "displacement":
            continue
        for block in joined.take():
            if block.sample_count:
                joined.watch.leave(now, block.period, block.displacement, block.force)
                outcome.blocks.append(block)
                outcome.left_at.append(message.arrival)
    return outcome


def delayed(least: float, most: float) -> Change:
    """Delays that vary slowly between two limits [s], as on a loaded network."""

    def change(message: Message, k: int, rng: np.random.Generator) -> Sequence[Message]:
        swing = abs(math.sin(0.7 * message.arrival))
        return [message._replace(arrival=message.arrival + least + (most - least) * swing)]

    return change


def valued(value: Callable[[float], float | None]) -> Change:
    """Another value."""
    return lambda message, k, rng: [
        message._replace(value=None if message.value is None else value(message.value))
    ]


def stamped(stamp: Callable[[float], float | None]) -> Change:
    """Another stamp."""
    return lambda message, k, rng: [
        message._replace(stamp=None if message.stamp is None else stamp(message.stamp))
    ]


def jittered(periods: float, rate: float) -> Change:
    """Stamps with a uniform error of up to so many periods."""
    return lambda message, k, rng: [
        message._replace(stamp=(message.stamp or 0.0) + float(rng.uniform(-1, 1)) * periods / rate)
    ]


def lost(part: float) -> Change:
    """A part of the messages is lost."""
    return lambda message, k, rng: [] if rng.random() < part else [message]


def silent(begin: float = 0.0, end: float = math.inf) -> Change:
    """Nothing is sent between two times [s]."""
    return lambda message, k, rng: [] if begin <= message.arrival < end else [message]


def later(seconds: float) -> Change:
    """The publisher starts so much later [s]."""
    return silent(0.0, seconds)


def again(times: int) -> Change:
    """The same message is sent several times."""
    return lambda message, k, rng: [message] * times


def beside(other: Callable[[Message], Message], every: int) -> Change:
    """A second publisher sends a message for one in so many."""
    return lambda message, k, rng: [message, other(message)] if k % every == 0 else [message]


def leaping(by: float | None, at: float = 3.0, lasts: float = math.inf) -> Change:
    """The stamps leap by a time [s] (None: they freeze) at a time, for so long."""

    def change(message: Message, k: int, rng: np.random.Generator) -> Sequence[Message]:
        stamp = message.stamp or 0.0
        if not at <= message.arrival < at + lasts:
            return [message]
        return [message._replace(stamp=at if by is None else stamp + by)]

    return change


def _zeros(message: Message) -> Message:
    return message._replace(stamp=(message.stamp or 0.0) + 0.0025, value=0.0)


def _without_field(message: Message) -> Message:
    return message._replace(value=None)


NAN = valued(lambda _: math.nan)
GROUPED = stamped(lambda stamp: math.floor(stamp * 20.0) / 20.0)
TWO_NODES = ("/joint_state_broadcaster", "/joint_state_publisher")

FAULTY: dict[str, tuple[TopicStream, Kind]] = {
    "force not a number": (TopicStream(force=NAN, topics=BOTH), Kind.NOT_FINITE),
    "displacement not a number": (TopicStream(displacement=NAN), Kind.NOT_FINITE),
    "force stamped by simulated time": (
        TopicStream(force=stamped(lambda stamp: stamp + 10.0 - EPOCH_NS * 1e-9)),
        Kind.CLOCKS_APART,
    ),
    "force stamped three seconds late": (
        TopicStream(force=stamped(lambda stamp: stamp + 3.0)),
        Kind.CLOCKS_APART,
    ),
    "zeros mixed in": (
        TopicStream(displacement=beside(_zeros, 20), publishers=TWO_NODES),
        Kind.SEVERAL_PUBLISHERS,
    ),
    "zeros as often as values": (
        TopicStream(displacement=beside(_zeros, 1), publishers=TWO_NODES),
        Kind.SEVERAL_PUBLISHERS,
    ),
    "stamps in groups": (
        TopicStream(displacement=GROUPED, force=GROUPED),
        Kind.GROUPED_STAMPS,
    ),
    "force stamps in groups": (TopicStream(force=GROUPED, topics=BOTH), Kind.GROUPED_STAMPS),
    "stamps frozen": (
        TopicStream(force=leaping(None, 0.0), displacement=leaping(None, 0.0)),
        Kind.FROZEN_STAMPS,
    ),
    "no stamps": (TopicStream(force=stamped(lambda _: None)), Kind.NO_STAMPS),
    "force never sent": (TopicStream(force=silent()), Kind.CHANNEL_SILENT),
    "displacement never sent": (TopicStream(displacement=silent()), Kind.CHANNEL_SILENT),
    "millimetres": (TopicStream(displacement=valued(lambda x: 1e3 * x)), Kind.UNIT),
    "kilonewtons": (TopicStream(force=valued(lambda f: 1e-3 * f)), Kind.UNIT),
    "millinewtons": (TopicStream(force=valued(lambda f: 1e4 * f)), Kind.UNIT),
    "no such field": (TopicStream(force=valued(lambda _: None)), Kind.UNUSABLE),
    "most forces lost": (TopicStream(displacement=lost(0.9)), Kind.UNPUBLISHED),
}
"""Streams that arrive and are not, or not rightly, published: each with its cause."""

LATER = {
    f"{name}, later": (replace(stream, since=4.0, seconds=7.0), kind)
    for name, (stream, kind) in FAULTY.items()
} | {
    "stamps frozen, later": (
        TopicStream(leaping(None, 4.0), leaping(None, 4.0), since=4.0, seconds=7.0),
        Kind.FROZEN_STAMPS,
    )
}
"""The same causes in streams that are healthy at first."""

HEALTHY: dict[str, TopicStream] = {
    "plain": TopicStream(),
    "one topic": TopicStream(topics=BOTH),
    "50 Hz": TopicStream(rate=50.0),
    "20 Hz": TopicStream(rate=20.0, seconds=15.0),
    "1 kHz": TopicStream(rate=1000.0, seconds=5.0),
    "rate 0.2": TopicStream(rate=50.0, speed=0.2, seconds=40.0),
    "rate 5": TopicStream(speed=5.0),
    "jitter": TopicStream(force=jittered(0.4, 200.0), displacement=jittered(0.4, 200.0)),
    "losses": TopicStream(force=lost(0.05), displacement=lost(0.05)),
    "delays": TopicStream(force=delayed(0.03, 0.15), seconds=15.0),
    "a pause": TopicStream(
        force=silent(3.0, 8.0), displacement=silent(3.0, 8.0), seconds=14.0, topics=BOTH
    ),
    "a pause of two topics": TopicStream(
        force=silent(3.0, 8.0), displacement=silent(3.0, 8.0), seconds=14.0
    ),
    "force starts later": TopicStream(force=later(1.2)),
    "at rest": TopicStream(amplitude=0.0, largest=2.0, noise=1e-3),
    "at rest, a restarted node": TopicStream(
        amplitude=0.0, largest=2.0, noise=1e-3, publishers=("/press", "/press")
    ),
    "a restarted node": TopicStream(publishers=("/press", "/press"), noise=1e-3),
    "slow": TopicStream(frequency=0.05, seconds=15.0, noise=1e-3),
    "fast": TopicStream(frequency=20.0, amplitude=0.001, rate=500.0),
    "long blocks": TopicStream(block_size=400, seconds=12.0),
    "sent five times": TopicStream(force=again(5), displacement=again(5)),
    "other joints on the topic": TopicStream(displacement=beside(_without_field, 1)),
    "noise": TopicStream(noise=0.05),
}
"""Streams of which nothing is to be said."""

LEAPS: dict[str, Change] = {
    "one second ahead": leaping(1.0),
    "one second back": leaping(-1.0),
    "half a second back": leaping(-0.5),
    "an hour ahead": leaping(3600.0),
    "an hour back": leaping(-3600.0),
    "frozen for three seconds": leaping(None, lasts=3.0),
    "back to zero": leaping(-EPOCH_NS * 1e-9),
}
"""Leaps of the stamps of both topics after three seconds, each to be said once."""
