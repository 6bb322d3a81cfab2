"""Starts the programs: loads them with a stop signal already heard.

Loading rclpy and SciPy takes a second or two. A signal that comes meanwhile ends the program as it
does later: a node with exit code 0, a tool with a sentence, neither with a traceback. The installed
programs hold signals back (see setup.py) while Python itself starts, and from their end on they are
ignored.

SciPy takes the most of it. A node that was killed should be back soon, so what a node loads
imports SciPy only where it is called. The identifier's worker, which loads it before its first
task, is started before the node is loaded: it takes longer than the node and its first window.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from contextlib import closing
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from types import FrameType

_WORK = {
    "identifier": "mr_damper_ros.tracking.worker_preload",
    "campaign": "mr_damper_ros.campaign.worker_preload",
}
"""What the worker of a node must load for its tasks."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM)

_NOT_INSTALLED = 2

_INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""

_MISSING = {
    "mr_damper_msgs": "The package mr_damper_msgs is missing: build it too (in a workspace: ln -s "
    "mr_damper_ros/msg_defs src/mr_damper_msgs, then colcon build) and source install/setup.bash.",
    "rclpy": "ROS 2 is missing: source the setup.bash of ROS 2 Jazzy, or env.bash of this clone.",
    **{
        name: f"The Python package {name} is missing: rosdep install installs it."
        for name in ("rosbags", "threadpoolctl")
    },
}
"""What to do where a module cannot be imported."""


def tool(name: str) -> int:
    """Run the tool of this name, a module of the room tools; returns its exit code."""
    # It may not heed Ctrl-C, as in the background of a shell.
    heeded = _SIGNALS[: signal.getsignal(signal.SIGINT) is not signal.SIG_IGN]
    _end_at_once(heeded, _INTERRUPTED, f"\n{name}: stopped by Ctrl-C\n")
    main: Callable[[], int] = import_module(f"mr_damper_ros.tools.{name}").main
    for number in heeded:
        signal.signal(number, signal.default_int_handler)
    try:
        return main()
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _run(name: str) -> int:
    """Run a node, or one in each of several namespaces, which share workers."""
    if name == "live" and any(word.partition("=")[0] == "--bag" for word in sys.argv[1:]):
        return tool("live_bag")
    # Nothing has been started that would have to be ended; modules half loaded are best left so.
    _end_at_once(_SIGNALS, 0)
    if name not in _WORK:
        return _run_node(name)
    from mr_damper_ros.processes.programs import worker_count
    from mr_damper_ros.processes.worker import WorkerPool

    with closing(WorkerPool(_WORK[name], worker_count(sys.argv[1:]))) as workers:
        return _run_node(name, workers)


def _run_node(name: str, *arguments: object) -> int:
    try:
        node = import_module(f"mr_damper_ros.nodes.{name}_node")
    except ModuleNotFoundError as error:
        # Without ROS many modules are missing, of which that of rclpy need not be the first.
        missing = (error.name or "").partition(".")[0] if find_spec("rclpy") else "rclpy"
        if missing not in _MISSING:
            raise
        print(_MISSING[missing], file=sys.stderr)
        return _NOT_INSTALLED
    try:
        code: int = node.main(*arguments)
        sys.stdout.flush()
    except BrokenPipeError:  # who was reading has enough; Python must not try to flush again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    finally:
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)
    return code


def _end_at_once(numbers: tuple[signal.Signals, ...], code: int, word: str = "") -> None:
    """Have these signals end the process with a code, and deliver those that were held back."""

    def end(number: int, frame: FrameType | None) -> None:
        os.write(2, word.encode())
        os._exit(code)

    for number in numbers:
        signal.signal(number, end)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)


def __getattr__(name: str) -> Callable[[], int]:
    """What runs the node of this name, and returns its exit code."""
    if name.startswith("_") or find_spec(f"mr_damper_ros.nodes.{name}_node") is None:
        raise AttributeError(f"there is no node {name}")
    return partial(_run, name)
