"""The nodes under load: samples lost, windows fitted, processor time, memory over hours.

One damper at 1 and at 5 kHz; eight dampers at once, their identifiers and models in two processes;
bridge and nodes on two machines with a bad network between them; a page with viewers; hours of data
at increased speed.
"""

from __future__ import annotations

import os
import statistics
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from mr_damper_msgs.msg import FitReport, MtsSamples, PredictedForce
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter

from benchmarks.figure import Measured
from benchmarks.helper_programs import Viewer
from benchmarks.kills import ThreeNodes, three_nodes
from benchmarks.latency import page_ratio
from benchmarks.lossy_link import LossyLink, NetworkError
from benchmarks.nodes import Nodes, ProfiledDomain, cpu_seconds, on_cores, resident_bytes
from mr_damper_ros.nodes import quality
from mr_damper_ros.processes.programs import PATIENCE, Program
from mr_damper_ros.tools.demo import page_of
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


class Fleet(Nodes):
    """The nodes of all dampers, and what was received from them.

    These are diagnostics, fit reports and, if requested, samples.
    """

    def __init__(self, load: Load) -> None:
        with load.inside("left"):
            super().__init__(load.domain())
        self._load = load
        numbers = range(1, load.dampers + 1)
        self.names = [f"damper_{number}" for number in numbers] if load.dampers > 1 else [""]
        self._said: dict[str, dict[str, str]] = {}
        self.skipped = 0
        self.fits: Counter[str] = Counter()
        self._fitted: Counter[str] = Counter()
        self._missing: Counter[str] = Counter()
        self._ends: Counter[str] = Counter()
        self._last_report = time.monotonic()
        self.observer.listen(DiagnosticArray, "/diagnostics", quality.stream(), self._take)
        topics: dict[str, type] = {
            "mts/samples": MtsSamples,
            "damper/predicted_force": PredictedForce,
        }
        for name in self.names:
            self._listen(FitReport, name, "damper/fit_report", partial(self._report, name))
            for topic, kind in topics.items() if load.listens else ():
                self._missing[topic] = 0
                self._listen(kind, name, topic, partial(self._count, topic))

    def _listen(self, kind: type, name: str, topic: str, hear: Callable[..., None]) -> None:
        self.observer.listen(kind, _full(name, topic), quality.lossless(), hear)

    def _report(self, name: str, report: FitReport) -> None:
        self._last_report = time.monotonic()
        self.fits[name] += report.verdict != Verdict.ACCEPTED_EARLY
        self._fitted[name] += report.verdict not in (Verdict.ACCEPTED_EARLY, Verdict.FAILED)

    def _count(self, topic: str, message: MtsSamples | PredictedForce) -> None:
        """Count the samples that are missing from a stream of blocks, which begins with sample 0.

        Samples of a delayed block remain counted as missing.
        """
        self._missing[topic] += max(message.seq - self._ends[topic], 0)
        self._ends[topic] = max(self._ends[topic], message.seq + len(message.force))

    def _take(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith(_SHOWN):
                values = {item.key: item.value for item in status.values}
                self._said[status.name] = values
                self.skipped += int(values.get("skipped blocks", 0))

    def sent(self, name: str) -> int:
        """Number of samples that the bridge of a damper has sent, according to its diagnostics."""
        said = self._said.get(f"{name}/bridge: source".lstrip("/"), {})
        return int(said.get("samples sent", 0))

    def unfitted(self, name: str) -> int:
        """Number of windows of the sent samples that were not fitted or whose fit failed."""
        known = self.sent(name) / self._load.rate - _CURRENT_PERIOD
        windows = int((known - WindowSettings.window) / WindowSettings.hop + 1e-9) + 1
        return max(windows - self._fitted[name], 0)

    def begin(self) -> None:
        """Start all nodes, and wait for samples of all bridges."""
        load = self._load
        places = [text for name in self.names if name for text in ("--namespace", name)]
        with load.inside("right"):
            self.start("identifier", *places)
            self.start("model", *places, **load.model)
        for name in self.names:
            for topic in ("damper/predicted_force", "damper/fit_report"):
                self.observer.wait_for_publishers(_full(name, topic))
        with load.inside("left"):
            for name in self.names:
                self.start_as(
                    f"{name} bridge",
                    "bridge",
                    *("--ros-args", "-r", f"__ns:=/{name}", "--"),
                    wait_for_subscribers=3 if load.listens else 2,
                    wait_timeout=PATIENCE,
                    emulated__sample_rate=load.rate,
                    block_size=load.block,
                )
        self.observer.until(lambda: all(map(self.sent, self.names)), "samples of all bridges")

    def used(self) -> dict[str, float]:
        """Processor time [s] so far, by kind of process."""
        found = {name: cpu_seconds(program.pid) for name, program in self.programs.items()}
        return {
            "identifiers": found["identifier"],
            "workers": sum(map(cpu_seconds, self.programs["identifier"].children)),
            "models": found["model"],
            "bridges": sum(used for name, used in found.items() if name.endswith("bridge")),
        }

    def drain(self) -> None:
        """Wait until all windows are fitted or reports stop, then for the diagnostics."""
        for name in self.names:
            _deactivate(self, _full(name, "bridge"))
        self.observer.spin_for(_QUIET)
        while any(map(self.unfitted, self.names)):
            if time.monotonic() - self._last_report > _PATIENCE:
                break
            self.observer.spin_for(_QUIET)

    @property
    def told(self) -> tuple[float, str]:
        """Number of samples lost, and details."""
        lost: Counter[str] = Counter()
        for node in ("identifier", "model"):
            for name in self.names:
                said = self._said[f"{name}/{node}: input".lstrip("/")]
                lost[f"at the {node}"] += int(said["lost"]) + int(said["rejected messages"])
        losses = {**lost, **{f"of {topic}": count for topic, count in self._missing.items()}}
        where = ", ".join(f"{count} {place}" for place, count in losses.items())
        sent, fits = sum(map(self.sent, self.names)), self.fits.total()
        note = f"{where}; {sent} sent, {fits} fits, {self.skipped} blocks skipped by a model."
        return float(sum(losses.values())), note


def _full(name: str, topic: str) -> str:
    return f"/{name}/{topic}" if name else f"/{topic}"


def measure(load: Load, duration: float) -> tuple[Fleet, dict[str, float]]:
    """Stream for ``duration`` [s] on two cores.

    Returns the received messages and the processor time of each kind of process [s/s].
    """
    with on_cores(sorted(os.sched_getaffinity(0))[:2]), Fleet(load) as fleet:
        fleet.begin()
        fleet.observer.spin_for(_SETTLED)
        began, before = time.monotonic(), fleet.used()
        fleet.observer.spin_for(duration)
        elapsed, after = time.monotonic() - began, fleet.used()
        fleet.drain()
        return fleet, {kind: (after[kind] - before[kind]) / elapsed for kind in after}


def _deactivate(nodes: Nodes, bridge: str) -> None:
    """Stop the samples of a bridge; it still reports how many it has sent."""
    client = nodes.observer.node.create_client(ChangeState, f"{bridge}/change_state")
    nodes.observer.until(client.service_is_ready, f"the services of {bridge}")
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
    future = client.call_async(request)
    nodes.observer.until(future.done, f"the end of the samples of {bridge}")


def figures(duration: float = 600.0) -> Measured:
    """One damper at 1 kHz in blocks of 10, and at 5 kHz in blocks of 50."""
    slow, cpu = measure(Load(), duration)
    fast, _ = measure(Load(rate=5000.0, block=50), duration)
    return {
        "lost_1khz": slow.told,
        "lost_5khz": fast.told,
        "cpu_model_percent": 100.0 * cpu["models"],
        "cpu_identifier_percent": 100.0 * cpu["identifiers"],
    }


def eight_rig_figures(duration: float = 120.0, dampers: int = 8) -> Measured:
    """All identifiers in a process with two workers, all models in another."""
    fleet, used = measure(Load(dampers, listens=False), duration)
    return {
        "eight_rigs_lost": fleet.told,
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
            lost, note = measure(load, duration)[0].told
            return {
                "lossy_link_lost": (lost, f"{note} {link.dropped} of {link.frames} frames dropped.")
            }
    except NetworkError as error:
        return {"lossy_link_lost": (None, str(error))}


# -- a page with viewers ---------------------------------------------------------------------------

VIEWERS = 3


@contextmanager
def watched(nodes: Nodes) -> Iterator[Program]:
    """A node `live` with its viewers, beside other nodes."""
    live = nodes.start("live", port=0)
    nodes.start_helper("view", page_of(live), str(VIEWERS))
    yield live
    nodes.end("view")
    nodes.end("live")


def page_figures(
    duration: float = 300.0, segment: float = 20.0, segments: int = 5, warm: float = 30.0
) -> Measured:
    """Resources of the page's node in a complete system, ``warm`` [s] after its start."""
    with Nodes() as nodes:
        for name in ("identifier", "model"):
            nodes.start(name)
        with watched(nodes) as live:
            nodes.start("bridge", block_size=10, wait_for_subscribers=2, wait_timeout=PATIENCE)
            time.sleep(warm)
            began, before = time.monotonic(), cpu_seconds(live.pid)
            memory = resident_bytes(live.pid)
            time.sleep(duration)
            used = (cpu_seconds(live.pid) - before) / (time.monotonic() - began)
            growth = resident_bytes(live.pid) - memory
            windows = Viewer(page_of(live)).windows()
    return {
        "live_cpu_percent": (100.0 * used, f"{windows} windows."),
        "live_memory_growth_mb": growth / 1e6,
        "live_p99_ratio": page_ratio(watched, segment, segments),
    }


# -- hours of data ---------------------------------------------------------------------------------

RATE = 20.0
"""Speed relative to the data's time."""

_CURRENTS, _TURN = (1.5, 1.0, 0.5), 20.0
"""Currents [A] that the supply takes in turn, and the duration of each [s]. They cause new
baselines, a fuller reservoir and refused windows."""

_LOOK = 1.0
"""Interval [s] between two measurements of the memory in use."""

_EDGE = 0.1
"""The memory at the start and at the end is the median over this fraction of the run."""

_AT_SPEED: dict[str, dict[str, object]] = {
    "bridge": {"rate": RATE, "block_size": 100},
    # On a busy computer, fits fall behind at this speed; the waiting data are not a leak.
    "identifier": {
        "hop": 2.0,
        "waiting_windows": 10,
        "method": "least_squares",
        "global_period": 500,
    },
}


def soak_figures(hours: float = 8.0) -> Measured:
    """Stream hours of data; the first quarter, at most an hour, is not evaluated.

    Memory grows by design during the first hour, because nodes store the currents of an hour.
    """
    growth, errors = soak(hours, min(1.0, 0.25 * hours))
    return {
        "soak_growth_mb": (
            max(growth.values()),
            ", ".join(f"{name} {value:+.2f}" for name, value in growth.items()),
        ),
        "soak_errors": (len(errors), errors[0] if errors else ""),
    }


def soak(hours: float, warm_up: float) -> tuple[dict[str, float], list[str]]:
    """Memory growth [MB] of each process after ``warm_up`` [h], and the failures."""
    used: dict[str, list[int]] = defaultdict(list)
    with three_nodes(_AT_SPEED) as rig:
        client = rig.observer.node.create_client(SetParameters, "bridge/set_parameters")
        began, turns = time.monotonic(), 0
        while (elapsed := time.monotonic() - began) < 3600.0 * hours / RATE:
            if elapsed >= _TURN * turns:
                turns += 1
                current = Parameter("emulated.current", value=_CURRENTS[turns % len(_CURRENTS)])
                client.call_async(SetParameters.Request(parameters=[current.to_parameter_msg()]))
            rig.observer.spin_for(_LOOK)
            if elapsed >= 3600.0 * warm_up / RATE:
                _note_memory(rig, used)
        errors = rig.errors + [
            f"the {name} has ended" for name, node in rig.programs.items() if not node.running
        ]
        if not any(report.accepted for report in rig.reports[-100:]):
            errors.append("no window was accepted at the end")
    edge = max(round(_EDGE * len(used["worker"])), 1)
    growth = {
        name: 1e-6 * (statistics.median(sizes[-edge:]) - statistics.median(sizes[:edge]))
        for name, sizes in used.items()
    }
    return growth, errors


def _note_memory(rig: ThreeNodes, used: dict[str, list[int]]) -> None:
    """Add the memory [B] of each process."""
    worker = rig.worker
    if worker is None:
        return  # it would be an error in the log
    for name, node in rig.programs.items():
        used[name].append(resident_bytes(node.pid))
    used["worker"].append(resident_bytes(worker))
    # Received messages are discarded, so that the memory of this program does not grow.
    del rig.reports[:-1000], rig.sets[:-1000]
