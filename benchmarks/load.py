"""The nodes under load: latency, lost samples, windows fitted, processor time, memory over hours.

A node and a bare relay that receive the same blocks in turn; one damper at 1 and at 5 kHz; bridge
and nodes on two machines with a bad network between them; a page with viewers; hours of data at
increased speed.
"""

from __future__ import annotations

import os
import statistics
import struct
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from mr_damper_msgs.msg import (
    CurrentCommand,
    DesiredForce,
    FitReport,
    MtsSamples,
    PredictedForce,
    SupplyCurrent,
)
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message

from benchmarks.figure import Measured
from benchmarks.helper_programs import RELAY_COMMAND, RELAY_FORCE, RELAY_SAMPLES, Viewer
from benchmarks.lossy_link import LossyLink, NetworkError
from benchmarks.motions import random_motion
from benchmarks.nodes import (
    Nodes,
    ThreeNodes,
    cpu_seconds,
    on_cores,
    resident_bytes,
)
from mr_damper_ros.emulation.emulator import EmulatedDamper, EmulatedRig, RigSettings
from mr_damper_ros.emulation.motions import Excitation, SineMotion
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import current_message, samples_message
from mr_damper_ros.nodes.spinning import make_executor
from mr_damper_ros.processes.programs import PATIENCE, Program, RosDomain
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.tools.demo import page_of
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.window_assembler import WindowSettings

# -- latency, relative to bare relays --------------------------------------------------------------

_RATE, _BLOCK = 1000.0, 10
_CURRENT = 1.5

_VALID_FROM = 3.0
"""Time [s] from the start of a stream until the predictions are valid."""

_DESIRED = 0.6
"""Desired force as a fraction of the measured force; it needs a different current in each block."""

_CURRENT_PERIOD = 0.1
"""Seconds between two readings of the current; a window waits for one at or after its end."""

_SILENT, _NO_COMMAND = 3.0, 5.0
"""Longest time [s] to wait for the last answers, and for a command; the controller does not yet
send safe commands in this time."""

_STAMP, _STAMP_PLACE = struct.Struct("<iI"), 4
"""Stamp in a serialised message with a header: seconds and nanoseconds after the encapsulation."""


def blocks_of(motion: str, size: int, duration: float) -> list[SampleBlock]:
    """Blocks with the force of the thesis, in a sine or in random motion up to 3 Hz with noise.

    The stamps begin at 0.
    """
    excitation: Excitation = SineMotion(0.005, 1.0)
    settings = RigSettings(_RATE, force_noise=0.0)
    if motion == "random":
        excitation = random_motion(3e-3, 0.3, 3.0, duration, seed=1)
        settings = RigSettings(_RATE, seed=1)
    rig = EmulatedRig(EmulatedDamper(THESIS_28_CELSIUS), excitation, _CURRENT, settings=settings)
    made = rig.next_block(round(duration * _RATE / size) * size)
    blocks = []
    for first in range(0, made.displacement.size, size):
        part, start_ns = slice(first, first + size), round(first * made.period * NANOSECONDS)
        signals = made.displacement[part], made.force[part]
        blocks.append(SampleBlock(start_ns, first, made.period, *signals))
    return blocks


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

    def answers(self) -> Array:
        """One row (n, 3) for each answered block: its index, latency [s], and whether it is useful.

        Useful is a valid force, or a current.
        """
        # A command has no number: there blocks are answered one after the other.
        blocks, rows = list(self._sent), {}
        for place, (serialised, arrival) in enumerate(self._heard):
            message = deserialize_message(serialised, self._kind)
            is_force = self._kind is PredictedForce
            number = message.seq if is_force else blocks[place]
            if number in self._sent:
                useful = message.valid if is_force else message.current != 0.0
                rows[number] = number, arrival - self._sent[number], float(useful)
        return np.array(list(rows.values())).reshape(-1, 3)

    @property
    def lost(self) -> int:
        """Number of blocks without an answer."""
        return len(self._sent) - len(self.answers())

    def late(self, quantile: float) -> float:
        """Quantile of the latencies [ms] from when the predictions are valid."""
        return 1e3 * float(np.quantile(self.settled()[:, 1], quantile))

    def settled(self) -> Array:
        """The :meth:`answers` from the time on from which the predictions are valid."""
        rows = self.answers()
        return np.asarray(rows[rows[:, 0] >= round(_VALID_FROM * _RATE)])

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
        currents = 1 if self._commands else max(round(_CURRENT_PERIOD / length), 1)
        for number, (block, message) in enumerate(zip(blocks, messages, strict=True)):
            stamp_ns = taken_ns + block.start_ns
            _STAMP.pack_into(message, _STAMP_PLACE, *divmod(stamp_ns, NANOSECONDS))
            due = start + length * number
            if number % currents == 0:
                self._spin_until(due - 0.25 * length)
                current = current_message(stamp_ns, _CURRENT, "damper")
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
            time.monotonic() + _SILENT, lambda: self.node.is_answered() and self.relay.is_answered()
        )

    def _spin_until(self, due: float, done: Callable[[], bool] = lambda: False) -> None:
        while (left := due - time.monotonic()) > 0.0 and not done():
            self._executor.spin_once(timeout_sec=min(left, 0.1))


