"""Endurance tests of the nodes: kills, Ctrl-C, and hours of data at increased speed."""

from __future__ import annotations

import os
import random
import signal
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mr_damper_msgs.msg import DamperParameters, FitReport, MtsSamples, PredictedForce
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter

from benchmarks.figure import Measured
from benchmarks.processes import ProfiledDomain, resident_bytes, start_node
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.observer import Observer
from mr_damper_ros.processes.programs import Program, RosDomain, node_arguments
from mr_damper_ros.tracking.state_directory import StateDirectory, StateError
from mr_damper_ros.tracking.tracker import TrackerMemory
from mr_damper_ros.tracking.tracker_state import from_text

NODES = ("bridge", "identifier", "model")

_BAD_WORDS = ("[ERROR]", "[FATAL]", "Traceback")


class ThreeNodes:
    """The three nodes in a separate domain; the log of each ended node is kept.

    ``options`` are the parameters of each node, in the form that ``start_node`` takes; the
    identifier keeps its state in ``folder``.
    """

    def __init__(self, folder: Path, options: Mapping[str, Mapping[str, object]]) -> None:
        self.state = StateDirectory(folder)
        self._options = {**options, "identifier": {**options["identifier"], "state_dir": folder}}
        self._domain = ProfiledDomain()
        self._ended: list[str] = []
        self.observer = Observer(domain=self._domain)
        # Deeper than the queue of the publisher, so that no message replaces an earlier one.
        latched = quality.latched()
        latched.depth = 100
        listen = self.observer.listen
        self.sets: list[DamperParameters] = listen(DamperParameters, "damper/parameters", latched)
        self.reports: list[FitReport] = listen(FitReport, "damper/fit_report", quality.stream())
        self.nodes: dict[str, Program] = {}

    def begin(self) -> None:
        """Start all nodes, and wait until they work."""
        for name in NODES:
            self.start(name)
        self.observer.wait_for_publishers("mts/samples")
        self.observer.wait_for_publishers("damper/predicted_force")
        self.observer.until(lambda: self.reports, "the first report")

    def close(self) -> None:
        """Stop all running nodes."""
        for node in self.nodes.values():
            node.stop()
            self._forget(node)
        self.observer.close()
        self._domain.close()

    def start(self, name: str) -> Program:
        """Start a node that replaces the ended node of this name."""
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
        """Error lines in the logs of all nodes, including ended ones."""
        running = [node.log for node in self.nodes.values() if node.running]
        return [
            line
            for log in self._ended + running
            for line in log.splitlines()
            if any(word in line for word in _BAD_WORDS)
        ]


@contextmanager
def three_nodes(options: Mapping[str, Mapping[str, object]]) -> Iterator[ThreeNodes]:
    """The nodes with a state folder in build/, since a temporary folder may be in memory."""
    Path("build").mkdir(exist_ok=True)
    with (
        tempfile.TemporaryDirectory(dir="build") as folder,
        closing(ThreeNodes(Path(folder).absolute(), options)) as rig,
    ):
        rig.begin()
        yield rig


# -- kill -9 ---------------------------------------------------------------------------------------

