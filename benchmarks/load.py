"""The nodes under load: samples lost, windows fitted, processor time.

One damper at 1 and at 5 kHz; eight dampers at once, their identifiers and models in two processes;
bridge and nodes on two machines with a bad network between them.
"""

from __future__ import annotations

import os
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from mr_damper_msgs.msg import FitReport, MtsSamples, PredictedForce

from benchmarks.figure import Measured
from benchmarks.lossy_link import LossyLink, NetworkError
from benchmarks.processes import ProfiledDomain, cpu_seconds, on_cores, start_node
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.observer import Observer
from mr_damper_ros.processes.programs import PATIENCE, Program
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.window_assembler import WindowSettings

_CURRENT_PERIOD = 0.1
"""Seconds between two readings of the current; a window waits for one at or after its end."""

_SETTLED = 5.0
"""Seconds of the streams after which the processor time counts."""

_QUIET = 3.0
"""Time [s] to receive the diagnostics of all nodes, which are published every second."""

_PATIENCE = 30.0
"""Longest time [s] to wait for a report."""

_SHOWN = ("identifier: input", "model: input", "model: latency", "bridge: source")


@dataclass(frozen=True)
class Load:
    """Streams of the test: the number of ``dampers``, and the ``rate`` [Hz] and ``block`` size.

    With ``listens``, a subscriber counts all samples and predictions as well. For many dampers, it
    would use much of a core itself. ``model`` are parameters of that node. ``inside`` returns the
    context in which the bridges ("left") and the other nodes ("right") are started.
    """

    dampers: int = 1
    rate: float = 1000.0
    block: int = 10
    listens: bool = True
    model: dict[str, object] = field(default_factory=dict)
    domain: type[ProfiledDomain] = ProfiledDomain
    inside: Callable[[str], AbstractContextManager[None]] = lambda side: nullcontext()


class Counted:
    """Counts the samples that are missing from a stream of blocks, which begins with sample 0."""

    def __init__(self) -> None:
        self.end = 0
        self.missing = 0

    def take(self, sequence: int, count: int) -> None:
        """Count a block; samples of a delayed block remain counted as missing."""
        self.missing += max(sequence - self.end, 0)
        self.end = max(self.end, sequence + count)