def latency_figures(duration: float = 120.0) -> Measured:
    """Blocks of ten: time from their publication to the answer, relative to that of a relay."""
    blocks, found = blocks_of("sine", _BLOCK, duration), {}
    for key, commands, useful in (
        ("latency_ratio", False, 1.0),
        # Of the commands a half is enough that are not only the safe current.
        ("command_latency_ratio", True, 0.5),
    ):
        with SideBySide(commands=commands) as both:
            both.send(blocks)
            count = len(blocks) - round(_VALID_FROM * _RATE) // _BLOCK
            if np.sum(both.node.settled()[:, 2]) < useful * count:
                raise RuntimeError("the answers are not valid: their latency is of no use")
            for name, quantile in (("p50", 0.5), ("p99", 0.99)):
                node, relay = both.node.late(quantile), both.relay.late(quantile)
                found[f"{key}_{name}"] = node / relay, f"{node:.2f} ms beside {relay:.2f} ms."
    return {**found}


def single_sample_figures(duration: float = 60.0) -> Measured:
    """Measure the model, with the identifier running, and the relay, all on two cores."""
    lost, p99, cpu, notes = [], [], [], []
    for motion in ("sine", "random"):
        blocks = blocks_of(motion, 1, duration)
        with on_cores(_two_cores()), SideBySide(identifier=True) as both:
            before = both.cpu_seconds
            both.send(blocks)
            used = (both.cpu_seconds - before) / duration
            late = both.node.late(0.99), both.relay.late(0.99)
            valid = np.sum(both.node.answers()[:, 2]) / len(blocks)
            notes.append(
                f"{motion}: {late[0]:.2f} ms beside {late[1]:.2f} ms, {used[0]:.0%} beside "
                f"{used[1]:.0%} of a core; the relay lost {both.relay.lost}; valid {valid:.1%}"
            )
            lost.append(float(both.node.lost))
        p99.append(late[0] / late[1])
        cpu.append(float(used[0] / used[1]))
    return {
        "single_sample_lost": (lost, "; ".join(notes)),
        "single_sample_p99_ratio": p99,
        "single_sample_cpu_ratio": cpu,
    }


def _two_cores() -> list[int]:
    return sorted(os.sched_getaffinity(0))[:2]


# -- streams ---------------------------------------------------------------------------------------

_SETTLED = 5.0
"""Seconds of the streams after which the processor time counts."""

_QUIET = 3.0
"""Time [s] to receive the diagnostics of all nodes, which are published every second."""

_NO_REPORT = 30.0
"""Longest time [s] to wait for a report."""

_SHOWN = ("identifier: input", "model: input", "model: latency", "bridge: source")


@dataclass(frozen=True)
class Load:
    """Stream of the test: its ``rate`` [Hz] and ``block`` size.

    ``model`` are parameters of that node. ``inside`` returns the context in which the bridge
    ("left") and the other nodes ("right") are started.
    """

    rate: float = 1000.0
    block: int = 10
    model: dict[str, object] = field(default_factory=dict)
    domain: type[RosDomain] = RosDomain
    inside: Callable[[str], AbstractContextManager[None]] = lambda side: nullcontext()


