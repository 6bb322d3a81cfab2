"""What only time and violence show of the nodes: kills, Ctrl-C, hours of data at speed."""

from __future__ import annotations

import os
import random
import signal
import statistics
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np
from mr_damper_msgs.msg import DamperParameters, FitReport, MtsSamples, PredictedForce
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter

from benchmarks.figure import Figure
from benchmarks.processes import ProfiledDomain, start_node
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.observer import Observer
from mr_damper_ros.processes.programs import Program, RosDomain, node_arguments, resident_bytes
from mr_damper_ros.tracking.state_directory import StateDirectory, StateError
from mr_damper_ros.tracking.tracker import TrackerMemory
from mr_damper_ros.tracking.tracker_state import from_text

NODES = ("bridge", "identifier", "model")

_BAD_WORDS = ("[ERROR]", "[FATAL]", "Traceback")


class ThreeNodes:
    """The three nodes in a domain of their own; every end of one leaves its log behind.

    ``options`` are the parameters of each node, in the form that ``start_node`` takes; the
    identifier keeps its state in ``folder``.
    """

    def __init__(self, folder: Path, options: Mapping[str, Mapping[str, object]]) -> None:
        self.state = StateDirectory(folder)
        self._options = {**options, "identifier": {**options["identifier"], "state_dir": folder}}
        self._domain = ProfiledDomain()
        self._ended: list[str] = []
        self.sets: list[DamperParameters] = []
        self.reports: list[FitReport] = []
        self.observer = Observer(domain=self._domain)
        # More than the publisher's one message: none shall replace another on its way.
        latched = quality.latched()
        latched.depth = 100
        self.observer.listen(DamperParameters, "damper/parameters", latched, self.sets.append)
        self.observer.listen(FitReport, "damper/fit_report", quality.stream(), self.reports.append)
        self.nodes: dict[str, Program] = {}

    def __enter__(self) -> ThreeNodes:
        for name in NODES:
            self.start(name)
        self.observer.wait_for_publishers("mts/samples")
        self.observer.wait_for_publishers("damper/predicted_force")
        self.observer.until(lambda: self.reports, "the first report")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for node in self.nodes.values():
            node.stop()
            self._forget(node)
        self.observer.close()
        self._domain.close()

    def start(self, name: str) -> Program:
        """Start a node, in place of the one of this name, which has ended."""
        if name in self.nodes:
            self._forget(self.nodes[name])
        self.nodes[name] = start_node(name, self._domain, **self._options[name])
        return self.nodes[name]

    def _forget(self, node: Program) -> None:
        self._ended.append(node.log)
        node.close()

    @property
    def worker(self) -> int | None:
        """Id of the identifier's worker process; None while there is none."""
        children = self.nodes["identifier"].children
        return children[0] if children else None

    @property
    def errors(self) -> list[str]:
        """Lines that tell of errors in the logs of all nodes, those that have ended too."""
        running = [node.log for node in self.nodes.values() if node.running]
        return [
            line
            for log in self._ended + running
            for line in log.splitlines()
            if any(word in line for word in _BAD_WORDS)
        ]

    def hear_next(self, message_type: type, topic: str) -> Heard:
        """Wait for messages on a topic from now on."""
        return Heard(self.observer, message_type, topic)


class Heard:
    """When the first message that counts has come on a topic; ``close`` it when done."""

    def __init__(self, observer: Observer, message_type: type, topic: str) -> None:
        self._node = observer.node
        self.at: float | None = None
        self._subscription = self._node.create_subscription(
            message_type, topic, self._take, quality.stream()
        )

    def _take(self, message: MtsSamples | PredictedForce) -> None:
        if self.at is None and getattr(message, "valid", True):
            self.at = time.monotonic()

    def forget(self) -> None:
        """What has come so far does not count."""
        self.at = None

    def close(self) -> None:
        """Listen no longer."""
        self._node.destroy_subscription(self._subscription)


@contextmanager
def three_nodes(options: Mapping[str, Mapping[str, object]]) -> Iterator[ThreeNodes]:
    """The nodes with a state folder in build/: one for temporary files may be in memory."""
    Path("build").mkdir(exist_ok=True)
    with (
        tempfile.TemporaryDirectory(dir="build") as folder,
        ThreeNodes(Path(folder).absolute(), options) as rig,
    ):
        yield rig


