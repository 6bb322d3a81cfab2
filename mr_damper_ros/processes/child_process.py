"""What all child processes of this package have in common.

A child is a fresh interpreter, never a fork: DDS threads do not survive one. It finds the modules
that its parent finds, and nothing in the folder in which the program was called; it leaves Ctrl-C,
which goes to a whole terminal, to its parent; and it dies with its parent, however that one ends.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
from collections.abc import Callable
from importlib import import_module

SINGLE_THREADED = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment in which BLAS computes with one thread: the arrays here are small, more threads
would get in each other's way, and sums would depend on their number."""

_PR_SET_PDEATHSIG = 1

_START = (
    "import sys; count, *rest = sys.argv[1:]; "
    "sys.path[:] = rest[int(count):]; del rest[int(count):]; "
    f"from {__name__} import _run; _run(*rest)"
)


def command(function: Callable[..., object], *arguments: str) -> list[str]:
    """Command line of a child that calls ``function(*arguments)``, a function of a module.

    Start it with the environment that it is to have, in a session of its own.
    """
    call = [str(os.getpid()), function.__module__, function.__qualname__, *arguments]
    paths = map(os.path.abspath, sys.path)
    # Isolated: the import paths are those handed over, whatever the environment says.
    return [sys.executable, "-I", "-c", _START, str(len(call)), *call, *paths]


def live_with(parent: int) -> None:
    """Leave Ctrl-C to the parent, the process of this id, and die with it. Called by a child."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    # It may have died before that was said.
    if os.getppid() != parent:
        os._exit(1)


def _run(parent: str, module: str, function: str, *arguments: str) -> None:
    live_with(int(parent))
    getattr(import_module(module), function)(*arguments)
