"""Entry points of the programs; they handle stop signals from the beginning.

Loading rclpy and SciPy takes a second or two. A stop signal during this time has the usual effect:
a node exits with code 0, a tool prints a message, and neither prints a traceback. The installed
programs block the signals while Python itself starts (see setup.py). After the program has ended,
the signals are ignored.

SciPy takes most of the loading time. A killed node should restart quickly, so the modules of a node
import SciPy only inside the functions that use it. The identifier's worker loads SciPy before its
first task. The worker starts before the node is loaded, because loading SciPy takes longer than
loading the node and receiving its first window.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from contextlib import closing
from functools import partial, wraps
from importlib import import_module
from importlib.util import find_spec
from types import FrameType

from mr_damper_ros.processes.dependencies import missing_dependency

_WORK = {
    "identifier": "scipy.optimize mr_damper_ros.tracking.tracker",
    "campaign": "scipy.optimize mr_damper_ros.campaign.course",
}
"""Modules that the worker of each node loads before the time budget of its first task starts.

The worker loads only the part of SciPy that most tasks need, so that a killed worker restarts
quickly.
"""

_SIGNALS = (signal.SIGINT, signal.SIGTERM)

_INTERRUPTED, _TERMINATED = 130, 143
"""Exit codes after Ctrl-C and after SIGTERM, by the convention of shells."""


def _explained(run: Callable[[str], int]) -> Callable[[str], int]:
    """The function, which returns 2 after one sentence if a dependency is missing at any depth."""

    @wraps(run)
    def guarded(name: str) -> int:
        try:
            return run(name)
        except ModuleNotFoundError as error:
            sentence = missing_dependency(error)
            if not sentence:
                raise
            sys.stderr.write(f"{name}: {sentence}\n")
            return 2

    return guarded


@_explained
def tool(name: str) -> int:
    """Run the module of this name in the package ``tools``; returns its exit code."""
    # A background process of a shell ignores Ctrl-C, and must continue to ignore it.
    heeded = _SIGNALS[: signal.getsignal(signal.SIGINT) is not signal.SIG_IGN]
    _end_at_once(heeded, _INTERRUPTED, f"\n{name}: stopped by Ctrl-C\n")
    main: Callable[[], int] = import_module(f"mr_damper_ros.tools.{name}").main
    for number in heeded:
        signal.signal(number, signal.default_int_handler)
    # By default the process would end without cleaning up, and leave the nodes that it has started.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(_TERMINATED))
    try:
        return main()
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@_explained
def _run(name: str) -> int:
    """Run a node, or one node in each of several namespaces with shared workers."""
    if name == "live" and any(word.partition("=")[0] == "--bag" for word in sys.argv[1:]):
        return tool("live_bag")
    # Nothing needs an orderly shutdown yet, so the process may exit during an import.
    _end_at_once(_SIGNALS, 0)
    if os.environ.get("MR_DAMPER_STARTER") == str(os.getppid()):
        from mr_damper_ros.processes.worker import request_signal_at_death

        request_signal_at_death(signal.SIGTERM)
    if name not in _WORK:
        return _run_node(name)
    from mr_damper_ros.processes.worker import WorkerPool

    with closing(WorkerPool(_WORK[name])) as workers:
        return _run_node(name, workers)


def _run_node(name: str, *arguments: object) -> int:
    node = import_module(f"mr_damper_ros.nodes.{name}_node")
    try:
        code: int = node.main(*arguments)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader has closed the pipe; Python must not flush again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    finally:
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)
    return code


def _end_at_once(numbers: tuple[signal.Signals, ...], code: int, word: str = "") -> None:
    """Let these signals end the process with an exit code, and unblock all stop signals.

    ``word`` is a message for the standard error stream.
    """

    def end(number: int, frame: FrameType | None) -> None:
        os.write(2, word.encode())
        os._exit(code)

    for number in numbers:
        signal.signal(number, end)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)


def __getattr__(name: str) -> Callable[[], int]:
    """The function that runs the node of this name and returns its exit code."""
    if name.startswith("_") or find_spec(f"mr_damper_ros.nodes.{name}_node") is None:
        raise AttributeError(f"there is no node {name}")
    return partial(_run, name)