# -- kill -9 ---------------------------------------------------------------------------------------

_HEATING: dict[str, dict[str, object]] = {
    # A damper that heats fast: most windows bring a new set.
    "bridge": {"emulated__heat_capacity": 20.0, "emulated__conductance": 0.0},
    "identifier": {"window": 1.0, "hop": 0.5, "method": "least_squares", "global_period": 0},
    "model": {},
}

_TOPICS: dict[str, tuple[type, str]] = {
    "bridge": (MtsSamples, "mts/samples"),
    "identifier": (FitReport, "damper/fit_report"),
    "model": (PredictedForce, "damper/predicted_force"),
    "worker": (FitReport, "damper/fit_report"),
}
"""What must come again after the kill of each."""

_LONGEST_WAIT = 2.0
"""The next kill comes after a random time [s] of up to this much."""

_PART_IN_START = 0.2
"""Part of the kills that hit a node that has been killed and is still starting."""

_UNDER_WAY = 0.3
"""Seconds after which what a killed process had sent has come; no node starts faster."""


@dataclass(frozen=True)
class Kill:
    """What came of a kill: ``recovery`` [s], and ``fault``, empty where the state is intact."""

    victim: str
    recovery: float
    fault: str


def kill_figures(nodes: int = 100, workers: int = 100, seed: int = 0) -> list[Figure]:
    """Kill nodes and the worker so many times."""
    kills = kill_all(nodes, workers, seed)
    slowest = {
        victim: max((k.recovery for k in kills if k.victim == victim), default=0.0)
        for victim in _TOPICS
    }
    faults = [f"{kill.victim}: {kill.fault}" for kill in kills if kill.fault]
    return [
        Figure(
            "kills",
            len(kills),
            "kill -9 of bridge, identifier and model in turn and of the identifier's worker, at "
            "random moments, some while the node starts",
            (nodes + workers, nodes + workers),
        ),
        Figure(
            "kills_intact",
            sum(not kill.fault for kill in kills),
            "of them, those after which the kept file has the right checksum and holds the last "
            "published set, the next start goes on with it, and baselines and reservoir stay",
            (len(kills), len(kills)),
            "; ".join(faults),
        ),
        Figure(
            "recovery_s_max",
            max(kill.recovery for kill in kills),
            "longest time [s] from a kill, followed at once by the start of the node, to its next "
            "samples, report of a window (1 s of new data), or valid force (after three reversals "
            "of a motion of 1 Hz)",
            (0.0, 3.0),
            ", ".join(f"{victim} {time:.2f} s" for victim, time in slowest.items()),
        ),
    ]


def kill_all(nodes: int, workers: int, seed: int) -> list[Kill]:
    """All kills, in random order."""
    chance = random.Random(seed)
    victims = [NODES[index % len(NODES)] for index in range(nodes)] + ["worker"] * workers
    chance.shuffle(victims)
    with three_nodes(_HEATING) as rig:
        kills = [_Execution(rig, victim, chance).carry_out() for victim in victims]
        errors = rig.errors
    if errors and kills:
        kills[-1] = Kill(kills[-1].victim, kills[-1].recovery, f"errors in a log: {errors[0]}")
    return kills


