"""Kills and interrupts of the nodes at random moments."""

from __future__ import annotations

import os
import random
import signal
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mr_damper_msgs.msg import DamperParameters, FitReport, MtsSamples, PredictedForce

from benchmarks.figure import Measured
from benchmarks.nodes import NODES, Nodes, ThreeNodes
from mr_damper_ros.nodes import quality
from mr_damper_ros.processes.programs import Program, node_arguments
from mr_damper_ros.tracking.state_directory import StateError
from mr_damper_ros.tracking.tracker_state import from_text

# -- kill -9 ---------------------------------------------------------------------------------------

_HEATING: dict[str, dict[str, object]] = {
    # The damper heats fast, so most windows yield a new set.
    "bridge": {"emulated__heat_capacity": 20.0, "emulated__conductance": 0.0},
    "identifier": {"window": 1.0, "hop": 0.5, "method": "least_squares", "global_period": 0},
}

_TOPICS: dict[str, tuple[type, str]] = {
    "bridge": (MtsSamples, "mts/samples"),
    "identifier": (FitReport, "damper/fit_report"),
    "model": (PredictedForce, "damper/predicted_force"),
    "worker": (FitReport, "damper/fit_report"),
}
"""Messages that must resume after the kill of each process."""

_LONGEST_WAIT = 2.0
"""Longest random time [s] until the next kill."""

_PART_IN_START = 0.2
"""Fraction of the kills that hit a killed node while it restarts."""

_UNDER_WAY = 0.3
"""Time [s] within which all messages of a killed process arrive; no node starts faster."""


class Kill(NamedTuple):
    """Result of a kill: ``recovery`` [s], and ``fault``, which is empty if the state is intact."""

    victim: str
    recovery: float
    fault: str


def figures(nodes: int = 100, seed: int = 0) -> Measured:
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
    with ThreeNodes(_HEATING) as rig:
        kills = [_kill(rig, victim, chance) for victim in victims]
        errors = rig.errors
    if errors and kills:
        kills[-1] = kills[-1]._replace(fault=f"errors in a log: {errors[0]}")
    return kills


def _kill(rig: ThreeNodes, victim: str, chance: random.Random) -> Kill:
    """One kill, and the check of the remaining state."""
    accepted, observer = len(rig.sets), rig.observer
    observer.until(lambda: len(rig.sets) > accepted, "another set")
    observer.spin_for(chance.uniform(0.0, _LONGEST_WAIT))
    if victim != "worker" and chance.random() < _PART_IN_START:
        rig.programs[victim].kill()
        rig.restart(victim)
        observer.spin_for(chance.uniform(0.0, _LONGEST_WAIT))
    kind, topic = _TOPICS[victim]
    came: list[float] = []

    def hear(message: Any) -> None:
        if getattr(message, "valid", True):
            came.append(time.monotonic())

    subscription = observer.node.create_subscription(kind, topic, hear, quality.stream())
    began, looked = time.monotonic(), 0.0
    try:
        if victim != "worker":
            rig.programs[victim].kill()
        elif rig.worker is not None:
            os.kill(rig.worker, signal.SIGKILL)
        if victim in ("bridge", "model"):
            rig.restart(victim)
        killed = time.monotonic()
        observer.spin_for(_UNDER_WAY)
        last, count, kept = rig.sets[-1], len(rig.sets), _read(rig)
        came.clear()
        if victim == "identifier":
            # Before its next start its last messages have come, and its state has been read.
            looked = time.monotonic() - killed
            rig.restart(victim)
            observer.until(lambda: len(rig.sets) > count, "the set after a restart", tick=0.01)
        observer.until(lambda: came, f"{victim} after its kill", tick=0.01)
        fault = _lost(rig, last, kept, count) if victim == "identifier" else _harmed(rig, last)
        return Kill(victim, came[0] - began - looked, fault)
    except TimeoutError as error:
        return Kill(victim, float("inf"), str(error))
    finally:
        observer.node.destroy_subscription(subscription)


def _harmed(rig: ThreeNodes, last: DamperParameters) -> str:
    """Faults after the kill of a process other than the identifier."""
    if not rig.programs["identifier"].running:
        return "the identifier has ended"
    return "the set was lost" if rig.sets[-1].id == "literature" != last.id else _read(rig)[2]


