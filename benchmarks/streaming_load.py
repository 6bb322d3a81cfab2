"""The nodes under load: samples lost, latency beside a bare relay, and processor time."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from mr_damper_msgs.msg import FitReport, MtsSamples, PredictedForce, SupplyCurrent

from benchmarks import relay
from benchmarks.figure import Figure
from benchmarks.processes import ProfiledDomain, start_node
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.models.sigmoid.law import force
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import current_message, samples_message
from mr_damper_ros.nodes.observer import Observer
from mr_damper_ros.nodes.spinning import make_executor
from mr_damper_ros.processes.programs import PATIENCE, Program
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock

DURATION = 600.0
LATENCY_DURATION = 120.0
CORES = 2

AMPLITUDE, FREQUENCY, CURRENT = 0.005, 1.0, 1.5
"""Motion [m], [Hz] and current [A] of the latency's stream: a run of the thesis."""

SETTLED = 3.0
"""Seconds of the stream after which the predictions are valid."""


class Counter:
    """Counts the samples that are missing from a stream of blocks, which begins with sample 0."""

    def __init__(self) -> None:
        self.end = 0
        self.missing = 0

    def take(self, sequence: int, count: int) -> None:
        """Count a block; one that comes again or late counts as missing where it should be."""
        self.missing += max(sequence - self.end, 0)
        self.end = max(self.end, sequence + count)


class Tally:
    """What became of the samples of a bridge, heard by an observer that subscribes before it.

    ``fits`` are the times [s] that the fits took.
    """

    def __init__(self, observer: Observer) -> None:
        self._observer = observer
        self._samples, self._forces = Counter(), Counter()
        self._in_nodes: dict[str, int] = {}
        self.fits: list[float] = []
        observer.listen(
            MtsSamples,
            "mts/samples",
            quality.lossless(),
            lambda message: self._samples.take(message.seq, len(message.force)),
        )
        observer.listen(
            PredictedForce,
            "damper/predicted_force",
            quality.lossless(),
            lambda message: self._forces.take(message.seq, len(message.force)),
        )
        observer.listen(
            FitReport,
            "damper/fit_report",
            quality.lossless(),
            lambda message: self.fits.append(message.duration),
        )
        observer.listen(
            DiagnosticArray,
            "/diagnostics",
            quality.stream(),
            lambda message: self._in_nodes.update(_losses(message)),
        )

    def wait_for(self, samples: int, patience: float) -> None:
        """Wait until so many samples have come."""
        self._observer.until(lambda: self._samples.end >= samples, "the samples", patience)

    def finish(self) -> None:
        """Wait for the predictions of what has come, and for what the nodes say about it."""
        last = self._samples.end
        self._observer.until(lambda: self._forces.end >= last, "the last predictions")
        self._in_nodes.clear()
        self._observer.until(lambda: len(self._in_nodes) == 2, "the diagnostics of both nodes")

    @property
    def _losses(self) -> dict[str, int]:
        return {
            "at the subscriber": self._samples.missing,
            "of the predictions": self._forces.missing,
            **self._in_nodes,
        }

    @property
    def lost(self) -> int:
        """Samples and predictions lost anywhere."""
        return sum(self._losses.values())

    @property
    def where(self) -> str:
        """The same in words."""
        return ", ".join(f"{count} {place}" for place, count in self._losses.items())


def measure_load(
    sample_rate: float, block_size: int, duration: float
) -> tuple[Tally, dict[str, float]]:
    """Stream from the bridge through identifier and model on two cores for ``duration`` [s].

    Returns what became of the samples, and the processor time of each node [s/s].
    """
    with ExitStack() as stack:
        stack.enter_context(_two_cores())
        domain = stack.enter_context(closing(ProfiledDomain()))
        nodes = {
            name: stack.enter_context(closing(start_node(name, domain)))
            for name in ("identifier", "model")
        }
        observer = stack.enter_context(closing(Observer(environment=domain.environment)))
        tally = Tally(observer)
        observer.wait_for_publishers("damper/predicted_force")
        observer.wait_for_publishers("damper/fit_report")
        bridge = start_node(
            "bridge",
            domain,
            emulated__sample_rate=sample_rate,
            block_size=block_size,
            wait_for_subscribers=3,
            wait_timeout=PATIENCE,
        )
        stack.enter_context(closing(bridge))
        tally.wait_for(1, PATIENCE)
        began, before = time.monotonic(), _cpu(nodes)
        tally.wait_for(round(sample_rate * duration), 1.5 * duration + PATIENCE)
        elapsed, after = time.monotonic() - began, _cpu(nodes)
        tally.finish()
        return tally, {name: (after[name] - before[name]) / elapsed for name in nodes}


