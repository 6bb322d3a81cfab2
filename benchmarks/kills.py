"""Kills and interrupts at random moments: of nodes, of their worker, and of a long program."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mr_damper_msgs.msg import DamperParameters, FitReport, MtsSamples, PredictedForce

from benchmarks.figure import Measured
from benchmarks.nodes import Nodes
from mr_damper_ros.emulation.emulator import EmulatedDamper, EmulatedRig, RigSettings, scaled
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.nodes import quality
from mr_damper_ros.processes.programs import Program, node_arguments
from mr_damper_ros.tracking.state_directory import StateDirectory, StateError
from mr_damper_ros.tracking.tracker import TrackerMemory
from mr_damper_ros.tracking.tracker_state import from_text

NODES = ("bridge", "identifier", "model")


class ThreeNodes(Nodes):
    """Bridge, identifier and model; the identifier keeps its state in ``folder``.

    ``options`` are the parameters of each node.
    """

    def __init__(self, folder: Path, options: Mapping[str, Mapping[str, object]]) -> None:
        super().__init__()
        self.state = StateDirectory(folder)
        self._options = {**options, "identifier": {**options["identifier"], "state_dir": folder}}
        # Deeper than the queue of the publisher, so that no message replaces an earlier one.
        latched = quality.latched()
        latched.depth = 100
        listen = self.observer.listen
        self.sets: list[DamperParameters] = listen(DamperParameters, "damper/parameters", latched)
        self.reports: list[FitReport] = listen(FitReport, "damper/fit_report", quality.stream())
        for name in NODES:
            self.restart(name)
        for topic in ("mts/samples", "damper/predicted_force"):
            self.observer.wait_for_publishers(topic)
        self.observer.until(lambda: self.reports, "the first report")

    def restart(self, name: str) -> Program:
        """Start a node that replaces the ended node of this name."""
        return self.start(name, **self._options.get(name, {}))

    @property
    def worker(self) -> int | None:
        """Id of the identifier's worker process; None while there is none."""
        children = self.programs["identifier"].children
        return children[0] if children else None


@contextmanager
def three_nodes(options: Mapping[str, Mapping[str, object]]) -> Iterator[ThreeNodes]:
    """The nodes with a state folder in build/, since a temporary folder may be in memory."""
    Path("build").mkdir(exist_ok=True)
    with (
        tempfile.TemporaryDirectory(dir="build") as folder,
        ThreeNodes(Path(folder).absolute(), options) as rig,
    ):
        yield rig


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


@dataclass(frozen=True)
class Kill:
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
        rig.programs[victim].kill()
        rig.restart(victim)
        rig.observer.spin_for(chance.uniform(0.0, _LONGEST_WAIT))
    kind, topic = _TOPICS[victim]
    came: list[float] = []

    def hear(message: MtsSamples | PredictedForce) -> None:
        if getattr(message, "valid", True):
            came.append(time.monotonic())

    subscription = rig.observer.node.create_subscription(kind, topic, hear, quality.stream())
    began = time.monotonic()
    try:
        if victim != "worker":
            rig.programs[victim].kill()
        elif rig.worker is not None:
            os.kill(rig.worker, signal.SIGKILL)
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
        rig.restart(victim)
    identifier, last = rig.programs["identifier"], rig.sets[-1].id
    rig.observer.spin_for(_UNDER_WAY)
    came.clear()
    rig.observer.until(lambda: came, f"{victim} after its kill", tick=0.01)
    if not identifier.running:
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
    identifier = rig.restart("identifier")
    rig.observer.until(lambda: len(rig.sets) > count, "the set after a restart", tick=0.01)
    rig.observer.until(lambda: came, "a report after a restart", tick=0.01)
    if before is None or memory is None:
        return fault, looked
    again = rig.sets[count]
    newer = _number(again.id) > _number(before.set_id)
    if not _is_next(before, last):
        fault = f"{before.set_id} was kept, but {last.id} had been published"
    elif f"continuing with parameters {before.set_id} " not in identifier.log:
        fault = f"{before.set_id} was kept, but it did not go on with it"
    elif list(again.values) != before.values.tolist() and not newer:
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

_BAG = Path(__file__).parents[1] / "bags" / "5.0mm_1Hz_1.5A"

INTERRUPTED: dict[str, dict[str, object]] = {
    "bridge": {},
    "identifier": {},
    "live": {"port": 0},
    "model": {},
    "replay": {"bag": _BAG, "loop": True, "wait_for_subscribers": 0},
}
"""Nodes and their parameters."""

_SENDING = ("bridge", "replay")
"""Nodes in another namespace: the others receive only the bridge that always streams."""

START, _OLDEST = 0.8, 3.0
"""Half of the signals arrive at an age of the node below the first number [s], while it loads and
starts. The other half arrive later, up to the second age [s]."""

_PAUSE = 0.15
"""Longest time [s] between a first and a second signal."""

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
    with Nodes() as nodes:
        nodes.start_as("stream", "bridge")
        return [_interrupt(nodes, node, chance) for _ in range(count) for node in INTERRUPTED]