class _Execution:
    """One kill, and the look at what it has left."""

    def __init__(self, rig: ThreeNodes, victim: str, chance: random.Random) -> None:
        self._rig = rig
        self._victim = victim
        self._chance = chance

    def carry_out(self) -> Kill:
        rig = self._rig
        heard = rig.hear_next(*_TOPICS[self._victim])
        accepted = len(rig.sets)
        rig.observer.until(lambda: len(rig.sets) > accepted, "another set")
        rig.observer.spin_for(self._chance.uniform(0.0, _LONGEST_WAIT))
        if self._victim != "worker" and self._chance.random() < _PART_IN_START:
            rig.nodes[self._victim].kill()
            rig.start(self._victim)
            rig.observer.spin_for(self._chance.uniform(0.0, _LONGEST_WAIT))
        try:
            recovery, fault = self._kill(heard)
        except TimeoutError as error:
            recovery, fault = float("inf"), str(error)
        heard.close()
        return Kill(self._victim, recovery, fault)

    def _kill(self, heard: Heard) -> tuple[float, str]:
        rig, victim = self._rig, self._victim
        began = time.monotonic()
        if victim == "worker":
            if rig.worker is not None:
                os.kill(rig.worker, signal.SIGKILL)
        else:
            rig.nodes[victim].kill()
        if victim == "identifier":
            return self._identifier(began, heard)
        if victim != "worker":
            rig.start(victim)
        pid, last = rig.nodes["identifier"].pid, rig.sets[-1].id
        rig.observer.spin_for(_UNDER_WAY)
        heard.forget()
        rig.observer.until(lambda: heard.at, f"{victim} after its kill", tick=0.01)
        assert heard.at is not None
        fault = ""
        if rig.nodes["identifier"].pid != pid or not rig.nodes["identifier"].running:
            fault = "the identifier has ended"
        elif rig.sets[-1].id == "literature" != last:
            fault = "the set was lost"
        else:
            fault = self._read()[2]
        return heard.at - began, fault

    def _identifier(self, began: float, heard: Heard) -> tuple[float, str]:
        rig = self._rig
        # What it had sent is heard, and what it left is read, before the next one begins; the time
        # that this takes is not the identifier's.
        rig.observer.spin_for(_UNDER_WAY)
        last = rig.sets[-1]
        before, memory, fault = self._read()
        looked = time.monotonic() - began
        heard.forget()
        count = len(rig.sets)
        rig.start("identifier")
        rig.observer.until(lambda: len(rig.sets) > count, "the set after a restart", tick=0.01)
        rig.observer.until(lambda: heard.at, "a report after a restart", tick=0.01)
        assert heard.at is not None
        recovery = heard.at - began - looked
        if fault or before is None or memory is None:
            return recovery, fault
        again = rig.sets[count]
        if not _not_older(before, last):
            fault = f"{before.set_id} was kept, but {last.id} had been published"
        elif f"going on with parameters {before.set_id} " not in rig.nodes["identifier"].log:
            fault = f"{before.set_id} was kept, but it did not go on with it"
        elif not _is_next(again, before):
            fault = f"{before.set_id} was kept, but {again.id} was published"
        rig.observer.until(lambda: rig.reports[-1].accepted, "an accepted window")
        after = self._read()[1]
        if after is None or not _same_baselines(memory, after):
            fault = fault or "the baselines are others"
        return recovery, fault

    def _read(self) -> tuple[ParameterSet | None, TrackerMemory | None, str]:
        """The kept set, its memory, and what is wrong with them."""
        try:
            kept, text = self._rig.state.load_with_memory("identifier")
            if not text:
                return kept, None, "" if kept.set_id == "literature" else "the memory is lost"
            return kept, from_text(text, kept.law), ""
        except StateError as error:
            return None, None, str(error)


def _not_older(kept: ParameterSet, published: DamperParameters) -> bool:
    """Whether a kept set is the published one, or one that was just about to be published."""
    if kept.set_id == published.id:
        return kept.values.tolist() == list(published.values)
    return _number(kept.set_id) > _number(published.id) >= 0


def _is_next(published: DamperParameters, kept: ParameterSet) -> bool:
    """Whether a set is the kept one, or one that was fitted to data that came meanwhile."""
    if published.id == kept.set_id:
        return list(published.values) == kept.values.tolist()
    return _number(published.id) > _number(kept.set_id)


def _number(set_id: str) -> int:
    """Number in the name of a set; -1 where there is none."""
    number = set_id.rpartition("-")[2]
    return int(number) if number.isdigit() else -1


def _same_baselines(before: TrackerMemory, after: TrackerMemory) -> bool:
    """Whether all baselines of before are still there."""
    return len(after.points.baselines) >= len(before.points.baselines) and all(
        np.array_equal(one.coefficients, other.coefficients)
        for one, other in zip(before.points.baselines, after.points.baselines, strict=False)
    )


# -- Ctrl-C ----------------------------------------------------------------------------------------

INTERRUPTED = ("bridge", "identifier", "live", "model", "replay")