def _losses(message: DiagnosticArray) -> Iterator[tuple[str, int]]:
    """Samples and messages that a node says it has lost or could not use."""
    for status in message.status:
        if status.name in ("identifier: input", "model: input"):
            values = {entry.key: entry.value for entry in status.values}
            node = status.name.partition(":")[0]
            yield f"at the {node}", int(values["lost"]) + int(values["rejected messages"])


def _cpu(nodes: dict[str, Program]) -> dict[str, float]:
    return {name: node.cpu_seconds for name, node in nodes.items()}


@contextmanager
def _two_cores() -> Iterator[None]:
    """Keep this process, and what it starts meanwhile, on two cores."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(cores)[:CORES])
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


# -- latency ---------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Latencies:
    """From a block's publication to the arrival of its answer [s], shapes (k,) and (m,)."""

    model: Array
    relay: Array

    def ratio(self, quantile: float) -> float:
        """Of the model's quantile to the relay's."""
        return float(np.quantile(self.model, quantile) / np.quantile(self.relay, quantile))


class _Route:
    """One of the two ways for a block: the topic it is sent on, and when its answers came."""

    def __init__(self, node: Any, samples_topic: str, force_topic: str) -> None:
        self._node = node
        self._force_topic = force_topic
        self._sent: dict[int, float] = {}
        self.latencies: list[float] = []
        self.valid = 0
        self._publisher = node.create_publisher(MtsSamples, samples_topic, quality.stream())
        node.create_subscription(PredictedForce, force_topic, self._hear, quality.stream())

    @property
    def connected(self) -> bool:
        return bool(
            self._publisher.get_subscription_count()
            and self._node.count_publishers(self._force_topic)
        )

    def send(self, block: SampleBlock) -> None:
        message = samples_message(block, "damper")
        self._sent[block.sequence] = time.monotonic()
        self._publisher.publish(message)

    def _hear(self, message: PredictedForce) -> None:
        now = time.monotonic()
        self.valid += message.valid
        self.latencies.append(now - self._sent.pop(message.seq))


def measure_latency(sample_rate: float, block_size: int, duration: float) -> Latencies:
    """Send each block to the model and to the relay, in turn, each in the other's pause.

    The supply current comes between two blocks: it is a device of its own.
    """
    with ExitStack() as stack:
        domain = stack.enter_context(closing(ProfiledDomain()))
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        file = Path(folder) / "parameters.yaml"
        known = ParameterSet(
            THESIS_28_CELSIUS,
            set_id=relay.PARAMETER_SET,
            peak_velocity_range=(0.0, 0.1),
            current_range=(0.0, 2.0),
        )
        file.write_text(known.to_yaml(), encoding="utf-8")
        for process in (
            Program([sys.executable, relay.__file__], domain.environment),
            start_node("model", domain, parameter_file=file),
        ):
            stack.callback(process.close)
        os.environ.update(domain.environment)
        context = rclpy.Context()
        context.init(domain_id=domain.number)
        stack.callback(context.try_shutdown)
        node = rclpy.create_node("driver", context=context)
        stack.callback(node.destroy_node)
        executor = make_executor(context)
        executor.add_node(node)
        stack.callback(executor.shutdown)
        supply = node.create_publisher(SupplyCurrent, "supply/current", quality.stream())
        model = _Route(node, "mts/samples", "damper/predicted_force")
        bare = _Route(node, relay.SAMPLES_TOPIC, relay.FORCE_TOPIC)

        def spin_until(due: float, done: Callable[[], bool] = lambda: False) -> None:
            while (left := due - time.monotonic()) > 0.0 and not done():
                executor.spin_once(timeout_sec=min(left, 0.1))

        spin_until(
            time.monotonic() + PATIENCE,
            lambda: model.connected and bare.connected and supply.get_subscription_count() > 0,
        )
        quarter = 0.25 * block_size / sample_rate
        start = time.monotonic() + 1.0
        # A block is sent once its last sample has been taken.
        taken_ns = time.time_ns() + round((1.0 - 4.0 * quarter) * NANOSECONDS)
        blocks = _blocks(sample_rate, block_size, duration, taken_ns)
        for number, block in enumerate(blocks):
            due = start + 4.0 * quarter * number
            spin_until(due - quarter)
            if number % 10 == 0:
                supply.publish(current_message(block.start_ns, CURRENT, "damper"))
            routes = (model, bare) if number % 2 else (bare, model)
            for place, route in enumerate(routes):
                spin_until(due + 2.0 * quarter * place)
                route.send(block)
        spin_until(
            time.monotonic() + PATIENCE,
            lambda: min(len(model.latencies), len(bare.latencies)) == len(blocks),
        )
        settled = round(SETTLED * sample_rate / block_size)
        if model.valid < len(blocks) - settled:
            raise RuntimeError("the model's predictions are not valid: latency is of no use")
        return Latencies(np.array(model.latencies[settled:]), np.array(bare.latencies[settled:]))


