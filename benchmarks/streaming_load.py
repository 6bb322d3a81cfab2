"""The nodes under load: samples lost, latency beside a bare relay, and processor time."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from mr_damper_msgs.msg import FitReport, MtsSamples, PredictedForce

from benchmarks.figure import Figure
from benchmarks.latency import LATENCY_DURATION, measure_latency, on_cores
from benchmarks.processes import ProfiledDomain, start_node
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.observer import Observer
from mr_damper_ros.processes.programs import PATIENCE, Program

DURATION = 600.0
CORES = 2


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
        stack.enter_context(on_cores(sorted(os.sched_getaffinity(0))[:CORES]))
        domain = stack.enter_context(closing(ProfiledDomain()))
        nodes = {
            name: stack.enter_context(closing(start_node(name, domain)))
            for name in ("identifier", "model")
        }
        observer = stack.enter_context(closing(Observer(domain=domain)))
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
