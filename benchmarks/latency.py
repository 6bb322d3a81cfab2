"""Model and controller beside bare relays: latency of blocks, of single samples, of commands.

Both get the same blocks, each in the other's pause, so that a busy computer hits both.
"""

from __future__ import annotations

import os
import struct
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from mr_damper_msgs.msg import (
    CurrentCommand,
    DesiredForce,
    MtsSamples,
    PredictedForce,
    SupplyCurrent,
)
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import deserialize_message, serialize_message

from benchmarks.figure import Figure
from benchmarks.helper_programs import (
    PARAMETER_SET,
    RELAY_COMMAND,
    RELAY_FORCE,
    RELAY_SAMPLES,
    start_busy_loop,
    start_helper,
)
from benchmarks.other_dampers import random_motion
from benchmarks.processes import ProfiledDomain, driver_node, start_node
from mr_damper_ros.emulation.emulator import EmulatedRig, ModelDamper, RigSettings
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.models.sigmoid.law import sine_force
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import current_message, header, samples_message, to_nanoseconds
from mr_damper_ros.nodes.spinning import make_executor
from mr_damper_ros.processes.programs import PATIENCE
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.tracking.validity import ValiditySettings

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


# -- blocks of ten at 1 kHz -----------------------------------------------------------------------

LATENCY_DURATION = 120.0

RATE, BLOCK = 1000.0, 10

AMPLITUDE, FREQUENCY = 0.005, 1.0
"""Motion [m], [Hz] of the latency's stream: a run of the thesis."""

SETTLED = 3.0
"""Seconds of the stream after which the predictions are valid."""


@dataclass(frozen=True, eq=False)
class Latencies:
    """From a block's publication to the arrival of its answer [s], shapes (k,) and (m,)."""

    model: Array
    relay: Array

    def ratio(self, quantile: float) -> float:
        """Of the model's quantile to the relay's."""
        return float(np.quantile(self.model, quantile) / np.quantile(self.relay, quantile))


def measure_latency(sample_rate: float, block_size: int, duration: float) -> Latencies:
    """Send each block to the model and to the relay, in turn, each in the other's pause."""
    with SideBySide() as both:
        blocks = sine_blocks(sample_rate, block_size, duration)
        both.send(blocks)
        settled = round(SETTLED * sample_rate / block_size)
        if len(both.model.valid_ones) < len(blocks) - settled:
            raise RuntimeError("the model's predictions are not valid: latency is of no use")
        return Latencies(
            *(
                np.array(list(route.latencies.values())[settled:])
                for route in (both.model, both.relay)
            )
        )


def sine_blocks(sample_rate: float, block_size: int, duration: float) -> list[SampleBlock]:
    """A sine with the force of the thesis, in blocks; their stamps count from 0."""
    omega = 2.0 * np.pi * FREQUENCY
    time_s = np.arange(round(duration * sample_rate / block_size) * block_size) / sample_rate
    u = AMPLITUDE * np.sin(omega * time_s)
    v = AMPLITUDE * omega * np.cos(omega * time_s)
    measured = sine_force(THESIS_28_CELSIUS, u, v, -(omega**2) * u, CURRENT)
    return blocks_of(u, measured, 1.0 / sample_rate, block_size)


# -- blocks of one sample, and an overload --------------------------------------------------------

OVERLOAD = 15.0
BUSY = 6
"""Programs that are always busy on the core of the nodes."""

_CORES = 2
MAX_AGE = ValiditySettings().max_age
ON_THE_WAY = 0.05
"""Seconds that may pass from the model's judgement to the force's publication: the busy programs
may have the processor in between."""

MOTIONS = ("sine", "random")


@dataclass(frozen=True)
class SingleSamples:
    """What became of the blocks: of model and relay."""

    lost: tuple[int, int]
    p99: tuple[float, float]
    cpu: tuple[float, float]
    valid: float


def stream(motion: str, duration: float) -> list[SampleBlock]:
    """Blocks of one sample of a sine, or of random motion up to 3 Hz."""
    if motion == "sine":
        return sine_blocks(RATE, 1, duration)
    rig = EmulatedRig(
        ModelDamper(ParameterSet(THESIS_28_CELSIUS), 1.0 / RATE),
        random_motion(3e-3, 0.3, 3.0, duration, seed=1),
        CURRENT,
        settings=RigSettings(RATE, seed=1),
    )
    made = rig.next_block(round(duration * RATE))
    return blocks_of(made.displacement, made.force, made.period, 1)


def beside_a_relay(motion: str, duration: float) -> SingleSamples:
    """The model, with the identifier running, and the relay, all on two cores."""
    blocks = stream(motion, duration)
    with on_cores(sorted(os.sched_getaffinity(0))[:_CORES]), SideBySide(identifier=True) as both:
        before = both.cpu_seconds
        both.send(blocks)
        model, relay = (
            (now - then) / duration for now, then in zip(both.cpu_seconds, before, strict=True)
        )
        settled = round(SETTLED * RATE)
        first, second = (
            float(np.quantile([x for k, x in route.latencies.items() if k >= settled], 0.99))
            for route in (both.model, both.relay)
        )
        return SingleSamples(
            (both.model.lost, both.relay.lost),
            (first, second),
            (model, relay),
            len(both.model.valid_ones) / len(blocks),
        )