class Fleet:
    """Messages received from the nodes: diagnostics, fit reports and, if requested, samples."""

    def __init__(self, observer: Observer, load: Load) -> None:
        self._observer, self._rate = observer, load.rate
        self.names = (
            [f"damper_{number}" for number in range(1, load.dampers + 1)]
            if load.dampers > 1
            else [""]
        )
        self._said: dict[str, dict[str, str]] = {}
        self.skipped = 0
        self.reports: dict[str, list[FitReport]] = defaultdict(list)
        self.heard: dict[str, Counted] = {}
        self._last_report = time.monotonic()
        observer.listen(DiagnosticArray, "/diagnostics", quality.stream(), self._take)
        for name in self.names:
            self._listen(FitReport, f"/{name}/damper/fit_report", self._keep(name))
            if load.listens:
                for kind, topic in (
                    (MtsSamples, "mts/samples"),
                    (PredictedForce, "damper/predicted_force"),
                ):
                    counted = self.heard[topic] = Counted()
                    self._listen(kind, f"/{name}/{topic}", self._count(counted))

    def _listen(self, kind: type, topic: str, hear: Callable[..., None]) -> None:
        self._observer.listen(kind, topic.replace("//", "/"), quality.lossless(), hear)

    def _keep(self, name: str) -> Callable[[FitReport], None]:
        def keep(report: FitReport) -> None:
            self._last_report = time.monotonic()
            if report.verdict != Verdict.ACCEPTED_EARLY:
                self.reports[name].append(report)

        return keep

    def _count(self, counted: Counted) -> Callable[[MtsSamples | PredictedForce], None]:
        return lambda message: counted.take(message.seq, len(message.force))

    def _take(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith(_SHOWN):
                values = {item.key: item.value for item in status.values}
                self._said[status.name] = values
                self.skipped += int(values.get("skipped blocks", 0))

    def _words(self, name: str, what: str) -> dict[str, str]:
        return self._said.get(f"{name}/{what}".lstrip("/"), {})

    def sent(self, name: str) -> int:
        """Number of samples that the bridge of a damper has sent, according to its diagnostics."""
        return int(self._words(name, "bridge: source").get("samples sent", 0))

    def losses(self) -> dict[str, int]:
        """Number of samples that were lost or could not be used, by place."""
        lost: Counter[str] = Counter()
        for node in ("identifier", "model"):
            for name in self.names:
                said = self._words(name, f"{node}: input")
                lost[f"at the {node}"] += int(said["lost"]) + int(said["rejected messages"])
        for topic, counted in self.heard.items():
            lost[f"of {topic}"] = counted.missing
        return dict(lost)

    def unfitted(self, name: str) -> int:
        """Number of windows of the sent samples that were not fitted or whose fit failed."""
        known = self.sent(name) / self._rate - _CURRENT_PERIOD
        windows = int((known - WindowSettings.window) / WindowSettings.hop + 1e-9) + 1
        fitted = [r for r in self.reports[name] if r.verdict != Verdict.FAILED]
        return max(windows - len(fitted), 0)

    def drain(self) -> None:
        """Wait until all windows are fitted or reports stop, then for the diagnostics."""
        self._observer.spin_for(_QUIET)
        while any(map(self.unfitted, self.names)):
            if time.monotonic() - self._last_report > _PATIENCE:
                break
            self._observer.spin_for(_QUIET)


def measure(load: Load, duration: float) -> tuple[Fleet, dict[str, float]]:
    """Stream for ``duration`` [s] on two cores.

    Returns the received messages and the processor time of each kind of process [s/s].
    """
    with ExitStack() as stack:
        stack.enter_context(on_cores(sorted(os.sched_getaffinity(0))[:2]))
        domain = stack.enter_context(closing(load.domain()))
        with load.inside("left"):
            observer = stack.enter_context(closing(Observer(domain=domain)))
        fleet = Fleet(observer, load)
        places = [text for name in fleet.names if name for text in ("--namespace", name)]
        with load.inside("right"):
            hosts = {
                node: stack.enter_context(closing(start_node(node, domain, *places, **given)))
                for node, given in (("identifier", {}), ("model", load.model))
            }
        for name in fleet.names:
            for topic in ("damper/predicted_force", "damper/fit_report"):
                observer.wait_for_publishers(f"/{name}/{topic}".replace("//", "/"))
        with load.inside("left"):
            bridges = [
                stack.enter_context(
                    closing(
                        start_node(
                            "bridge",
                            domain,
                            *("--ros-args", "-r", f"__ns:=/{name}", "--"),
                            wait_for_subscribers=3 if load.listens else 2,
                            wait_timeout=PATIENCE,
                            emulated__sample_rate=load.rate,
                            block_size=load.block,
                        )
                    )
                )
                for name in fleet.names
            ]
        observer.until(lambda: all(map(fleet.sent, fleet.names)), "samples of all bridges")
        observer.spin_for(_SETTLED)
        began, before = time.monotonic(), _used(hosts, bridges)
        observer.spin_for(duration)
        elapsed, after = time.monotonic() - began, _used(hosts, bridges)
        for name in fleet.names:
            _deactivate(observer, f"/{name}/bridge".replace("//", "/"))
        fleet.drain()
        return fleet, {kind: (after[kind] - before[kind]) / elapsed for kind in after}


def _deactivate(observer: Observer, bridge: str) -> None:
    """Stop the samples of a bridge; it still reports how many it has sent."""
    client = observer.node.create_client(ChangeState, f"{bridge}/change_state")
    observer.until(client.service_is_ready, f"the services of {bridge}")
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
    future = client.call_async(request)
    observer.until(future.done, f"the end of the samples of {bridge}")


def _used(hosts: dict[str, Program], bridges: Sequence[Program]) -> dict[str, float]:
    """Processor time [s] so far, by kind of process."""
    return {
        "identifiers": cpu_seconds(hosts["identifier"].pid),
        "workers": sum(map(cpu_seconds, hosts["identifier"].children)),
        "models": cpu_seconds(hosts["model"].pid),
        "bridges": sum(cpu_seconds(bridge.pid) for bridge in bridges),
    }


def _told(fleet: Fleet) -> tuple[float, str]:
    losses = fleet.losses()
    where = ", ".join(f"{count} {place}" for place, count in losses.items())
    sent, fits = sum(map(fleet.sent, fleet.names)), sum(map(len, fleet.reports.values()))
    note = f"{where}; {sent} sent, {fits} fits, {fleet.skipped} blocks skipped by a model."
    return float(sum(losses.values())), note


def figures(duration: float = 600.0) -> Measured:
    """One damper at 1 kHz in blocks of 10, and at 5 kHz in blocks of 50."""
    slow, cpu = measure(Load(), duration)
    fast, _ = measure(Load(rate=5000.0, block=50), duration)
    return {
        "lost_1khz": _told(slow),
        "lost_5khz": _told(fast),
        "cpu_model_percent": 100.0 * cpu["models"],
        "cpu_identifier_percent": 100.0 * cpu["identifiers"],
    }


def eight_rig_figures(duration: float = 120.0, dampers: int = 8) -> Measured:
    """All identifiers in a process with two workers, all models in another."""
    fleet, used = measure(Load(dampers, listens=False), duration)
    return {
        "eight_rigs_lost": _told(fleet),
        "eight_rigs_unfitted": float(sum(map(fleet.unfitted, fleet.names))),
        **{f"eight_rigs_cpu_{kind}_percent": 100.0 * share for kind, share in used.items()},
    }


LOSS, DELAY = 0.05, 0.02
"""Fraction of lost frames, and delay of the other frames [s]."""


class NetworkDomain(ProfiledDomain):
    """A domain that spans the machines of a network.

    Processes on one computer would pass messages through its memory, not through the network.
    """

    @property
    def environment(self) -> dict[str, str]:
        """Environment as for a domain on one computer, except for the network settings."""
        return {
            **super().environment,
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
            "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
        }


def lossy_link_figures(duration: float = 60.0) -> Measured:
    """Bridge and subscriber in one network namespace, identifier and model in another."""
    try:
        with closing(LossyLink(LOSS, DELAY)) as link:
            # Repeated frames are delayed; the force of every block must arrive, delayed or not.
            load = Load(model={"newest_first": False}, domain=NetworkDomain, inside=link.inside)
            lost, note = _told(measure(load, duration)[0])
            return {
                "lossy_link_lost": (lost, f"{note} {link.dropped} of {link.frames} frames dropped.")
            }
    except NetworkError as error:
        return {"lossy_link_lost": (None, str(error))}
