"""Latency of blocks, single samples and commands in model and controller, relative to bare relays.

A node and a relay receive the same blocks alternately, so that other load on the computer affects
both.
"""

from __future__ import annotations

import os
import struct
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from mr_damper_msgs.msg import (
    CurrentCommand,
    DesiredForce,
    MtsSamples,
    PredictedForce,
    SupplyCurrent,
)
from rclpy.serialization import deserialize_message, serialize_message

from benchmarks.figure import Measured
from benchmarks.helper_programs import RELAY_COMMAND, RELAY_FORCE, RELAY_SAMPLES
from benchmarks.nodes import Nodes, cpu_seconds, on_cores
from benchmarks.other_dampers import random_motion
from mr_damper_ros.emulation.emulator import EmulatedDamper, EmulatedRig, RigSettings
from mr_damper_ros.emulation.motions import Excitation, SineMotion
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import current_message, samples_message
from mr_damper_ros.nodes.spinning import make_executor
from mr_damper_ros.processes.programs import PATIENCE
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock

DURATION = 120.0
RATE, BLOCK = 1000.0, 10

SETTLED = 3.0
"""Time [s] from the start of a stream until the predictions are valid."""

CURRENT = 1.5
"""[A]."""

_DESIRED = 0.6
"""Desired force as a fraction of the measured force; it needs a different current in each block."""

_CURRENT_EVERY = 0.1
_SILENT = 3.0
"""Longest time [s] to wait for an answer."""

_NO_COMMAND = 5.0
"""Longest time [s] to wait for a command; the controller does not yet send safe commands in this
time."""

_STAMP, _STAMP_PLACE = struct.Struct("<iI"), 4
"""Stamp in a serialised message with a header: seconds and nanoseconds after the encapsulation."""


def blocks_of(motion: str, size: int, duration: float) -> list[SampleBlock]:
    """Blocks with the force of the thesis, in a sine or in random motion up to 3 Hz with noise.

    The stamps begin at 0.
    """
    excitation: Excitation = SineMotion(0.005, 1.0)
    settings = RigSettings(RATE, force_noise=0.0)
    if motion == "random":
        excitation = random_motion(3e-3, 0.3, 3.0, duration, seed=1)
        settings = RigSettings(RATE, seed=1)
    rig = EmulatedRig(EmulatedDamper(THESIS_28_CELSIUS), excitation, CURRENT, settings=settings)
    made = rig.next_block(round(duration * RATE / size) * size)
    return [
        SampleBlock(
            round(first * made.period * NANOSECONDS),
            first,
            made.period,
            made.displacement[first : first + size],
            made.force[first : first + size],
        )
        for first in range(0, made.displacement.size, size)
    ]


class Route:
    """One of the two paths of a block: the topic on which it is sent, and its answers.

    Blocks have the index of their first sample. Answers are stored in serialised form and read
    after the measurement, so that this process causes no delay.
    """

    def __init__(self, node: Any, samples_topic: str, kind: type, topic: str) -> None:
        self._node, self._kind, self._topic = node, kind, topic
        self._sent: dict[int, float] = {}
        self._heard: list[tuple[bytes, float]] = []
        self._publisher = node.create_publisher(MtsSamples, samples_topic, quality.stream())
        node.create_subscription(kind, topic, self._hear, quality.stream(), raw=True)

    def is_connected(self, nodes: int = 1) -> bool:
        """Whether this number of nodes receives the blocks and a node answers."""
        taken = self._publisher.get_subscription_count() >= nodes
        return bool(taken and self._node.count_publishers(self._topic))

    def is_answered(self) -> bool:
        """Whether there are as many answers as blocks."""
        return len(self._heard) >= len(self._sent)

    def answers(self) -> dict[int, tuple[float, bool]]:
        """Latency [s] of each answered block by its index, and whether the answer has content.

        The content is a valid force, or a current.
        """
        # A command has no number: there blocks are answered one after the other.
        blocks, found = list(self._sent), {}
        for place, (serialised, arrival) in enumerate(self._heard):
            message = deserialize_message(serialised, self._kind)
            is_force = self._kind is PredictedForce
            number = message.seq if is_force else blocks[place]
            if number in self._sent:
                useful = message.valid if is_force else message.current != 0.0
                found[number] = (arrival - self._sent[number], bool(useful))
        return found

    @property
    def lost(self) -> int:
        """Number of blocks without an answer."""
        return len(self._sent) - len(self.answers())

    def latencies(self, first: int) -> Array:
        """Times [s] from publication to answer, for blocks from this index on."""
        return np.array([late for number, (late, _) in self.answers().items() if number >= first])

    def useful(self, first: int = 0) -> int:
        """Number of blocks from this index on whose answer has content."""
        return sum(useful for number, (_, useful) in self.answers().items() if number >= first)

    def forget(self) -> None:
        """Discard the blocks and answers so far."""
        self._sent.clear()
        self._heard.clear()

    def send(self, number: int, message: bytes) -> None:
        """Publish a block; messages received before the first block are not answers."""
        if not self._sent:
            self._heard.clear()
        self._sent[number] = time.monotonic()
        self._publisher.publish(message)

    def _hear(self, message: bytes) -> None:
        self._heard.append((message, time.monotonic()))


