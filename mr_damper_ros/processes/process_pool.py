"""Independent tasks in several processes; the results do not depend on the number of processes.

A task is a picklable function of one picklable argument, and depends on nothing else. Each process
computes with one BLAS thread, because sums depend on the number of threads. The results are
therefore identical to the last digit.
"""

from __future__ import annotations

import math
import os
import pickle
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Executor, Future, as_completed
from contextlib import AbstractContextManager, closing
from dataclasses import replace
from functools import partial
from typing import Any, SupportsIndex, TypeVar

from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.processes.files import reason_of
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
        with closing(self.outcomes(function, tasks, listen)) as outcomes:
            for outcome in outcomes:
                if isinstance(outcome, Failed):
                    why = f"a task cannot be done: {outcome.reason}"
                    raise outcome.error or WorkersError(why)
                results[outcome.task] = outcome.result
                if done is not None:
                    done(outcome.task, outcome.result)
        return results

    def outcomes(
        self,
        function: Callable[[Task, Notify], Any],
        tasks: Sequence[Task],
        listen: Listen | None = None,
    ) -> Generator[Done | Failed, None, None]:
        """The outcome of every task as soon as it is complete; its ``task`` is the index.

        ``listen`` receives the progress of the tasks and may stop them; running tasks then return
        their present results. A task whose process dies repeatedly runs once more while no other
        task runs, and has failed if its process dies again. A task also fails if it raises an
        exception or cannot be pickled.
        """
        stopped = False
        outcome: Done | Failed | Progress

        def notify(index: int, news: Any) -> bool:
            nonlocal stopped
            stopped = stopped or not (listen is None or listen(index, news))
            return not stopped

        if not tasks or (not self._apart and (self.count == 1 or len(tasks) < 2)):
            for index, task in enumerate(tasks):
                if not stopped:
                    try:
                        with one_thread():
                            outcome = Done(index, function(task, partial(notify, index)))
                    except Exception as error:
                        outcome = Failed(index, reason_of(error), error)
                    yield outcome
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
                    worker = Worker(self._pool)
                    try:
                        worker.submit(function, tasks[index])
                        running[index] = worker
                    except (pickle.PicklingError, AttributeError, TypeError) as error:
                        yield Failed(index, f"it cannot be pickled: {error}", error)
                self._pool.supervise(LONGEST_PAUSE)
                for index, worker in list(running.items()):
                    for outcome in worker.collect():
                        if isinstance(outcome, Progress):
                            if not notify(index, outcome.value):
                                for each in running.values():
                                    each.cancel()
                        elif isinstance(outcome, Done) or outcome.error is not None:
                            yield replace(outcome, task=index)
                        elif index in last_try:
                            why = f"{outcome.reason} at every attempt: is there enough memory?"
                            yield Failed(index, why)
                        else:
                            last_try.add(index)
                            again.append(index)
                    if not worker.busy:
                        del running[index]
        except BaseException:
            self.__exit__()
            raise


def computed(
    function: Callable[..., Any],
    tasks: Sequence[Any],
    executor: Executor | None = None,
    workers: int | None = None,
) -> Generator[Done | Failed, None, None]:
    """The outcome of ``function(task)`` for each task as soon as it is complete.

    The function runs in the executor, or in ``workers`` processes on this machine (None: one per
    processor) with a second argument that it may ignore. A task fails if the function raises an
    exception, the task cannot be pickled, or its process dies repeatedly; no exception of a task
    or worker is raised. Closing the generator ends the processes, and cancels tasks of the
    executor that have not started. Raises ValueError if both are given or ``workers`` is invalid.
    """
    if executor is None:
        count = processor_count() if workers is None else workers
        with ProcessPool(count, apart=True) as pool:
            pool.count = min(count, len(tasks))  # a process without a task would only load modules
            yield from pool.outcomes(function, tasks)
        return
    if workers is not None:
        raise ValueError("the executor has its own workers: give workers or an executor, not both")
    places: dict[Future[Any], int] = {}
    try:
        for place, task in enumerate(tasks):
            try:
                places[executor.submit(function, task)] = place
            except Exception as error:  # such as of an executor whose workers have died
                yield Failed(place, reason_of(error), error)
        for future in as_completed(places):
            place = places[future]
            try:
                outcome: Done | Failed = Done(place, future.result())
            except Exception as error:
                outcome = Failed(place, reason_of(error), error)
            yield outcome
    finally:
        for future in places:
            future.cancel()


def processor_count() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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