_HEATING: dict[str, dict[str, object]] = {
    # The damper heats fast, so most windows yield a new set.
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
"""Messages that must resume after the kill of each node."""

_LONGEST_WAIT = 2.0
"""Longest random time [s] until the next kill."""

_PART_IN_START = 0.2
"""Fraction of the kills that hit a killed node while it restarts."""

_UNDER_WAY = 0.3
"""Time [s] within which all messages of a killed process arrive; no node starts faster."""


@dataclass(frozen=True)
class Kill:
    """Result of a kill: ``recovery`` [s], and ``fault``, which is empty if the state is intact."""

    victim: str
    recovery: float
    fault: str


def kill_figures(nodes: int = 100, seed: int = 0) -> Measured:
    """Kill each node, and the worker, the same number of times."""
    kills = kill_all(nodes, nodes, seed)
    slowest = {
        victim: max((k.recovery for k in kills if k.victim == victim), default=0.0)
        for victim in _TOPICS
    }
    faults = [f"{kill.victim}: {kill.fault}" for kill in kills if kill.fault]
    return {
        "kills_intact": (1.0 - len(faults) / len(kills), f"Of {len(kills)}. " + "; ".join(faults)),
        "recovery_s_max": (
            max(slowest.values()),
            ", ".join(f"{victim} {time:.2f} s" for victim, time in slowest.items()),
        ),
    }


def kill_all(nodes: int, workers: int, seed: int) -> list[Kill]:
    """All kills, in random order."""
    chance = random.Random(seed)
    victims = [NODES[index % len(NODES)] for index in range(nodes)] + ["worker"] * workers
    chance.shuffle(victims)
    with three_nodes(_HEATING) as rig:
        kills = [_kill(rig, victim, chance) for victim in victims]
        errors = rig.errors
    if errors and kills:
        kills[-1] = Kill(kills[-1].victim, kills[-1].recovery, f"errors in a log: {errors[0]}")
    return kills


def _kill(rig: ThreeNodes, victim: str, chance: random.Random) -> Kill:
    """One kill, and the check of the remaining state."""
    accepted = len(rig.sets)
    rig.observer.until(lambda: len(rig.sets) > accepted, "another set")
    rig.observer.spin_for(chance.uniform(0.0, _LONGEST_WAIT))
    if victim != "worker" and chance.random() < _PART_IN_START:
        rig.nodes[victim].kill()
        rig.start(victim)
        rig.observer.spin_for(chance.uniform(0.0, _LONGEST_WAIT))
    kind, topic = _TOPICS[victim]
    came: list[float] = []

    def hear(message: MtsSamples | PredictedForce) -> None:
        if getattr(message, "valid", True):
            came.append(time.monotonic())

    subscription = rig.observer.node.create_subscription(kind, topic, hear, quality.stream())
    began = time.monotonic()
    try:
        if victim == "worker":
            if rig.worker is not None:
                os.kill(rig.worker, signal.SIGKILL)
        else:
            rig.nodes[victim].kill()
        if victim == "identifier":
            fault, looked = _restarted(rig, came)
        else:
            fault, looked = _gone_on(rig, victim, came), 0.0
        return Kill(victim, came[0] - began - looked, fault)
    except TimeoutError as error:
        return Kill(victim, float("inf"), str(error))
    finally:
        rig.observer.node.destroy_subscription(subscription)


def _gone_on(rig: ThreeNodes, victim: str, came: list[float]) -> str:
    """Faults after the kill of a process other than the identifier."""
    if victim != "worker":
        rig.start(victim)
    pid, last = rig.nodes["identifier"].pid, rig.sets[-1].id
    rig.observer.spin_for(_UNDER_WAY)
    came.clear()
    rig.observer.until(lambda: came, f"{victim} after its kill", tick=0.01)
    if rig.nodes["identifier"].pid != pid or not rig.nodes["identifier"].running:
        return "the identifier has ended"
    return "the set was lost" if rig.sets[-1].id == "literature" != last else _read(rig)[2]


def _restarted(rig: ThreeNodes, came: list[float]) -> tuple[str, float]:
    """Faults after the kill of the identifier, and the time [s] that it did not cause."""
    # Before the next start, its last messages are received and its stored state is read.
    began = time.monotonic()
    rig.observer.spin_for(_UNDER_WAY)
    last = rig.sets[-1]
    before, memory, fault = _read(rig)
    looked = time.monotonic() - began
    came.clear()
    count = len(rig.sets)
    rig.start("identifier")
    rig.observer.until(lambda: len(rig.sets) > count, "the set after a restart", tick=0.01)
    rig.observer.until(lambda: came, "a report after a restart", tick=0.01)
    if fault or before is None or memory is None:
        return fault, looked
    again = rig.sets[count]
    if not _is_next(before, last):
        fault = f"{before.set_id} was kept, but {last.id} had been published"
    elif f"going on with parameters {before.set_id} " not in rig.nodes["identifier"].log:
        fault = f"{before.set_id} was kept, but it did not go on with it"
    elif list(again.values) != before.values.tolist() and _number(again.id) <= _number(
        before.set_id
    ):
        fault = f"{before.set_id} was kept, but {again.id} was published"
    rig.observer.until(lambda: rig.reports[-1].accepted, "an accepted window")
    after = _read(rig)[1]
    if after is None or not _same_baselines(memory, after):
        fault = fault or "the baselines are others"
    return fault, looked


def _read(rig: ThreeNodes) -> tuple[ParameterSet | None, TrackerMemory | None, str]:
    """The stored set, its memory, and their faults."""
    try:
        kept, text = rig.state.load_with_memory("identifier")
        if not text:
            return kept, None, "" if kept.set_id == "literature" else "the memory is lost"
        return kept, from_text(text, kept.law), ""
    except StateError as error:
        return None, None, str(error)


def _is_next(kept: ParameterSet, published: DamperParameters) -> bool:
    """Whether a stored set is the published one, or one that was about to be published."""
    if kept.set_id == published.id:
        return kept.values.tolist() == list(published.values)
    return _number(kept.set_id) > _number(published.id) >= 0


def _number(set_id: str) -> int:
    """Number in the name of a set; -1 without a number."""
    number = set_id.rpartition("-")[2]
    return int(number) if number.isdigit() else -1


def _same_baselines(before: TrackerMemory, after: TrackerMemory) -> bool:
    """Whether all previous baselines still exist."""
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
"""Namespaces. They ensure that identifier and model receive only the bridge that always streams."""

START, _OLDEST = 0.8, 3.0
"""Half of the signals arrive at an age of the node below the first number [s], while it loads and
starts. The other half arrive later, up to the second age [s]."""

_PAUSE = 0.15
"""Longest time [s] between the first and a second signal."""

_SIGINT_BIT = 1 << (signal.SIGINT - 1)


@dataclass(frozen=True)
class Interrupt:
    """A Ctrl-C at an ``age`` [s] of the node, the time to end [s], and a ``fault``, if any."""

    node: str
    age: float
    signals: int
    duration: float
    fault: str


def interrupt_figures(count: int = 200, seed: int = 0) -> Measured:
    """Interrupt each node ``count`` times."""
    interrupts = interrupt_all(count, seed)
    faults = [f"{one.node} at {one.age:.2f} s: {one.fault}" for one in interrupts if one.fault]
    slowest = max(interrupts, key=lambda one: one.duration)
    return {
        "interrupts_unclean": (len(faults), f"Of {len(interrupts)}. " + "; ".join(faults[:5])),
        "interrupt_s_max": (slowest.duration, slowest.node),
    }


def interrupt_all(count: int, seed: int) -> list[Interrupt]:
    """All interrupts, each node in turn."""
    chance = random.Random(seed)
    with ExitStack() as stack:
        domain = stack.enter_context(closing(ProfiledDomain()))
        stack.enter_context(closing(start_node("bridge", domain)))
        return [_interrupt(node, domain, chance) for _ in range(count) for node in INTERRUPTED]


def _interrupt(node: str, domain: RosDomain, chance: random.Random) -> Interrupt:
    early = chance.random() < 0.5
    age = chance.uniform(0.0, START) if early else chance.uniform(START, _OLDEST)
    pauses = [0.0, *([chance.uniform(0.0, _PAUSE)] if chance.random() < 0.5 else [])]
    began = time.monotonic()
    namespace = node_arguments({}, {"__ns": _APART.get(node, "/")})
    process = start_node(node, domain, *namespace, **_TO_START.get(node, {}))
    _wait_until_held_back(process)
    time.sleep(max(began + age - time.monotonic(), 0.0))
    pressed = time.monotonic()
    for pause in pauses:
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
    return Interrupt(node, age, len(pauses), duration, fault)


def _wait_until_held_back(process: Program) -> None:
    """Wait until the process blocks or catches SIGINT: from then on the package handles it."""
    status = Path(f"/proc/{process.pid}/status")
    while process.running:
        fields = dict(line.split(":\t", 1) for line in status.read_text().splitlines())
        if any(int(fields[name], 16) & _SIGINT_BIT for name in ("SigBlk", "SigCgt")):
            return


# -- hours of data ---------------------------------------------------------------------------------

RATE = 20.0
"""Speed relative to the data's time."""

_CURRENTS, _CURRENT_PERIOD = (1.5, 1.0, 0.5), 20.0
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
    "model": {},
}