_BAG = Path(__file__).parents[1] / "bags" / "5.0mm_1Hz_1.5A"

_TO_START: dict[str, dict[str, object]] = {
    "live": {"port": 0},
    "replay": {"bag": _BAG, "loop": True, "wait_for_subscribers": 0},
}

_APART = {"bridge": "/interrupted", "replay": "/interrupted"}
"""Namespaces: identifier and model hear the bridge that streams all the time, and it alone."""

START = 0.8
"""Half of the signals come in so many seconds of a node's life, in which it loads and starts."""

_OLDEST = 3.0
"""The others come later, up to this age [s]."""

_PAUSE = 0.15
"""A second signal follows the first within so many seconds."""

_SIGINT_BIT = 1 << (signal.SIGINT - 1)


@dataclass(frozen=True)
class Interrupt:
    """A Ctrl-C: the node's age [s] then, how long it took to end [s]; no ``fault``: in order."""

    node: str
    age: float
    signals: int
    duration: float
    fault: str


def interrupt_figures(count: int = 200, seed: int = 0) -> list[Figure]:
    """Interrupt each node so many times."""
    interrupts = interrupt_all(count, seed)
    faults = [
        f"{one.node} at {one.age:.2f} s, {one.signals} signals: {one.fault}"
        for one in interrupts
        if one.fault
    ]
    return [
        Figure(
            "interrupts",
            len(interrupts),
            f"Ctrl-C, single and double, on {', '.join(INTERRUPTED)} while a bridge streams, at "
            f"random moments, half of them in the first {START:g} s; counted from when `env` "
            "holds signals back, about a millisecond after the start",
            (len(INTERRUPTED) * count, len(INTERRUPTED) * count),
        ),
        Figure(
            "interrupts_unclean",
            len(faults),
            "of them, those after which the exit code is not 0 or a traceback is printed",
            (0, 0),
            "; ".join(faults[:5]),
        ),
        Figure(
            "interrupt_s_max",
            max(one.duration for one in interrupts),
            "longest time [s] from a Ctrl-C to the end of the process",
            note=_slowest(interrupts),
        ),
    ]


def interrupt_all(count: int, seed: int) -> list[Interrupt]:
    """All interrupts, each node in turn."""
    chance = random.Random(seed)
    domain = ProfiledDomain()
    bridge = start_node("bridge", domain)
    try:
        return [_interrupt(node, domain, chance) for _ in range(count) for node in INTERRUPTED]
    finally:
        bridge.close()
        domain.close()


def _interrupt(node: str, domain: RosDomain, chance: random.Random) -> Interrupt:
    early = chance.random() < 0.5
    age = chance.uniform(0.0, START) if early else chance.uniform(START, _OLDEST)
    pauses = [chance.uniform(0.0, _PAUSE)] if chance.random() < 0.5 else []
    began = time.monotonic()
    namespace = _APART.get(node, "/")
    process = start_node(
        node, domain, *node_arguments({}, {"__ns": namespace}), **_TO_START.get(node, {})
    )
    _wait_until_held_back(process)
    time.sleep(max(began + age - time.monotonic(), 0.0))
    pressed = time.monotonic()
    for pause in [0.0, *pauses]:
        time.sleep(pause)
        if process.running:
            os.kill(process.pid, signal.SIGINT)
    code = process.wait()
    duration = time.monotonic() - pressed
    log = process.log
    process.close()
    fault = f"exit code {code}" if code else ""
    if "Traceback" in log or "KeyboardInterrupt" in log:
        fault += f" {log[-400:]!r}"
    return Interrupt(node, age, 1 + len(pauses), duration, fault)


def _wait_until_held_back(process: Program) -> None:
    """Wait until a signal is held back or heard: from there on it is the package's business."""
    status = Path(f"/proc/{process.pid}/status")
    while process.running:
        fields = dict(line.split(":\t", 1) for line in status.read_text().splitlines())
        if any(int(fields[name], 16) & _SIGINT_BIT for name in ("SigBlk", "SigCgt")):
            return


def _slowest(interrupts: list[Interrupt]) -> str:
    return ", ".join(
        f"{node} {max(one.duration for one in interrupts if one.node == node):.2f} s"
        for node in INTERRUPTED
    )


