"""The model node beside a bare relay: both get the same blocks, each in the other's pause."""

from __future__ import annotations

import os
import struct
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

from mr_damper_msgs.msg import MtsSamples, PredictedForce, SupplyCurrent
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import deserialize_message, serialize_message

from benchmarks.helper_programs import (
    PARAMETER_SET,
    RELAY_FORCE,
    RELAY_SAMPLES,
    start_busy_loop,
    start_helper,
)
from benchmarks.processes import ProfiledDomain, driver_node, start_node
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import current_message, samples_message, to_nanoseconds
from mr_damper_ros.nodes.spinning import make_executor
from mr_damper_ros.processes.programs import PATIENCE
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock

CURRENT = 1.5
"""[A]."""

_CURRENT_EVERY = 0.1
_SILENT = 3.0
"""Seconds without an answer after which no more is waited for."""

_STAMP, _STAMP_PLACE = struct.Struct("<iI"), 4
"""Of a serialised message with a header: seconds and nanoseconds, after the encapsulation."""


def blocks_of(displacement: Array, force: Array, period: float, size: int) -> list[SampleBlock]:
    """A stream in blocks, whose stamps count from 0."""
    return [
        SampleBlock(
            round(first * period * NANOSECONDS),
            first,
            period,
            displacement[first : first + size],
            force[first : first + size],
        )
        for first in range(0, displacement.size - size + 1, size)
    ]


class Route:
    """One of the two ways for a block: the topic it is sent on, and what its answers were.

    By number of the first sample: ``latencies`` [s] from a block's publication to the arrival of
    its answer, and if ``dated`` ``ages`` [s] of its last sample when the answer was published.
    ``valid_ones`` are the numbers of the valid answers. Answers are kept as they came and read
    afterwards: this process is not to be what is late.
    """

    def __init__(self, node: Any, samples_topic: str, force_topic: str, *, dated: bool) -> None:
        self._node = node
        self._force_topic = force_topic
        self._sent: dict[int, float] = {}
        self._heard: list[tuple[bytes, float, int]] = []
        self._publisher = node.create_publisher(MtsSamples, samples_topic, quality.stream())
        hear = self._hear_dated if dated else self._hear
        node.create_subscription(PredictedForce, force_topic, hear, quality.stream(), raw=True)

    @property
    def connected(self) -> bool:
        """Whether somebody takes the blocks and answers."""
        return bool(
            self._publisher.get_subscription_count()
            and self._node.count_publishers(self._force_topic)
        )

    @property
    def subscribers(self) -> int:
        """Nodes that take the blocks."""
        return int(self._publisher.get_subscription_count())

    @property
    def answers(self) -> int:
        """Answers that have come."""
        return len(self._heard)

    @property
    def lost(self) -> int:
        """Blocks without an answer."""
        return len(self._sent.keys() - {message.seq for message, _, _ in self._read()})

    @property
    def latencies(self) -> dict[int, float]:
        """In the order of the answers."""
        return {
            message.seq: arrival - self._sent[message.seq]
            for message, arrival, _ in self._read()
            if message.seq in self._sent
        }

    @property
    def ages(self) -> dict[int, float]:
        """Of those whose publication is dated."""
        return {
            message.seq: (published_ns - to_nanoseconds(message.header.stamp)) / NANOSECONDS
            - len(message.force) * message.period
            for message, _, published_ns in self._read()
        }

    @property
    def valid_ones(self) -> set[int]:
        """Numbers of the blocks whose force is valid."""
        return {message.seq for message, _, _ in self._read() if message.valid}

    def forget(self) -> None:
        """What was sent and heard so far does not count."""
        self._sent.clear()
        self._heard.clear()

    def send(self, number: int, message: bytes) -> None:
        """Publish a block."""
        self._sent[number] = time.monotonic()
        self._publisher.publish(message)

    def _hear(self, message: bytes) -> None:
        self._heard.append((message, time.monotonic(), 0))

    def _hear_dated(self, message: bytes, way: Mapping[str, int]) -> None:
        # This process may be late itself: the middleware tells when the answer was published.
        self._heard.append((message, time.monotonic(), way["source_timestamp"]))

    def _read(self) -> Iterator[tuple[PredictedForce, float, int]]:
        for message, arrival, published_ns in self._heard:
            yield deserialize_message(message, PredictedForce), arrival, published_ns