def stream_figures(hours: float = 8.0) -> Measured:
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
    with three_nodes(_AT_SPEED) as rig:
        turn = _turning(rig)
        seconds = 3600.0 / RATE
        _watch(rig, turn, warm_up * seconds)
        used = _watch(rig, turn, (hours - warm_up) * seconds)
        errors = rig.errors + [
            f"the {name} has ended" for name, node in rig.nodes.items() if not node.running
        ]
        if not any(report.accepted for report in rig.reports[-100:]):
            errors.append("no window was accepted at the end")
    edge = max(round(_EDGE * len(used["worker"])), 1)
    growth = {
        name: 1e-6 * (statistics.median(sizes[-edge:]) - statistics.median(sizes[:edge]))
        for name, sizes in used.items()
    }
    return growth, errors


def _turning(rig: ThreeNodes) -> Callable[[], None]:
    """Function that changes the setpoint of the bridge's supply when it is due."""
    client = rig.observer.node.create_client(SetParameters, "bridge/set_parameters")
    began, turns = time.monotonic(), 0

    def turn() -> None:
        nonlocal turns
        if time.monotonic() >= began + _CURRENT_PERIOD * turns:
            turns += 1
            current = Parameter("emulated.current", value=_CURRENTS[turns % len(_CURRENTS)])
            client.call_async(SetParameters.Request(parameters=[current.to_parameter_msg()]))

    return turn


def _watch(rig: ThreeNodes, turn: Callable[[], None], duration: float) -> dict[str, list[int]]:
    """Memory [B] of each process at each measurement."""
    used: dict[str, list[int]] = {name: [] for name in [*rig.nodes, "worker"]}
    end = time.monotonic() + duration
    while time.monotonic() < end or not used["worker"]:
        turn()
        rig.observer.spin_for(_LOOK)
        worker = rig.worker
        if worker is None:
            continue  # it would be an error in the log
        for name, node in rig.nodes.items():
            used[name].append(resident_bytes(node.pid))
        used["worker"].append(resident_bytes(worker))
        # Received messages are discarded, so that the memory of this program does not grow.
        del rig.reports[:-1000], rig.sets[:-1000]
    return used