# -- hours of data ------------------------------------------------------------

RATE = 20.0
"""Speed relative to the data's time."""

_CURRENTS = (1.5, 1.0, 0.5)
"""The supply is set to these [A] in turn: new baselines, a fuller reservoir, refused windows."""

_CURRENT_PERIOD = 20.0
"""Seconds between two settings of the supply."""

_LOOK = 1.0
"""Seconds between two looks at the memory in use."""

_EDGE = 0.1
"""The memory at the start and at the end is the median over this part of the time between."""

_MB = 1e6

_AT_SPEED: dict[str, dict[str, object]] = {
    "bridge": {"rate": RATE, "block_size": 100},
    # On a busy computer fits fall behind at this speed: what waits for them is no leak.
    "identifier": {
        "hop": 2.0,
        "waiting_windows": 10,
        "method": "least_squares",
        "global_period": 500,
    },
    "model": {},
}


def stream_figures(hours: float = 8.0, warm_up: float = 1.0) -> list[Figure]:
    """Stream so many hours of data; the first ``warm_up`` hours do not count.

    Within the first hour memory grows by design: nodes keep the currents of an hour.
    """
    growth, errors = soak(hours, warm_up)
    worst = max(growth, key=lambda name: growth[name])
    return [
        Figure(
            "soak_growth_mb",
            growth[worst],
            f"{hours:g} h of data at {RATE:g} x: growth [MB] of the resident memory of the process "
            f"that grows most, from {warm_up:g} h of data to the end",
            (-float("inf"), 5.0),
            ", ".join(f"{name} {value:+.2f}" for name, value in growth.items()),
        ),
        Figure(
            "soak_errors",
            len(errors),
            "lines that tell of an error in the logs of the three nodes, and nodes that ended",
            (0.0, 0.0),
            errors[0] if errors else "",
        ),
    ]


def soak(hours: float, warm_up: float) -> tuple[dict[str, float], list[str]]:
    """Growth [MB] of each process, and what went wrong."""
    with three_nodes(_AT_SPEED) as rig:
        supply = _Supply(rig)
        seconds = 3600.0 / RATE
        _watch(rig, supply, warm_up * seconds)
        used = _watch(rig, supply, (hours - warm_up) * seconds)
        errors = rig.errors + [
            f"the {name} has ended" for name, node in rig.nodes.items() if not node.running
        ]
        if not any(report.accepted for report in rig.reports[-100:]):
            errors.append("no window was accepted at the end")
    edge = max(round(_EDGE * len(next(iter(used.values())))), 1)
    growth = {
        name: (statistics.median(sizes[-edge:]) - statistics.median(sizes[:edge])) / _MB
        for name, sizes in used.items()
    }
    return growth, errors


class _Supply:
    """Turns the knob of the bridge's supply now and then."""

    def __init__(self, rig: ThreeNodes) -> None:
        self._client = rig.observer.node.create_client(SetParameters, "bridge/set_parameters")
        self._next = time.monotonic()
        self._turns = 0

    def turn_if_due(self) -> None:
        if time.monotonic() < self._next:
            return
        self._next += _CURRENT_PERIOD
        self._turns += 1
        current = _CURRENTS[self._turns % len(_CURRENTS)]
        message: ParameterMessage = Parameter("emulated.current", value=current).to_parameter_msg()
        self._client.call_async(SetParameters.Request(parameters=[message]))


def _watch(rig: ThreeNodes, supply: _Supply, duration: float) -> dict[str, list[int]]:
    """Memory [B] of each process, look by look."""
    used: dict[str, list[int]] = {name: [] for name in [*rig.nodes, "worker"]}
    end = time.monotonic() + duration
    while time.monotonic() < end or not used["worker"]:
        supply.turn_if_due()
        rig.observer.spin_for(_LOOK)
        worker = rig.worker
        if worker is None:
            continue  # it would be an error in the log
        for name, node in rig.nodes.items():
            used[name].append(node.resident_bytes)
        used["worker"].append(resident_bytes(worker))
        # What was heard is not the subject: this program's own memory shall not grow either.
        del rig.reports[:-1000], rig.sets[:-1000]
    return used