def _lost(rig: ThreeNodes, last: DamperParameters, kept: tuple[Any, Any, str], count: int) -> str:
    """Faults after a kill of the identifier, of which ``last`` was published and ``kept`` left."""
    before, memory, fault = kept
    if before is None or memory is None:
        return fault
    again = rig.sets[count]
    is_newer = _number(before.set_id) > _number(last.id) >= 0
    is_last = before.set_id == last.id and before.values.tolist() == list(last.values)
    if not (is_newer or is_last):
        fault = f"{before.set_id} was kept, but {last.id} had been published"
    elif f"continuing with parameters {before.set_id} " not in rig.programs["identifier"].log:
        fault = f"{before.set_id} was kept, but it did not go on with it"
    elif list(again.values) != before.values.tolist() and _number(again.id) <= _number(
        before.set_id
    ):
        fault = f"{before.set_id} was kept, but {again.id} was published"
    rig.observer.until(lambda: rig.reports[-1].accepted, "an accepted window")
    baselines, after = memory.points.baselines, _read(rig)[1]
    found = [] if after is None else after.points.baselines
    same = len(found) >= len(baselines) and all(
        np.array_equal(one.baseline, other.baseline)
        for one, other in zip(baselines, found, strict=False)
    )
    return fault or ("" if after and same else "the baselines are others")


def _read(rig: ThreeNodes) -> tuple[Any, Any, str]:
    """The stored set, its memory, and their faults."""
    try:
        kept, text = rig.state.load("identifier")
        if not text:
            return kept, None, "" if kept.set_id == "literature" else "the memory is lost"
        return kept, from_text(text, kept.law), ""
    except StateError as error:
        return None, None, str(error)


def _number(set_id: str) -> int:
    """Number in the name of a set; -1 without a number."""
    number = set_id.rpartition("-")[2]
    return int(number) if number.isdigit() else -1


# -- Ctrl-C ----------------------------------------------------------------------------------------

INTERRUPTED: dict[str, dict[str, object]] = {
    "bridge": {},
    "identifier": {},
    "live": {"port": 0},
    "model": {},
    "replay": {
        "bag": Path(__file__).parents[1] / "bags" / "5.0mm_1Hz_1.5A",
        "loop": True,
        "wait_for_subscribers": 0,
    },
}
"""Nodes and their parameters."""

_SENDING = ("bridge", "replay")
"""Nodes in another namespace: the others receive only the bridge that always streams."""

START, _OLDEST = 0.8, 3.0
"""Half of the signals arrive at an age of the node below the first number [s], while it loads and
starts. The other half arrive later, up to the second age [s]."""

_PAUSE = 0.15
"""Longest time [s] between a first and a second signal."""


class Interrupt(NamedTuple):
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
    with Nodes() as nodes:
        nodes.start_as("stream", "bridge")
        return [_interrupt(nodes, node, chance) for _ in range(count) for node in INTERRUPTED]


def _interrupt(nodes: Nodes, node: str, chance: random.Random) -> Interrupt:
    early = chance.random() < 0.5
    age = chance.uniform(0.0, START) if early else chance.uniform(START, _OLDEST)
    pauses = [0.0, *([chance.uniform(0.0, _PAUSE)] if chance.random() < 0.5 else [])]
    began = time.monotonic()
    arguments = node_arguments({}, {"__ns": "/interrupted" if node in _SENDING else "/"})
    process = nodes.start(node, *arguments, **INTERRUPTED[node])
    time.sleep(max(began + age - time.monotonic(), 0.0))
    if not process.running:
        return Interrupt(node, age, 0, 0.0, f"it ended by itself: {process.log[-400:]!r}")
    loaded, pressed = _is_loaded(process), time.monotonic()
    for pause in pauses:
        time.sleep(pause)
        process.send_signal(signal.SIGINT)
    code = process.wait()
    duration = time.monotonic() - pressed
    fault = f"exit code {code}" if loaded and code else ""
    if loaded and ("Traceback" in process.log or "KeyboardInterrupt" in process.log):
        fault += f" {process.log[-400:]!r}"
    return Interrupt(node, age, len(pauses), duration, fault)


def _is_loaded(process: Program) -> bool:
    """Whether the node has loaded its modules: then it catches SIGTERM, which Python does not."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    fields = dict(line.split(":\t", 1) for line in status.splitlines())
    return bool(int(fields["SigCgt"], 16) & 1 << (signal.SIGTERM - 1))