def _interrupt(nodes: Nodes, node: str, chance: random.Random) -> Interrupt:
    early = chance.random() < 0.5
    age = chance.uniform(0.0, START) if early else chance.uniform(START, _OLDEST)
    pauses = [0.0, *([chance.uniform(0.0, _PAUSE)] if chance.random() < 0.5 else [])]
    began = time.monotonic()
    namespace = "/interrupted" if node in _SENDING else "/"
    arguments = node_arguments({}, {"__ns": namespace})
    process = nodes.start(node, *arguments, **INTERRUPTED[node])
    _wait_until_held_back(process)
    time.sleep(max(began + age - time.monotonic(), 0.0))
    pressed = time.monotonic()
    for pause in pauses:
        time.sleep(pause)
        process.send_signal(signal.SIGINT)
    code = process.wait()
    duration = time.monotonic() - pressed
    fault = f"exit code {code}" if code else ""
    if "Traceback" in process.log or "KeyboardInterrupt" in process.log:
        fault += f" {process.log[-400:]!r}"
    return Interrupt(node, age, len(pauses), duration, fault)


def _wait_until_held_back(process: Program) -> None:
    """Wait until the process blocks or catches SIGINT: from then on the package handles it."""
    status = Path(f"/proc/{process.pid}/status")
    while process.running:
        fields = dict(line.split(":\t", 1) for line in status.read_text().splitlines())
        if any(int(fields[name], 16) & _SIGINT_BIT for name in ("SigBlk", "SigCgt")):
            return


# -- a program that is called again after each kill ------------------------------------------------

_RATE = 500.0

_READING: dict[str, Any] = {
    "columns": "displacement:mm,force:N,current:A",
    "period": 1.0 / _RATE,
}
"""Options for reading the recordings."""

_SCRIPT = f"""
import sys
sys.path[:] = {sys.path!r}
from pathlib import Path
from mr_damper_ros.lots.many_dampers import identify_many

if __name__ == "__main__":
    results = Path(sys.argv[1])
    lot = results.parent / "lot"
    identify_many(lot, folder=results, method="least_squares", workers=2, **{_READING!r})
"""

_SPREAD = 0.03
"""Standard deviation of the force scale over the lot."""

_LONGEST_CALL = 4.0
"""Longest time [s] between two kills, which includes the start of the program."""

_PATIENCE = 1800.0
"""Time limit [s] of the last call."""


def program_figures(kills: int = 50, seed: int = 0, dampers: int = 300) -> Measured:
    """Kill ``identify_many`` and one of its processes in turn; stored results must stay as is."""
    chance = random.Random(seed)
    faults: list[str] = []
    seen: dict[Path, int] = {}
    Path("build").mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir="build") as folder:
        place = Path(folder).absolute()
        (place / "program.py").write_text(_SCRIPT)
        _write_lot(place / "lot", dampers)
        results = place / "results"
        command = [sys.executable, str(place / "program.py"), str(results)]
        program = subprocess.Popen(command)
        for number in range(kills):
            if program.poll() is not None:
                program = subprocess.Popen(command)
            time.sleep(chance.uniform(0.0, _LONGEST_CALL))
            children = _children(program.pid)
            victim = program.pid if number % 2 == 0 or not children else chance.choice(children)
            os.kill(victim, signal.SIGKILL)
            if victim == program.pid:
                program.wait()
            faults += _changed(results, seen)
        program.wait(_PATIENCE)
        subprocess.run(command, check=True, timeout=_PATIENCE)
        faults += _changed(results, seen)
        if len(seen) != dampers:
            faults.append(f"{dampers - len(seen)} dampers are missing")
    return {"many_kills_faults": (len(faults), f"{kills} kills. " + "; ".join(faults[:3]))}


def _changed(results: Path, seen: dict[Path, int]) -> list[str]:
    """Faults of the stored results; ``seen`` has the time at which each was written."""
    now = {path: path.stat().st_mtime_ns for path in results.glob("dampers/[!.]*.json")}
    faults = [f"{path.name} is gone" for path in seen.keys() - now.keys()]
    for path, written in now.items():
        if seen.get(path, written) != written:
            faults.append(f"{path.name} was made again")
        if path not in seen:
            try:
                json.loads(path.read_text(encoding="utf-8"))
            except ValueError:
                faults.append(f"{path.name} is damaged")
    seen.update(now)
    return faults


def _children(process: int) -> list[int]:
    """Processes of the pool, without the resource tracker (Linux only)."""
    try:
        text = Path(f"/proc/{process}/task/{process}/children").read_text()
        return [
            int(word)
            for word in text.split()
            if b"spawn_main" in Path(f"/proc/{word}/cmdline").read_bytes()
        ]
    except OSError:
        return []


def _write_lot(folder: Path, dampers: int) -> None:
    """A number of dampers with a recording of half a second each."""
    rng = np.random.default_rng(0)
    for number in range(dampers):
        values = scaled(THESIS_28_CELSIUS, 1.0 + _SPREAD * rng.standard_normal())
        settings = RigSettings(sample_rate=_RATE, seed=(0, number))
        rig = EmulatedRig(EmulatedDamper(values), SineMotion(5e-3, 4.0), 0.5, settings=settings)
        run = rig.record(0.5)
        rows = np.column_stack((1e3 * run.displacement, run.force, run.current))
        path = folder / f"D{number:04}" / "run.csv"
        path.parent.mkdir(parents=True)
        np.savetxt(path, rows, fmt="%.7g", delimiter=",")