class StreamingNodes(Nodes):
    """Bridge, identifier and model, and what was received from them.

    These are samples, predictions, fit reports and diagnostics.
    """

    def __init__(self, load: Load) -> None:
        with load.inside("left"):
            super().__init__(load.domain())
        self._load = load
        self._said: dict[str, dict[str, str]] = {}
        self._skipped = self._fits = self._fitted = 0
        self._missing: Counter[str] = Counter()
        self._ends: Counter[str] = Counter()
        self._last_report = time.monotonic()
        listen = self.observer.listen
        listen(DiagnosticArray, "/diagnostics", quality.stream(), self._take)
        listen(FitReport, "/damper/fit_report", quality.lossless(), self._report)
        for topic, kind in (
            ("mts/samples", MtsSamples),
            ("damper/predicted_force", PredictedForce),
        ):
            hear: Callable[..., None] = partial(self._count, topic)
            self._missing[topic] = 0
            listen(kind, f"/{topic}", quality.lossless(), hear)

    def _report(self, report: FitReport) -> None:
        self._last_report = time.monotonic()
        self._fits += report.verdict != Verdict.ACCEPTED_EARLY
        self._fitted += report.verdict not in (Verdict.ACCEPTED_EARLY, Verdict.FAILED)

    def _count(self, topic: str, message: MtsSamples | PredictedForce) -> None:
        """Count the samples that are missing from a stream of blocks, which begins with sample 0.

        Samples of a delayed block remain counted as missing.
        """
        self._missing[topic] += max(message.seq - self._ends[topic], 0)
        self._ends[topic] = max(self._ends[topic], message.seq + len(message.force))

    def _take(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name in _SHOWN:
                values = {item.key: item.value for item in status.values}
                self._said[status.name] = values
                self._skipped += int(values.get("skipped blocks", 0))

    @property
    def sent(self) -> int:
        """Number of samples that the bridge has sent, according to its diagnostics."""
        return int(self._said.get("bridge: source", {}).get("samples sent", 0))

    @property
    def unfitted(self) -> int:
        """Number of windows of the sent samples that were not fitted or whose fit failed."""
        known = self.sent / self._load.rate - _CURRENT_PERIOD
        windows = int((known - WindowSettings.window) / WindowSettings.hop + 1e-9) + 1
        return max(windows - self._fitted, 0)

    def begin(self) -> None:
        """Start all nodes, and wait for samples of the bridge."""
        load = self._load
        with load.inside("right"):
            self.start("identifier")
            self.start("model", **load.model)
        for topic in ("/damper/predicted_force", "/damper/fit_report"):
            self.observer.wait_for_publishers(topic)
        with load.inside("left"):
            self.start(
                "bridge",
                wait_for_subscribers=3,
                wait_timeout=PATIENCE,
                emulated__sample_rate=load.rate,
                block_size=load.block,
            )
        self.observer.until(lambda: self.sent > 0, "samples of the bridge")

    def used(self) -> dict[str, float]:
        """Processor time [s] of each node so far, without that of the worker."""
        return {name: cpu_seconds(program.pid) for name, program in self.programs.items()}

    def drain(self) -> None:
        """Stop the samples; wait until all windows are fitted or reports stop, then for the rest.

        A stopped bridge still reports how many samples it has sent.
        """
        client = self.observer.node.create_client(ChangeState, "/bridge/change_state")
        self.observer.until(client.service_is_ready, "the services of the bridge")
        request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
        future = client.call_async(request)
        self.observer.until(future.done, "the end of the samples")
        self.observer.spin_for(_QUIET)
        while self.unfitted and time.monotonic() - self._last_report <= _NO_REPORT:
            self.observer.spin_for(_QUIET)

    @property
    def told(self) -> tuple[float, str]:
        """Number of samples lost, and details."""
        lost: Counter[str] = Counter()
        for node in ("identifier", "model"):
            said = self._said[f"{node}: input"]
            lost[f"at the {node}"] += int(said["lost"]) + int(said["rejected messages"])
        losses = {**lost, **{f"of {topic}": count for topic, count in self._missing.items()}}
        where = ", ".join(f"{count} {place}" for place, count in losses.items())
        note = (
            f"{where}; {self.sent} sent, {self._fits} fits, {self._skipped} blocks skipped by the "
            "model."
        )
        return float(sum(losses.values())), note


def measure(load: Load, duration: float) -> tuple[StreamingNodes, dict[str, float]]:
    """Stream for ``duration`` [s] on two cores.

    Returns the received messages and the processor time of each node [s/s].
    """
    with on_cores(_two_cores()), StreamingNodes(load) as nodes:
        nodes.begin()
        nodes.observer.spin_for(_SETTLED)
        began, before = time.monotonic(), nodes.used()
        nodes.observer.spin_for(duration)
        elapsed, after = time.monotonic() - began, nodes.used()
        nodes.drain()
        return nodes, {name: (after[name] - before[name]) / elapsed for name in after}


def figures(duration: float = 600.0) -> Measured:
    """One damper at 1 kHz in blocks of 10, and at 5 kHz in blocks of 50."""
    slow, cpu = measure(Load(), duration)
    fast, _ = measure(Load(rate=5000.0, block=50), duration)
    return {
        "lost_1khz": slow.told,
        "lost_5khz": fast.told,
        "cpu_model_percent": 100.0 * cpu["model"],
        "cpu_identifier_percent": 100.0 * cpu["identifier"],
    }


LOSS, DELAY = 0.05, 0.02
"""Fraction of lost frames, and delay of the other frames [s]."""


class NetworkDomain(RosDomain):
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
    """Resources of the page's node in a complete system, ``warm`` [s] after its start.

    The latency of the model is measured with and without the page, in turn ``segments`` times
    ``segment`` [s] each.
    """
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
    found: tuple[list[Array], list[Array]] = ([], [])
    blocks = blocks_of("sine", _BLOCK, segment)
    with SideBySide() as both:
        for number in range(2 * segments):
            both.node.forget()
            both.relay.forget()
            with watched(both) if number % 2 else nullcontext():
                both.send(blocks)
            found[number % 2].append(both.node.settled()[:, 1])
    without, beside = (1e3 * float(np.quantile(np.concatenate(x), 0.99)) for x in found)
    return {
        "live_cpu_percent": (100.0 * used, f"{windows} windows."),
        "live_memory_growth_mb": growth / 1e6,
        "live_p99_ratio": (beside / without, f"{beside:.2f} ms beside {without:.2f} ms."),
    }


# -- hours of data ---------------------------------------------------------------------------------

RATE = 20.0
"""Speed relative to the data's time."""

_CURRENTS, _TURN = (1.5, 1.0, 0.5), 20.0
"""Currents [A] that the supply takes in turn, and the duration of each [s]. They cause new
baselines, a fuller reservoir and refused windows."""

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
    told = ", ".join(f"{name} {value:+.2f}" for name, value in growth.items())
    return {
        "soak_growth_mb": (max(growth.values()), told),
        "soak_errors": (len(errors), errors[0] if errors else ""),
    }


def soak(hours: float, warm_up: float) -> tuple[dict[str, float], list[str]]:
    """Memory growth [MB] of each process after ``warm_up`` [h], and the failures."""
    used: dict[str, list[int]] = defaultdict(list)
    with ThreeNodes(_AT_SPEED) as rig:
        client = rig.observer.node.create_client(SetParameters, "bridge/set_parameters")
        began, turns = time.monotonic(), 0
        while (elapsed := time.monotonic() - began) < 3600.0 * hours / RATE:
            if elapsed >= _TURN * turns:
                turns += 1
                current = Parameter("emulated.current", value=_CURRENTS[turns % len(_CURRENTS)])
                client.call_async(SetParameters.Request(parameters=[current.to_parameter_msg()]))
            rig.observer.spin_for(1.0)
            worker = rig.worker
            # Without a worker there is an error in the log.
            if elapsed >= 3600.0 * warm_up / RATE and worker is not None:
                pids = {name: node.pid for name, node in rig.programs.items()}
                for name, pid in {**pids, "worker": worker}.items():
                    used[name].append(resident_bytes(pid))
                # Received messages are discarded, so that this program does not grow.
                del rig.reports[:-1000], rig.sets[:-1000]
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
