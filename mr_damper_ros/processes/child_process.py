"""Common properties of all child processes of this package.

A child is a fresh interpreter, never a fork: DDS threads do not survive a fork. It finds the
modules of its parent, but none in the working directory of the program. It leaves Ctrl-C, which
goes to all processes of a terminal, to its parent. It dies with its parent, however that one ends.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
from collections.abc import Callable
from importlib import import_module
from multiprocessing.context import SpawnContext, SpawnProcess
from multiprocessing.process import BaseProcess
from types import ModuleType
from typing import Any

from mr_damper_ros.processes.blas_threads import keep_one_thread

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


def compute_for(parent: int) -> None:
    """As :func:`live_with`, for a child that computes, with one BLAS thread."""
    live_with(parent)
    keep_one_thread()


def live_with(parent: int) -> None:
    """Leave Ctrl-C to the parent process with this id, and die with it. The child calls this."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    # The parent may have died before the call of prctl.
    if os.getppid() != parent:
        os._exit(1)


class _FreshProcess(SpawnProcess):
    """A process that does not run the parent's main script."""

    @staticmethod
    def _Popen(process_obj: BaseProcess) -> Any:  # noqa: N802
        program = sys.modules["__main__"]
        # The empty module gives the child no main script to run.
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            return SpawnProcess._Popen(process_obj)  # type: ignore[attr-defined]
        finally:
            sys.modules["__main__"] = program


class FreshContext(SpawnContext):
    """A multiprocessing context for functions of modules, whose children skip the main script.

    By default, ``multiprocessing`` lets each child run the parent's main script first. Its imports
    may take seconds and are of no use to the child, and unguarded code in it would run again.
    ``children`` are the started processes.
    """

    def __init__(self) -> None:
        self.children: list[SpawnProcess] = []

    def Process(self, *args: Any, **options: Any) -> SpawnProcess:  # type: ignore[override]  # noqa: N802
        """A new process, not yet started; see :class:`multiprocessing.Process`."""
        self.children.append(_FreshProcess(*args, **options))
        return self.children[-1]


def _run(parent: str, module: str, function: str, *arguments: str) -> None:
    live_with(int(parent))
    getattr(import_module(module), function)(*arguments)