class SideBySide(Nodes):
    """A node and a relay that receive blocks from this process.

    With ``commands``, the node is the controller, and each block waits for the command of the
    previous one. Otherwise it is the model, with an ``identifier`` if requested.
    """

    def __init__(self, *, commands: bool = False, identifier: bool = False) -> None:
        super().__init__()
        self._commands = commands
        self._folder = tempfile.TemporaryDirectory()
        file = Path(self._folder.name) / "parameters.yaml"
        known = ParameterSet(
            THESIS_28_CELSIUS, peak_velocity_range=(0.0, 0.1), current_range=(0.0, 2.0)
        )
        file.write_text(known.to_yaml(), encoding="utf-8")
        self._names = ("controller", "command-relay") if commands else ("model", "relay")
        # Where this computer is busy, blocks wait for the commands of those before.
        patient = {"samples_timeout": _NO_COMMAND, "max_age": 0.0} if commands else {}
        self.start_helper(self._names[1])
        self.start(self._names[0], parameter_file=file, **patient)
        if identifier:
            self.start("identifier", initial_parameters=file)
        driver = self.observer.node
        self._executor = make_executor(context=driver.context)
        self._executor.add_node(driver)
        self._supply = driver.create_publisher(SupplyCurrent, "supply/current", quality.stream())
        self._desired = driver.create_publisher(
            DesiredForce, "damper/desired_force", quality.stream()
        )
        kind: type = CurrentCommand if commands else PredictedForce
        ways = ("supply/current_command", RELAY_COMMAND)
        answers = ways if commands else ("damper/predicted_force", RELAY_FORCE)
        self.node = Route(driver, "mts/samples", kind, answers[0])
        self.relay = Route(driver, RELAY_SAMPLES, kind, answers[1])
        nodes = 2 if identifier else 1

        def connected() -> bool:
            taken = self._supply.get_subscription_count() >= nodes
            return taken and self.node.is_connected(nodes) and self.relay.is_connected()

        self._spin_until(time.monotonic() + PATIENCE, connected)
        if not connected():
            raise RuntimeError("a node or the relay did not start")

    def close(self) -> None:
        """End all programs."""
        self._executor.shutdown()
        super().close()
        self._folder.cleanup()

    @property
    def cpu_seconds(self) -> Array:
        """Processor time [s] of the node and of the relay so far, shape (2,)."""
        return np.array([cpu_seconds(self.programs[name].pid) for name in self._names])

    def latencies(self, first: int) -> list[Array]:
        """Latencies of node and relay [s], for blocks from this index on."""
        return [route.latencies(first) for route in (self.node, self.relay)]

    def send(self, blocks: Sequence[SampleBlock]) -> None:
        """Send each block at its time and wait for the answers.

        Current and desired force are sent between two blocks, as from separate devices. Raises
        RuntimeError if an expected command does not arrive.
        """
        length = blocks[0].sample_count * blocks[0].period
        messages = [
            bytearray(serialize_message(samples_message(block, "damper"))) for block in blocks
        ]
        start = time.monotonic() + 1.0
        # A block is sent once its last sample has been taken.
        taken_ns = time.time_ns() + round((1.0 - length) * NANOSECONDS)
        currents = 1 if self._commands else max(round(_CURRENT_EVERY / length), 1)
        for number, (block, message) in enumerate(zip(blocks, messages, strict=True)):
            stamp_ns = taken_ns + block.start_ns
            _STAMP.pack_into(message, _STAMP_PLACE, *divmod(stamp_ns, NANOSECONDS))
            due = start + length * number
            if number % currents == 0:
                self._spin_until(due - 0.25 * length)
                current = current_message(stamp_ns, CURRENT, "damper")
                self._supply.publish(current)
                if self._commands:
                    force = _DESIRED * float(block.force[-1])
                    self._desired.publish(DesiredForce(header=current.header, force=force))
            routes = (self.node, self.relay) if number % 2 else (self.relay, self.node)
            for place, route in enumerate(routes):
                self._spin_until(due + 0.5 * length * place)
                route.send(block.sequence, bytes(message))
                if self._commands:
                    self._spin_until(time.monotonic() + _NO_COMMAND, route.is_answered)
                    if not route.is_answered():
                        raise RuntimeError(f"block {number} has no command")
        self._spin_until(
            time.monotonic() + _SILENT,
            lambda: self.node.is_answered() and self.relay.is_answered(),
        )

    def _spin_until(self, due: float, done: Callable[[], bool] = lambda: False) -> None:
        while (left := due - time.monotonic()) > 0.0 and not done():
            self._executor.spin_once(timeout_sec=min(left, 0.1))


