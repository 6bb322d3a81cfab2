"""Starts the nodes: loads them with a stop signal already heard.

Loading rclpy and SciPy takes a second or two. A signal that comes meanwhile ends the program as it
does later: with exit code 0, no traceback.

SciPy takes the most of it. A node that was killed should be back soon, so what a node loads
imports SciPy only where it is called. The identifier's worker, which loads it before its first
task, is started before the node is loaded: it takes longer than the node and its first window.
"""

from __future__ import annotations

import os
import signal
from importlib import import_module
from types import FrameType

_WORK = "mr_damper_ros.tracking.worker_preload"
"""What the identifier's worker must load for its tasks."""


def bridge() -> int:
    """Run the node bridge."""
    return _run("bridge")


def identifier() -> int:
    """Run the node identifier."""
    _hear_signals()
    from mr_damper_ros.processes.worker import Worker

    worker = Worker(_WORK)
    try:
        return _run("identifier", worker)
    finally:
        worker.close()


def model() -> int:
    """Run the node model."""
    return _run("model")


def replay() -> int:
    """Run the node replay."""
    return _run("replay")


def _run(name: str, *arguments: object) -> int:
    _hear_signals()
    code: int = import_module(f"mr_damper_ros.nodes.{name}_node").main(*arguments)
    return code


def _hear_signals() -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave)


def _leave(number: int, frame: FrameType | None) -> None:
    # Nothing has been started that would have to be ended; modules half loaded are best left so.
    os._exit(0)
