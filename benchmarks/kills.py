"""Kill each node, and the identifier's worker, at random moments; see what is left and how soon
data come again.

The supervisor is this program: it starts a killed node at once, the identifier starts its worker
itself. The rig runs at its own pace, a sine of 1 Hz at 1 kHz in blocks of 10.
"""  # noqa: D205

from __future__ import annotations

import os
import random
import signal
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mr_damper_msgs.msg import DamperParameters, FitReport, MtsSamples, PredictedForce

from benchmarks.figure import Figure
from benchmarks.three_nodes import NODES, Heard, ThreeNodes
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.tracking.state_directory import StateError
from mr_damper_ros.tracking.tracker import TrackerMemory
from mr_damper_ros.tracking.tracker_state import from_text

_BUILD = Path("build")
"""The state is kept here: a folder for temporary files may be one that forgets nothing quickly."""

_OPTIONS: dict[str, dict[str, object]] = {
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


def figures(nodes: int = 100, workers: int = 100, seed: int = 0) -> list[Figure]:
    """Kill nodes and the worker so many times."""
    kills = campaign(nodes, workers, seed)
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


def campaign(nodes: int, workers: int, seed: int) -> list[Kill]:
    """All kills, in random order."""
    chance = random.Random(seed)
    victims = [NODES[index % len(NODES)] for index in range(nodes)] + ["worker"] * workers
    chance.shuffle(victims)
    _BUILD.mkdir(exist_ok=True)
    with (
        tempfile.TemporaryDirectory(dir=_BUILD, prefix="kills-") as folder,
        ThreeNodes(Path(folder).absolute(), _OPTIONS) as rig,
    ):
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
    return len(after.baselines) >= len(before.baselines) and all(
        np.array_equal(one.coefficients, other.coefficients)
        for one, other in zip(before.baselines, after.baselines, strict=False)
    )
