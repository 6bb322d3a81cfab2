"""Independent tasks in several processes; the results do not depend on the number of processes.

A task is a picklable function of one picklable argument, and depends on nothing else. Each process
computes with one BLAS thread, because sums depend on the number of threads. The results are
therefore identical to the last digit.

A task of :func:`finish` returns a JSON document and raises no exception; a failure is described in
its document. :func:`store_document` stores such documents, each in its own file, atomically.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Executor, Future, as_completed
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, SupportsIndex, TypeVar

from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.processes.files import reason_of, write_text
from mr_damper_ros.processes.worker import LONGEST_PAUSE, Done, Failed, Progress, Worker, WorkerPool

Task = TypeVar("Task")
Result = TypeVar("Result")

Notify = Callable[[Any], bool]
"""Callback by which a task reports its progress; if it returns False, the task should return its
present result soon."""

Listen = Callable[[int, Any], bool]
"""Receives the index of a task and its progress; returning False stops all tasks."""


class WorkersError(OSError):
    """The workers cannot run any task; the message gives the reason."""


class ProcessPool(AbstractContextManager):
    """A context with ``count`` processes, which start with the first tasks.

    With a count of one and without ``apart``, the tasks run in this process. Raises ValueError for
    a count below one.
    """

    def __init__(self, count: int = 1, *, apart: bool = False) -> None:
        if not isinstance(count, SupportsIndex) or count < 1:
            raise ValueError(f"workers is {count!r}: give a whole number of at least 1")
        self.count = count
        self._apart = apart
        self._pool: WorkerPool | None = None

    def __exit__(self, *_: object) -> None:
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.close()

    def map(
        self,
        function: Callable[[Task, Notify], Result],
        tasks: Sequence[Task],
        listen: Listen | None = None,
        done: Callable[[int, Result], None] | None = None,
    ) -> list[Result | None]:
        """``function(task, notify)`` of every task, in order; None if a task was not started.

        ``done`` is called with each result as soon as it is complete, in any order. Raises the
        exception of a task, and WorkersError if a process dies with each attempt at a task.
        """
        results: list[Result | None] = [None] * len(tasks)
        for outcome in self.outcomes(function, tasks, listen):
            if isinstance(outcome, Failed):
                raise WorkersError(f"a task cannot be done: {outcome.reason}")
            results[outcome.task] = outcome.result
            if done is not None:
                done(outcome.task, outcome.result)
        return results

    def outcomes(
        self,
        function: Callable[[Task, Notify], Any],
        tasks: Sequence[Task],
        listen: Listen | None = None,
    ) -> Iterator[Done | Failed]:
        """The outcome of every task as soon as it is complete; its ``task`` is the index.

        ``listen`` receives the progress of the tasks and may stop them; running tasks then return
        their present results. A task whose process dies repeatedly runs once more while no other
        task runs, and has failed if its process dies again. Raises the exception of a task.
        """
        stopped = False

        def notify(index: int, news: Any) -> bool:
            nonlocal stopped
            stopped = stopped or not (listen is None or listen(index, news))
            return not stopped

        if not tasks or (not self._apart and (self.count == 1 or len(tasks) < 2)):
            for index, task in enumerate(tasks):
                if not stopped:
                    with one_thread():
                        result = function(task, partial(notify, index))
                    yield Done(index, result)
            return
        if self._pool is None:
            # A task may compute for a long time without checking whether it should stop.
            limits = {"grace": math.inf, "silence_limit": math.inf}
            # SciPy has its own BLAS, which would not be limited to one thread if loaded later.
            self._pool = WorkerPool("scipy.linalg", self.count, **limits)
        waiting, again, running = deque(range(len(tasks))), deque[int](), dict[int, Worker]()
        last_try = set[int]()
        try:
            while running or ((waiting or again) and not stopped):
                queue, most = (waiting, self.count) if waiting else (again, 1)
                while queue and len(running) < most and not stopped:
                    index = queue.popleft()
                    running[index] = Worker(self._pool)
                    running[index].submit(function, tasks[index])
                self._pool.supervise(LONGEST_PAUSE)
                for index, worker in list(running.items()):
                    for outcome in worker.collect():
                        if isinstance(outcome, Progress):
                            if not notify(index, outcome.value):
                                for each in running.values():
                                    each.cancel()
                        elif isinstance(outcome, Failed) and outcome.error is not None:
                            raise outcome.error
                        elif isinstance(outcome, Done) or index in last_try:
                            yield replace(outcome, task=index)
                        else:
                            last_try.add(index)
                            again.append(index)
                    if not worker.busy:
                        del running[index]
        except BaseException:
            self.__exit__()
            raise


def run_apart(module: str, function: Callable[..., Any], *args: Any, budget: float) -> Any:
    """Run ``function(*args, control)`` in a separate process, which first loads ``module``.

    Raises the exceptions of the function, TimeoutError after ``budget`` [s], and ChildProcessError
    if the process dies repeatedly.
    """
    with closing(WorkerPool(module, grace=0.0, silence_limit=math.inf)) as pool:
        worker = Worker(pool)
        worker.submit(function, *args, budget=budget)
        while worker.busy:
            outcomes = worker.poll(min(LONGEST_PAUSE, budget))
    outcome = outcomes[-1]
    if isinstance(outcome, Failed):
        raise outcome.error or ChildProcessError(outcome.reason)
    assert isinstance(outcome, Done)
    return outcome.result


@dataclass(frozen=True)
class Workforce:
    """An executor, and the properties of its workers.

    A future raises one of the exceptions ``loses_with`` if its task has ended several workers.
    ``end`` releases the executor.
    """

    executor: Executor
    loses_with: tuple[type[Exception], ...] = ()
    end: Callable[[], object] = lambda: None


def dask_cluster(address: str) -> Workforce:
    """The workers of a running Dask cluster, found by the address of its scheduler.

    They need only this package and the paths of the recordings. Raises ValueError if Dask is not
    installed, and OSError if no scheduler answers or it has no workers.
    """
    try:
        from distributed import Client, KilledWorker
    except ImportError as error:
        raise ValueError(
            "a scheduler was given, but Dask is not installed: pip install distributed==2026.8.0"
        ) from error
    try:
        client: Any = Client(address, set_as_default=False)
    except OSError as error:
        raise OSError(f"no Dask scheduler answers at {address}: is it running?") from error
    if not any(client.nthreads().values()):
        client.close()
        raise OSError(f"the Dask scheduler at {address} has no workers: start some")
    return Workforce(client.get_executor(pure=False), (KilledWorker,), client.close)


Document = dict[str, Any]


def stored_document(file: Path, fingerprint: str) -> Document | None:
    """The document of a finished task in its file; None if the task must be run.

    The fingerprint of the task changes with everything on which its result depends.
    """
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        document = found["document"] if found["fingerprint"] == fingerprint else None
    except (OSError, ValueError, TypeError, KeyError):
        return None
    return document if isinstance(document, dict) else None


def store_document(file: Path, fingerprint: str, document: Document) -> None:
    """Write the document of a task to its file, completely or not at all. Raises OSError."""
    entry = {"fingerprint": fingerprint, "document": document}
    write_text(file, json.dumps(entry, allow_nan=False) + "\n")


def file_stem(name: str) -> str:
    """A readable file name, different for different names."""
    slug = re.sub(r"[^\w.=+-]+", "_", name).strip("._")[:60]
    return f"{slug}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def finish(
    function: Callable[[Task], Document], tasks: Sequence[Task], workers: int | Workforce
) -> Iterator[tuple[Task, Document | None]]:
    """Each task with its document, as soon as it is complete.

    ``workers`` is the number of processes on this machine, or a workforce elsewhere. The document
    is None if the process of the task dies repeatedly. Raises WorkersError if a workforce cannot
    run tasks at all.
    """
    if not isinstance(workers, Workforce):
        with ProcessPool(workers, apart=True) as pool:
            for outcome in pool.outcomes(partial(_document, function), tasks):
                yield tasks[outcome.task], outcome.result if isinstance(outcome, Done) else None
        return
    under_way: dict[Future[Document], Task] = {}
    try:
        for task in tasks:
            under_way[workers.executor.submit(_document, function, task)] = task
        for future in as_completed(under_way):
            try:
                document = future.result()
            except workers.loses_with:
                document = None
            except (Exception, CancelledError) as error:
                why = reason_of(error)
                raise WorkersError(f"the workers cannot run the tasks: {why}") from error
            yield under_way.pop(future), document
    finally:
        for future in under_way:
            future.cancel()
        workers.end()


def _document(function: Callable[[Any], Document], argument: Any, *_: Notify) -> Document:
    with one_thread():  # the process may belong to another program
        return function(argument)


def fingerprint(content: Mapping[str, Any]) -> str:
    """A short text that changes whenever the content, which must be valid JSON, changes."""
    text = json.dumps(content, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:24]
