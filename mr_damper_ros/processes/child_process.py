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

    Start it in a session of its own.
    """
    call = [str(os.getpid()), function.__module__, function.__qualname__, *arguments]
    paths = map(os.path.abspath, sys.path)
    # Isolated: the import paths are those handed over, whatever the environment says.
    return [sys.executable, "-I", "-c", _START, str(len(call)), *call, *paths]


def compute_for(parent: int) -> None:
    """As :func:`live_with`, for a child that computes, with one thread of BLAS."""
    live_with(parent)
    keep_one_thread()


def live_with(parent: int) -> None:
    """Leave Ctrl-C to the parent, the process of this id, and die with it. Called by a child."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    # It may have died before that was said.
    if os.getppid() != parent:
        os._exit(1)


class _FreshProcess(SpawnProcess):
    """One that does not read its parent's program."""

    @staticmethod
    def _Popen(process_obj: BaseProcess) -> Any:  # noqa: N802
        program = sys.modules["__main__"]
        # There is nothing to be read in it.
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            return SpawnProcess._Popen(process_obj)  # type: ignore[attr-defined]
        finally:
            sys.modules["__main__"] = program


class FreshContext(SpawnContext):
    """Of processes that multiprocessing starts for functions of modules, not of the program.

    It has its children read their parent's program first, whose imports may take seconds and are
    of no use to them; and what is not guarded in it they would do again. ``children`` are those
    that it has started.
    """

    def __init__(self) -> None:
        self.children: list[SpawnProcess] = []

    def Process(self, *args: Any, **options: Any) -> SpawnProcess:  # type: ignore[override]  # noqa: N802
        """A process that has not started yet; see :class:`multiprocessing.Process`."""
        self.children.append(_FreshProcess(*args, **options))
        return self.children[-1]


def _run(parent: str, module: str, function: str, *arguments: str) -> None:
    live_with(int(parent))
    getattr(import_module(module), function)(*arguments)