# -- blocks of ten at 1 kHz, to model and controller -----------------------------------------------

_USEFUL = {False: 1.0, True: 0.5}
"""Smallest fraction of answers with content: valid forces, or commands that are not only the safe
current."""


def _ratios(commands: bool, duration: float) -> Measured:
    blocks = blocks_of("sine", BLOCK, duration)
    with SideBySide(commands=commands) as both:
        both.send(blocks)
        first = round(SETTLED * RATE)
        if both.node.useful(first) < _USEFUL[commands] * (len(blocks) - first // BLOCK):
            raise RuntimeError("the answers are not valid: their latency is of no use")
        latencies = both.latencies(first)
    key = "command_latency_ratio" if commands else "latency_ratio"
    found: Measured = {}
    for name, quantile in (("p50", 0.5), ("p99", 0.99)):
        node, relay = (1e3 * float(np.quantile(times, quantile)) for times in latencies)
        found[f"{key}_{name}"] = (node / relay, f"{node:.2f} ms beside {relay:.2f} ms.")
    return found


def figures(duration: float = DURATION) -> Measured:
    """Time from the publication of a block to its answer, relative to that of a bare relay."""
    return _ratios(commands=False, duration=duration) | _ratios(commands=True, duration=duration)


# -- blocks of one sample --------------------------------------------------------------------------

MOTIONS = ("sine", "random")


def single_sample_figures(duration: float = 60.0) -> Measured:
    """Measure the model, with the identifier running, and the relay, all on two cores."""
    lost, p99, cpu, notes = [], [], [], []
    for motion in MOTIONS:
        blocks = blocks_of(motion, 1, duration)
        with on_cores(sorted(os.sched_getaffinity(0))[:2]), SideBySide(identifier=True) as both:
            before = both.cpu_seconds
            both.send(blocks)
            used = (both.cpu_seconds - before) / duration
            late = [1e3 * float(np.quantile(x, 0.99)) for x in both.latencies(round(3.0 * RATE))]
            valid = both.node.useful() / len(blocks)
            notes.append(f"{motion}: the relay lost {both.relay.lost}; valid {valid:.1%}")
            lost.append(float(both.node.lost))
        p99.append((late[0] / late[1], "{:.2f} ms beside {:.2f} ms".format(*late)))
        cpu.append((used[0] / used[1], "{:.0%} beside {:.0%} of a core".format(*used)))
    return {
        "single_sample_lost": (lost, "; ".join(notes)),
        "single_sample_p99_ratio": ([x for x, _ in p99], "; ".join(told for _, told in p99)),
        "single_sample_cpu_ratio": ([x for x, _ in cpu], "; ".join(told for _, told in cpu)),
    }


# -- beside a page that is looked at ---------------------------------------------------------------


def page_ratio(watched: Callable[[Nodes], Any], segment: float, segments: int) -> tuple[float, str]:
    """99th percentile of the latency of the model while ``watched``, over that while not watched.

    The two states alternate for ``segments`` times ``segment`` [s] each.
    """
    found: tuple[list[Array], list[Array]] = ([], [])
    blocks = blocks_of("sine", BLOCK, segment)
    with SideBySide() as both:
        for number in range(2 * segments):
            both.node.forget()
            both.relay.forget()
            with watched(both) if number % 2 else nullcontext():
                both.send(blocks)
            found[number % 2].append(both.latencies(round(SETTLED * RATE))[0])
    without, beside = (1e3 * float(np.quantile(np.concatenate(x), 0.99)) for x in found)
    return beside / without, f"{beside:.2f} ms beside {without:.2f} ms."
