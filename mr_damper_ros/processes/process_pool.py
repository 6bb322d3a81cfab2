"""Independent tasks in several processes, with the same results for any number of them.

A task is a picklable function of one picklable argument, and depends on nothing else. Each process
computes with one BLAS thread, because sums depend on the number of threads: the results agree to
the last digit.

Results may be stored (:func:`finish`), each in its own file, written completely or not at all, as
soon as it is complete. A stored result is never computed again. Such a task returns a JSON document
and raises no exception; a failure is part of its document.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import re
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import Any, TypeVar

from mr_damper_ros.processes import child_process
from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.processes.files import write_text

Task = TypeVar("Task")
Result = TypeVar("Result")

Tell = Callable[[Any], bool]
"""Callback for the progress of a task; if it returns False, the task should return its present
result soon."""

Listen = Callable[[int, Any], bool]
"""Receives the index of a task and its progress; returning False stops all tasks."""

_PATIENCE = 0.05
"""Seconds between two checks for progress of the processes."""


def _checked(count: int) -> int:
    if count < 1:
        raise ValueError(f"workers is {count}: at least 1 is needed")
    return count


class ProcessPool(AbstractContextManager):
    """A context with ``count`` processes, started when there are tasks for them.

    With a count of one, or in a process that may not have children (a daemon of
    ``multiprocessing``), the tasks run in this process. Raises ValueError for a count below one.
    """

    def __init__(self, count: int = 1) -> None:
        self.count = 1 if multiprocessing.current_process().daemon else _checked(count)
        self._pool: ProcessPoolExecutor | None = None

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._stop.set()
            self._pool.shutdown(wait=True, cancel_futures=True)

    def map(
        self,
        function: Callable[[Task, Tell], Result],
        tasks: Sequence[Task],
        listen: Listen | None = None,
        done: Callable[[int, Result], None] | None = None,
    ) -> list[Result | None]:
        """``function(task, tell)`` of every task, in order; None if a task was not started.

        ``listen`` receives the progress of the tasks and may stop them; running tasks then return
        their present results. ``done`` is called with each result as soon as it is complete, in any
        order.
        """
        results: list[Result | None] = [None] * len(tasks)
        stopped = False

        def tell(index: int, news: Any) -> bool:
            nonlocal stopped
            stopped = stopped or not (listen is None or listen(index, news))
            return not stopped

        def keep(index: int, result: Result) -> None:
            results[index] = result
            if done is not None:
                done(index, result)

        if self.count == 1 or len(tasks) < 2:
            for index, task in enumerate(tasks):
                if not stopped:
                    with one_thread():
                        result = function(task, partial(tell, index))
                    keep(index, result)
            return results
        pool = self._started()
        numbered = {pool.submit(_call, function, t, index): index for index, t in enumerate(tasks)}
        waiting = set(numbered)
        try:
            while waiting:
                finished, waiting = wait(waiting, timeout=_PATIENCE)
                for future in finished:
                    if not future.cancelled():
                        keep(numbered[future], future.result())
                while not self._progress.empty():
                    if not tell(*self._progress.get()) and not self._stop.is_set():
                        self._end(waiting)
        finally:
            self._end(waiting)
            while waiting:  # after an exception; a process whose progress is not read cannot end
                waiting = wait(waiting, timeout=_PATIENCE).not_done
                while not self._progress.empty():
                    self._progress.get()
        return results

    def _end(self, waiting: set[Future[Any]]) -> None:
        if waiting:
            self._stop.set()
        for future in waiting:
            future.cancel()

    def _started(self) -> ProcessPoolExecutor:
        if self._pool is None:
            context = multiprocessing.get_context("spawn")
            self._stop = context.Event()
            self._progress: SimpleQueue[tuple[int, Any]] = context.SimpleQueue()
            channel = (os.getpid(), self._stop, self._progress)
            self._pool = ProcessPoolExecutor(self.count, context, _begin, channel)
        return self._pool


_channel: tuple[Any, SimpleQueue[tuple[int, Any]]] | None = None
"""In a pool process: the stop event and the queue for progress."""


def _begin(parent: int, stop: Any, progress: SimpleQueue[tuple[int, Any]]) -> None:
    global _channel
    _channel = stop, progress
    child_process.compute_for(parent)


def _call(function: Callable[[Task, Tell], Result], task: Task, index: int) -> Result:
    assert _channel is not None
    stop, progress = _channel

    def tell(news: Any) -> bool:
        if stop.is_set():
            return False
        progress.put((index, news))
        return True

    return function(task, tell)


_AHEAD = 2
"""Submitted tasks per process, so that no process waits for its next task."""

_AT_ONCE = 64
"""Number of tasks submitted at once to an executor of unknown size."""


class Workforce:
    """An executor that belongs to the caller, and the properties of its workers.

    ``at_once`` is the number of tasks submitted at a time. ``breaks_with`` are the exceptions of a
    future if its worker and all others have died. ``loses_with`` are those if workers have
    repeatedly died with this one task.
    """

    at_once = _AT_ONCE
    breaks_with: tuple[type[Exception], ...] = ()
    loses_with: tuple[type[Exception], ...] = ()

    def __init__(self, executor: Executor) -> None:
        self._executor = executor

    def start(self) -> Executor:
        """Return the executor, or a new one if the previous one is broken."""
        return self._executor

    def end(self) -> None:
        """Release the executor: its owner ends it."""


class LocalProcesses(Workforce):
    """``count`` fresh processes on this machine, each with one BLAS thread.

    Raises ValueError for a count below one.
    """

    breaks_with = (BrokenExecutor,)

    def __init__(self, count: int) -> None:
        self._count = _checked(count)
        self.at_once = _AHEAD * count
        self._pool: ProcessPoolExecutor | None = None

    def start(self) -> Executor:
        """Return a new executor whose processes die with this one."""
        self.end()
        self._context = child_process.FreshContext()
        self._pool = ProcessPoolExecutor(
            self._count, self._context, child_process.compute_for, (os.getpid(),)
        )
        return self._pool

    def end(self) -> None:
        """End the processes, even if they are busy."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
            for process in self._context.children:
                process.kill()
            self._pool = None


