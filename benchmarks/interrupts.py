"""Press Ctrl-C at random moments of each node's life, once or twice, and see how it ends."""

from __future__ import annotations

import os
import random
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from benchmarks.figure import Figure
from benchmarks.processes import ProfiledDomain, start_node
from mr_damper_ros.processes.programs import Program, RosDomain, node_arguments

NODES = ("bridge", "identifier", "live", "model", "replay")

_BAG = Path(__file__).parents[1] / "bags" / "5.0mm_1Hz_1.5A"

_OPTIONS: dict[str, dict[str, object]] = {
    "live": {"port": 0},
    "replay": {"bag": _BAG, "loop": True, "wait_for_subscribers": 0},
}

_APART = {"bridge": "/interrupted", "replay": "/interrupted"}
"""Namespaces: identifier and model hear the bridge that streams all the time, and it alone."""

START = 0.8
"""Half of the signals come in so many seconds of a node's life, in which it loads and starts."""

_LONGEST_LIFE = 3.0
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


def figures(count: int = 200, seed: int = 0) -> list[Figure]:
    """Interrupt each node so many times."""
    interrupts = campaign(count, seed)
    faults = [
        f"{one.node} at {one.age:.2f} s, {one.signals} signals: {one.fault}"
        for one in interrupts
        if one.fault
    ]
    return [
        Figure(
            "interrupts",
            len(interrupts),
            f"Ctrl-C, single and double, on each of {', '.join(NODES)} while a bridge streams, at "
            f"random moments, half of them in the first {START:g} s; counted from when `env` "
            "holds signals back, about a millisecond after the start",
            (len(NODES) * count, len(NODES) * count),
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


def campaign(count: int, seed: int) -> list[Interrupt]:
    """All interrupts, each node in turn."""
    chance = random.Random(seed)
    domain = ProfiledDomain()
    bridge = start_node("bridge", domain)
    try:
        return [_interrupt(node, domain, chance) for _ in range(count) for node in NODES]
    finally:
        bridge.close()
        domain.close()


def _interrupt(node: str, domain: RosDomain, chance: random.Random) -> Interrupt:
    early = chance.random() < 0.5
    age = chance.uniform(0.0, START) if early else chance.uniform(START, _LONGEST_LIFE)
    pauses = [chance.uniform(0.0, _PAUSE)] if chance.random() < 0.5 else []
    began = time.monotonic()
    namespace = _APART.get(node, "/")
    process = start_node(
        node, domain, *node_arguments({}, {"__ns": namespace}), **_OPTIONS.get(node, {})
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
        for node in NODES
    )
