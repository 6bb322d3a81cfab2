"""Common properties of all child processes of this package.

A child is a new interpreter, not a fork, because DDS threads do not survive a fork. It finds the
modules of its parent, but none in the working directory of the program. Ctrl-C, which goes to all
processes of a terminal, is left to the parent. The child ends with its parent, even if the parent
is killed.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
from collections.abc import Callable
from importlib import import_module

_PR_SET_PDEATHSIG = 1

_START = (
    "import sys; count, *rest = sys.argv[1:]; "
    "sys.path[:] = rest[int(count):]; del rest[int(count):]; "
    f"from {__name__} import _run; _run(*rest)"
)


def command(function: Callable[..., object], *arguments: str) -> list[str]:
    """Command line of a child that calls ``function(*arguments)``, a function of a module.

    Start the child in its own session.
    """
    call = [str(os.getpid()), function.__module__, function.__qualname__, *arguments]
    paths = map(os.path.abspath, sys.path)
    # Isolated: only the given import paths count, not the environment.
    return [sys.executable, "-I", "-c", _START, str(len(call)), *call, *paths]


def live_with(parent: int) -> None:
    """Called by the child: leave Ctrl-C to the process ``parent``, and end together with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    request_signal_at_death(signal.SIGKILL)
    # The parent may have died before.
    if os.getppid() != parent:
        os._exit(1)


def request_signal_at_death(number: signal.Signals) -> None:
    """Let this process receive a signal when its parent dies, for whatever reason (Linux)."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)


def _run(parent: str, module: str, function: str, *arguments: str) -> None:
    live_with(int(parent))
    getattr(import_module(module), function)(*arguments)
