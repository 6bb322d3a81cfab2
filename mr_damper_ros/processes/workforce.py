"""Who does many independent tasks: processes of this machine, a Dask cluster, or an executor.

All of them hand out an executor of ``concurrent.futures``; what differs is who can be lost with a
task, and whether the workers share the folders of this process.
"""

from __future__ import annotations

import os
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor
from typing import Any, Protocol

from mr_damper_ros.processes import child_process

_AHEAD = 2
"""Tasks given out for each process, so that none waits for its next one."""

_AT_ONCE = 64
"""Tasks given at once to an executor whose size is not known."""


class Workforce(Protocol):
    """``at_once``: so many tasks are given out at a time.

    ``shares_folders``: whether the workers see the folders of this process. ``breaks_with``: what a
    future raises where its worker has died and all others with it; ``loses_with``: where its worker
    has died again and again with this one task.
    """

    at_once: int
    shares_folders: bool
    breaks_with: tuple[type[Exception], ...]
    loses_with: tuple[type[Exception], ...]

    def start(self) -> Executor:
        """An executor; again after the one before was broken."""

    def end(self) -> None:
        """Let the executor go; what it is doing is given up."""


class LocalProcesses:
    """``count`` fresh processes of this machine, each with one BLAS thread.

    Raises ValueError for less than one.
    """

    shares_folders = True
    breaks_with: tuple[type[Exception], ...] = (BrokenExecutor,)
    loses_with: tuple[type[Exception], ...] = ()

    def __init__(self, count: int) -> None:
        if count < 1:
            raise ValueError(f"workers is {count}: at least 1 is needed")
        self.at_once = _AHEAD * count
        self._count = count
        self._context = child_process.FreshContext()
        self._pool: ProcessPoolExecutor | None = None

    def start(self) -> Executor:
        """An executor whose processes die with this one."""
        self.end()
        self._context = child_process.FreshContext()
        self._pool = ProcessPoolExecutor(
            self._count,
            self._context,
            initializer=child_process.compute_for,
            initargs=(os.getpid(),),
        )
        return self._pool

    def end(self) -> None:
        """End the processes, whatever they are doing."""
        if self._pool is None:
            return
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in self._context.children:
            process.kill()
        self._pool = None


class GivenExecutor:
    """An executor of somebody else, who ends it. Whoever it is, its processes are theirs."""

    at_once = _AT_ONCE
    shares_folders = False
    breaks_with: tuple[type[Exception], ...] = ()
    loses_with: tuple[type[Exception], ...] = ()

    def __init__(self, executor: Executor) -> None:
        self._executor = executor

    def start(self) -> Executor:
        """The executor given."""
        return self._executor

    def end(self) -> None:
        """Leave it to its owner."""


class DaskCluster:
    """The workers of a Dask cluster that runs already, found by the address of its scheduler.

    They need this package and the paths of the recordings, nothing else. Raises ValueError where
    Dask is not installed, and OSError where nobody answers.
    """

    shares_folders = False
    breaks_with: tuple[type[Exception], ...] = ()

    def __init__(self, address: str) -> None:
        try:
            from distributed import Client, KilledWorker
        except ImportError as error:
            raise ValueError(
                "a scheduler was given, and Dask is not installed: install distributed"
            ) from error
        try:
            self._client: Any = Client(address, set_as_default=False)
        except OSError as error:
            raise OSError(f"no Dask scheduler answers at {address}: is it running?") from error
        threads = sum(self._client.nthreads().values())
        if threads == 0:
            self._client.close()
            raise OSError(f"the Dask scheduler at {address} has no workers: start some")
        self.at_once = _AHEAD * threads
        self.loses_with: tuple[type[Exception], ...] = (KilledWorker,)

    def start(self) -> Executor:
        """The executor of the cluster."""
        executor: Executor = self._client.get_executor(pure=False)
        return executor

    def end(self) -> None:
        """Leave the cluster; it drops what it was doing for this process."""
        self._client.close()