def _blocks(
    sample_rate: float, block_size: int, duration: float, start_ns: int
) -> list[SampleBlock]:
    """A sine, in blocks."""
    omega = 2.0 * np.pi * FREQUENCY
    time_s = np.arange(round(duration * sample_rate / block_size) * block_size) / sample_rate
    u = AMPLITUDE * np.sin(omega * time_s)
    v = AMPLITUDE * omega * np.cos(omega * time_s)
    measured = force(THESIS_28_CELSIUS, u, v, -(omega**2) * u, CURRENT)
    return [
        SampleBlock(
            start_ns=start_ns + round(first / sample_rate * NANOSECONDS),
            sequence=first,
            period=1.0 / sample_rate,
            displacement=u[first : first + block_size],
            force=measured[first : first + block_size],
        )
        for first in range(0, u.size, block_size)
    ]


def figures(
    duration: float = DURATION, latency_duration: float = LATENCY_DURATION
) -> Sequence[Figure]:
    """``lost_...``, ``latency_ratio_...`` and ``cpu_..._percent``."""
    result: list[Figure] = []
    for key, sample_rate, block_size in (("lost_1khz", 1000.0, 10), ("lost_5khz", 5000.0, 50)):
        tally, used = measure_load(sample_rate, block_size, duration)
        if key == "lost_1khz":
            cpu = used
        result.append(
            Figure(
                key,
                tally.lost,
                f"Samples lost in {duration:g} s at {sample_rate:g} Hz in blocks of {block_size}: "
                "bridge, identifier and model on two cores, a window fitted every second; at "
                "either node, and at a subscriber of samples and predictions.",
                (0.0, 0.0),
                f"{tally.where}; {len(tally.fits)} fits.",
            )
        )
    latencies = measure_latency(1000.0, 10, latency_duration)
    for name, quantile in (("p50", 0.5), ("p99", 0.99)):
        times = [1e3 * float(np.quantile(x, quantile)) for x in (latencies.model, latencies.relay)]
        result.append(
            Figure(
                f"latency_ratio_{name}",
                latencies.ratio(quantile),
                f"Block of 10 at 1 kHz published to prediction received, {name} over the model, "
                "beside a bare relay on rclpy's default executor that gets the same blocks in "
                f"turn, for {latency_duration:g} s of a steady sine.",
                (0.0, 1.1),
                "{:.2f} ms beside {:.2f} ms.".format(*times),
            )
        )
    for name in ("model", "identifier"):
        result.append(
            Figure(
                f"cpu_{name}_percent",
                100.0 * cpu[name],
                f"Processor time of the {name}{', without its worker,' * (name != 'model')} at "
                f"1 kHz in blocks of 10, over {duration:g} s [% of a core].",
                (0.0, 15.0),
            )
        )
    return result