@dataclass(frozen=True)
class Overload:
    """Forces published later than ``max_age``: ``stale_valid`` of them valid, ``stale`` in all.

    ``valid`` forces in all, the age of the ``oldest_valid`` [s], samples ``relay_lost``, and the
    ``relay_age`` [s] of the oldest that it answered.
    """

    stale_valid: int
    stale: int
    oldest_valid: float
    relay_lost: int
    relay_age: float
    valid: int


def overload(duration: float = OVERLOAD, busy: int = BUSY) -> Overload:
    """Model and relay on one core with busy programs; the driver has another."""
    driver, *others = sorted(os.sched_getaffinity(0))
    core = others[:1] or [driver]
    with SideBySide(cores=core, busy=busy, dated=True) as both, on_cores([driver]):
        both.send(stream("random", duration))
        model, relay = both.model, both.relay
        ages, valid = model.ages, model.valid_ones
        stale = {k for k, age in ages.items() if age > MAX_AGE + ON_THE_WAY}
        return Overload(
            len(stale & valid),
            len(stale),
            max((ages[k] for k in valid), default=0.0),
            relay.lost,
            max(relay.ages.values(), default=0.0),
            len(valid),
        )


def single_sample_figures(
    duration: float = 60.0, overload_duration: float = OVERLOAD
) -> list[Figure]:
    """``single_sample_...`` and ``stale_valid``."""
    found = [beside_a_relay(motion, duration) for motion in MOTIONS]
    what = (
        f"Blocks of one sample at {RATE:g} Hz for {duration:g} s, bridge's place taken by a driver "
        f"that sends each to model and relay in turn, identifier running, {_CORES} cores: "
        f"{', '.join(MOTIONS)}"
    )
    heavy = overload(overload_duration)
    return [
        Figure(
            "single_sample_lost",
            [float(each.lost[0]) for each in found],
            f"{what}; samples without a force.",
            (0.0, 0.0),
            f"The relay lost {' and '.join(str(each.lost[1]) for each in found)}; valid "
            f"{' and '.join(f'{each.valid:.1%}' for each in found)}.",
        ),
        Figure(
            "single_sample_p99_ratio",
            [each.p99[0] / each.p99[1] for each in found],
            "99th percentile of the latency there over that of the relay.",
            (0.0, 1.2),
            "; ".join("{:.2f} ms beside {:.2f} ms".format(*(1e3 * np.array(e.p99))) for e in found),
        ),
        Figure(
            "single_sample_cpu_ratio",
            [each.cpu[0] / each.cpu[1] for each in found],
            "Processor time of the model there over that of the relay, which only copies.",
            (0.0, 1.5),
            "; ".join("{:.0%} beside {:.0%} of a core".format(*each.cpu) for each in found),
        ),
        Figure(
            "stale_valid",
            float(heavy.stale_valid),
            f"Forces published more than max_age ({MAX_AGE:g} s) after their sample and "
            f"marked valid: {RATE:g} Hz in blocks of one, random motion, model and relay on one "
            f"core with {BUSY} programs that are always busy; {1e3 * ON_THE_WAY:g} ms are allowed "
            "from the judgement on.",
            (0.0, 0.0),
            f"{heavy.stale} were older, {heavy.valid} valid, of these the oldest "
            f"{heavy.oldest_valid:.2f} s; the relay lost {heavy.relay_lost}, its oldest came after "
            f"{heavy.relay_age:.2f} s.",
        ),
    ]


# -- from a block to the command ------------------------------------------------------------------

WANTED = 0.6
"""Desired force, as a part of the measured one: it takes another current at every block."""

_LEAST_ACTIVE = 0.5
"""Part of the commands that must be other than the safe one: else there was nothing to reckon."""

_NO_COMMAND = 5.0
"""Seconds without a command after which none is waited for; the controller does not begin to send
safe ones meanwhile."""


class CommandRoute:
    """Sends blocks, each once the one before has its command, and keeps when both happened."""

    def __init__(self, node: Any, samples_topic: str, command_topic: str) -> None:
        self._node, self._command_topic = node, command_topic
        self._publisher = node.create_publisher(MtsSamples, samples_topic, quality.stream())
        node.create_subscription(
            CurrentCommand, command_topic, self._hear, quality.stream(), raw=True
        )
        self.sent: list[float] = []
        self.heard: list[tuple[float, bytes]] = []

    @property
    def connected(self) -> bool:
        """Whether somebody takes the blocks and answers."""
        return bool(
            self._publisher.get_subscription_count()
            and self._node.count_publishers(self._command_topic)
        )

    def send(self, message: MtsSamples) -> None:
        """Publish a block. What was commanded before the first one is no answer."""
        if not self.sent:
            self.heard.clear()
        self.sent.append(time.monotonic())
        self._publisher.publish(message)

    def _hear(self, message: bytes) -> None:
        self.heard.append((time.monotonic(), message))

    def is_answered(self) -> bool:
        """Whether the last block has its command."""
        return len(self.heard) == len(self.sent)

    @property
    def latencies(self) -> Array:
        """From a block to its command [s]."""
        return np.array([came for came, _ in self.heard]) - self.sent

    def active(self, first: int) -> float:
        """Part of the commands from the ``first`` on that are not zero."""
        said = [deserialize_message(message, CurrentCommand) for _, message in self.heard[first:]]
        return float(np.mean([command.current != 0.0 for command in said]))


