"""From a block of samples to the command for the supply: the controller beside a bare relay."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mr_damper_msgs.msg import CurrentCommand, DesiredForce, MtsSamples, SupplyCurrent
from rclpy.serialization import deserialize_message

from benchmarks.figure import Figure
from benchmarks.helper_programs import RELAY_COMMAND, RELAY_SAMPLES, start_helper
from benchmarks.processes import ProfiledDomain, driver_node, start_node
from benchmarks.side_by_side import CURRENT
from benchmarks.streaming_load import LATENCY_DURATION, SETTLED, Latencies, sine_blocks
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import current_message, header, samples_message
from mr_damper_ros.nodes.spinning import make_executor
from mr_damper_ros.processes.programs import PATIENCE
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock

RATE, BLOCK = 1000.0, 10
WANTED = 0.6
"""Desired force, as a part of the measured one: it takes another current at every block."""

_LEAST_ACTIVE = 0.5
"""Part of the commands that must be other than the safe one: else there was nothing to reckon."""

_SILENT = 5.0
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


def measure_latency(duration: float) -> Latencies:
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
        patient = {"samples_timeout": _SILENT, "max_age": 0.0}
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
        _send(sender, controller, bare, sine_blocks(RATE, BLOCK, duration))
        settled = round(SETTLED * RATE / BLOCK)
        if controller.active(settled) < _LEAST_ACTIVE:
            raise RuntimeError("the controller commands the safe current: latency is of no use")
        return Latencies(controller.latencies[settled:], bare.latencies[settled:])


def _send(
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
            sender.spin_until(time.monotonic() + _SILENT, route.is_answered)
            if not route.is_answered():
                raise RuntimeError(f"block {number} has no command after {_SILENT:g} s")


def figures(duration: float = LATENCY_DURATION) -> list[Figure]:
    """``command_latency_ratio_p50`` and ``..._p99``."""
    found = measure_latency(duration)
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