class SideBySide:
    """A model, a relay and, if asked for, an identifier; blocks are sent from this process.

    ``cores``: where these run, with so many programs that are always ``busy``; None: anywhere.
    ``dated``: the ages of the answers are wanted, at the price of a slower executor.
    """

    def __init__(
        self,
        *,
        identifier: bool = False,
        cores: Sequence[int] | None = None,
        busy: int = 0,
        dated: bool = False,
    ) -> None:
        with ExitStack() as stack:
            domain = self.domain = stack.enter_context(closing(ProfiledDomain()))
            folder = stack.enter_context(tempfile.TemporaryDirectory())
            file = Path(folder) / "parameters.yaml"
            known = ParameterSet(
                THESIS_28_CELSIUS,
                set_id=PARAMETER_SET,
                peak_velocity_range=(0.0, 0.1),
                current_range=(0.0, 2.0),
            )
            file.write_text(known.to_yaml(), encoding="utf-8")
            with on_cores(cores):
                self._relay = start_helper("relay", environment=domain.environment)
                stack.callback(self._relay.close)
                self._model = start_node("model", domain, parameter_file=file)
                stack.callback(self._model.close)
            if identifier:
                stack.callback(start_node("identifier", domain, initial_parameters=str(file)).close)
            node = driver_node(stack, domain)
            # The events executor does not hand on when a message was published.
            make = SingleThreadedExecutor if dated else make_executor
            self._executor = make(context=node.context)
            self._executor.add_node(node)
            stack.callback(self._executor.shutdown)
            self._supply = node.create_publisher(SupplyCurrent, "supply/current", quality.stream())
            self.model = Route(node, "mts/samples", "damper/predicted_force", dated=dated)
            self.relay = Route(node, RELAY_SAMPLES, RELAY_FORCE, dated=dated)
            self._wait_for(2 if identifier else 1)
            with on_cores(cores):
                for _ in range(busy):
                    stack.callback(start_busy_loop().close)
            self._stack = stack.pop_all()

    def __enter__(self) -> SideBySide:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stack.close()

    @property
    def cpu_seconds(self) -> tuple[float, float]:
        """Processor time [s] of the model and of the relay so far."""
        return self._model.cpu_seconds, self._relay.cpu_seconds

    def send(self, blocks: Sequence[SampleBlock]) -> None:
        """Send all blocks at their time, and wait for the answers.

        The supply current comes between two blocks: it is a device of its own.
        """
        length = blocks[0].sample_count * blocks[0].period
        messages = [
            bytearray(serialize_message(samples_message(block, "damper"))) for block in blocks
        ]
        start = time.monotonic() + 1.0
        # A block is sent once its last sample has been taken.
        taken_ns = time.time_ns() + round((1.0 - length) * NANOSECONDS)
        currents = max(round(_CURRENT_EVERY / length), 1)
        for number, (block, message) in enumerate(zip(blocks, messages, strict=True)):
            stamp_ns = taken_ns + block.start_ns
            _STAMP.pack_into(message, _STAMP_PLACE, *divmod(stamp_ns, NANOSECONDS))
            due = start + length * number
            if number % currents == 0:
                self._spin_until(due - 0.25 * length)
                self._supply.publish(current_message(stamp_ns, CURRENT, "damper"))
            routes = (self.model, self.relay) if number % 2 else (self.relay, self.model)
            for place, route in enumerate(routes):
                self._spin_until(due + 0.5 * length * place)
                route.send(block.sequence, bytes(message))
        self._wait_for_answers(2 * len(blocks))

    def _wait_for_answers(self, count: int) -> None:
        last, before = time.monotonic(), self._answers
        while self._answers < count and time.monotonic() - last < _SILENT:
            self._spin_until(time.monotonic() + 0.1)
            if self._answers > before:
                last, before = time.monotonic(), self._answers

    @property
    def _answers(self) -> int:
        return self.model.answers + self.relay.answers

    def _wait_for(self, nodes: int) -> None:
        """Wait until so many nodes listen; raises RuntimeError where one does not."""

        def connected() -> bool:
            return (
                self.model.connected
                and self.relay.connected
                and self.model.subscribers >= nodes
                and self._supply.get_subscription_count() >= nodes
            )

        self._spin_until(time.monotonic() + PATIENCE, connected)
        if not connected():
            raise RuntimeError("model, relay or identifier did not start")

    def _spin_until(self, due: float, done: Callable[[], bool] = lambda: False) -> None:
        while (left := due - time.monotonic()) > 0.0 and not done():
            self._executor.spin_once(timeout_sec=min(left, 0.1))


@contextmanager
def on_cores(cores: Sequence[int] | None) -> Iterator[None]:
    """What is started meanwhile runs on these cores alone; None: on any."""
    if cores is None:
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