@dataclass(frozen=True, eq=False)
class _LatencyDriver:
    """What a driver publishes, and its executor."""

    supply: Any
    demand: Any
    executor: Any

    def spin_until(self, due: float, done: Callable[[], bool] = lambda: False) -> None:
        while (left := due - time.monotonic()) > 0.0 and not done():
            self.executor.spin_once(timeout_sec=min(left, 0.1))


def measure_commands(duration: float) -> Latencies:
    """Send each block to the controller and to the relay, in turn, each in the other's pause."""
    with ExitStack() as stack:
        domain = stack.enter_context(closing(ProfiledDomain()))
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        file = Path(folder) / "parameters.yaml"
        known = ParameterSet(
            THESIS_28_CELSIUS, peak_velocity_range=(0.0, 0.1), current_range=(0.0, 2.0)
        )
        file.write_text(known.to_yaml(), encoding="utf-8")
        stack.callback(start_helper("command-relay", environment=domain.environment).close)
        # Where this computer is busy, blocks wait for the commands of those before.
        patient = {"samples_timeout": _NO_COMMAND, "max_age": 0.0}
        stack.callback(start_node("controller", domain, parameter_file=file, **patient).close)
        node = driver_node(stack, domain)
        executor = make_executor(context=node.context)
        executor.add_node(node)
        stack.callback(executor.shutdown)
        controller = CommandRoute(node, "mts/samples", "supply/current_command")
        bare = CommandRoute(node, RELAY_SAMPLES, RELAY_COMMAND)
        sender = _LatencyDriver(
            node.create_publisher(SupplyCurrent, "supply/current", quality.stream()),
            node.create_publisher(DesiredForce, "damper/desired_force", quality.stream()),
            executor,
        )

        def connected() -> bool:
            return controller.connected and bare.connected

        sender.spin_until(time.monotonic() + PATIENCE, connected)
        if not connected():
            raise RuntimeError("controller or relay did not start")
        _send_in_turn(sender, controller, bare, sine_blocks(RATE, BLOCK, duration))
        settled = round(SETTLED * RATE / BLOCK)
        if controller.active(settled) < _LEAST_ACTIVE:
            raise RuntimeError("the controller commands the safe current: latency is of no use")
        return Latencies(controller.latencies[settled:], bare.latencies[settled:])


def _send_in_turn(
    sender: _LatencyDriver,
    controller: CommandRoute,
    bare: CommandRoute,
    blocks: Sequence[SampleBlock],
) -> None:
    """Send all blocks, at their time or where this computer is late as soon as it can.

    The supply's current and the desired force come between two blocks: from other devices. Raises
    RuntimeError where no command comes.
    """
    length = BLOCK / RATE
    start = time.monotonic() + 1.0
    taken_ns = time.time_ns() + round((1.0 - length) * NANOSECONDS)
    for number, block in enumerate(blocks):
        stamp_ns, due = taken_ns + block.start_ns, start + length * number
        message = samples_message(block, "damper")
        message.header = header(stamp_ns, "damper")
        sender.spin_until(due - 0.25 * length)
        sender.supply.publish(current_message(stamp_ns, CURRENT, "damper"))
        wanted = WANTED * float(block.force[-1])
        sender.demand.publish(DesiredForce(header=message.header, force=wanted))
        routes = (controller, bare) if number % 2 else (bare, controller)
        for place, route in enumerate(routes):
            sender.spin_until(due + 0.5 * length * place)
            route.send(message)
            sender.spin_until(time.monotonic() + _NO_COMMAND, route.is_answered)
            if not route.is_answered():
                raise RuntimeError(f"block {number} has no command after {_NO_COMMAND:g} s")


def command_figures(duration: float = LATENCY_DURATION) -> list[Figure]:
    """``command_latency_ratio_p50`` and ``..._p99``."""
    found = measure_commands(duration)
    made = []
    for name, quantile in (("p50", 0.5), ("p99", 0.99)):
        both = (1e3 * float(np.quantile(x, quantile)) for x in (found.model, found.relay))
        made.append(
            Figure(
                f"command_latency_ratio_{name}",
                found.ratio(quantile),
                f"Block of {BLOCK} at 1 kHz published to command received, {name} over the "
                "controller, with a desired force for every block, beside a bare relay on rclpy's "
                f"default executor that gets the same blocks in turn, for {duration:g} s of a "
                "steady sine.",
                (0.0, 1.2),
                "{:.2f} ms beside {:.2f} ms.".format(*both),
            )
        )
    return made