class DaskCluster(Workforce):
    """The workers of a running Dask cluster, found by the address of its scheduler.

    They need only this package and the paths of the recordings. Raises ValueError if Dask is not
    installed, and OSError if no scheduler answers or it has no workers.
    """

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
        super().__init__(self._client.get_executor(pure=False))
        self.at_once = _AHEAD * threads
        self.loses_with = (KilledWorker,)

    def end(self) -> None:
        """Leave the cluster; it drops the tasks of this process."""
        self._client.close()


Document = dict[str, Any]

_SUSPECT = 2
"""After so many deaths of processes while it was running, a task runs alone."""

_GIVEN_UP = 4
"""After so many deaths of processes while it was running, a task is given up."""

_SLUG = 60
"""Largest number of characters of a task's name in the name of its file."""


@dataclass(frozen=True)
class KeptTask:
    """A task with a stored result.

    ``name`` is unique; ``fingerprint`` changes with everything that the result depends on.
    """

    name: str
    fingerprint: str
    argument: Any


class WorkersError(OSError):
    """The workers cannot run any task; the message gives the reason."""


class ResultFolder:
    """One file for each finished task, with its document and the fingerprint of its input."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def path(self, name: str) -> Path:
        """Path of the file for the task of this name."""
        return self._folder / f"{file_stem(name)}.json"

    def kept(self, task: KeptTask) -> Document | None:
        """The stored document of a task, None if the task must be run."""
        try:
            found = json.loads(self.path(task.name).read_text(encoding="utf-8"))
            document = found["document"] if found["fingerprint"] == task.fingerprint else None
        except (OSError, ValueError, TypeError, KeyError):
            return None
        return document if isinstance(document, dict) else None

    def keep(self, task: KeptTask, document: Document) -> None:
        """Write the document of a task, completely or not at all. Raises OSError."""
        entry = {"fingerprint": task.fingerprint, "document": document}
        write_text(self.path(task.name), json.dumps(entry, allow_nan=False) + "\n")


def file_stem(name: str) -> str:
    """A readable file name, different for different names."""
    slug = re.sub(r"[^\w.=+-]+", "_", name).strip("._")[:_SLUG]
    return f"{slug}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def finish(
    tasks: Iterable[KeptTask],
    function: Callable[[Any], Document],
    workforce: Workforce,
    results: ResultFolder,
    *,
    final: Callable[[Document], bool],
    finished: Callable[[KeptTask, Document], None],
    lost: Callable[[KeptTask], None],
) -> None:
    """Run the tasks and store their documents; ``finished`` receives each one at once.

    If ``final`` returns False, a document is reported but not stored, so that its task runs again
    the next time. A task whose process dies repeatedly is given up and passed to ``lost``. Raises
    WorkersError if the workers cannot run tasks at all, and OSError if a result cannot be written.
    """
    waiting, suspects = deque(tasks), deque[KeptTask]()
    deaths: Counter[str] = Counter()
    under_way: dict[Future[Document], KeptTask] = {}
    executor = workforce.start()
    try:
        while waiting or suspects or under_way:
            broken = False
            try:
                while waiting and len(under_way) < workforce.at_once:
                    future = executor.submit(_with_one_thread, function, waiting[0].argument)
                    under_way[future] = waiting.popleft()
                if suspects and not under_way:
                    future = executor.submit(_with_one_thread, function, suspects[0].argument)
                    under_way[future] = suspects.popleft()
            except workforce.breaks_with:
                broken = True
            for future in wait(under_way, return_when=FIRST_COMPLETED).done if under_way else ():
                task = under_way[future]
                try:
                    document = future.result()
                except workforce.breaks_with:
                    broken = True
                    continue
                except workforce.loses_with:
                    lost(task)
                except (Exception, CancelledError) as error:
                    raise WorkersError(
                        f"the workers cannot do the tasks: {type(error).__name__}: {error}"
                    ) from error
                else:
                    if final(document):
                        results.keep(task, document)
                    finished(task, document)
                del under_way[future]
            if broken:
                for task in under_way.values():
                    deaths[task.name] += 1
                    if deaths[task.name] >= _GIVEN_UP:
                        lost(task)
                    elif deaths[task.name] >= _SUSPECT:
                        suspects.append(task)
                    else:
                        waiting.appendleft(task)
                under_way.clear()
                executor = workforce.start()
    finally:
        for future in under_way:
            future.cancel()
        workforce.end()


def _with_one_thread(function: Callable[[Any], Document], argument: Any) -> Document:
    with one_thread():  # the process may belong to another program
        return function(argument)


def fingerprint(content: Mapping[str, Any]) -> str:
    """A short text that changes with the content; JSON must be able to hold the content."""
    text = json.dumps(content, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:24]
