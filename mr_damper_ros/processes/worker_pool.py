"""Worker processes that many share: each has one task at a time, first come, first served.

A worker process takes memory whether it works or not, and one for each of many users would all
work at once where there are fewer processors. Whoever waits for a process waits unhurried: the
time budget of a task begins when a process has it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from mr_damper_ros.processes.worker import Outcome, Progress, Worker


class WorkerPool:
    """``count`` supervised processes, which load ``module`` before their first task.

    Whoever has a task gets a :meth:`worker` once and polls it; that keeps all processes going.
    """

    def __init__(self, module: str, count: int = 1) -> None:
        self._workers = [Worker(module) for _ in range(count)]
        self._free = deque(self._workers)
        self._waiting: deque[PooledWorker] = deque()

    @property
    def ready(self) -> bool:
        """Whether there is a process that has come up."""
        return any(worker.ready for worker in self._workers)

    @property
    def replaced(self) -> int:
        """Processes that have been replaced so far."""
        return sum(worker.replaced for worker in self._workers)

    @property
    def pid(self) -> int | None:
        """Id of the process that is free next; None for the moment in which there is none."""
        return self._next.pid if self._free else None

    @property
    def _next(self) -> Worker:
        """One that is coming up still counts where there is no other."""
        return next((one for one in self._free if one.ready), self._free[0])

    def worker(self) -> PooledWorker:
        """A share of the processes, for one who has one task at a time."""
        return PooledWorker(self)

    def close(self) -> None:
        """End the processes. They hold nothing that could be lost."""
        for worker in self._workers:
            worker.close()

    def queue(self, waiting: PooledWorker) -> None:
        """Give this one a process in its turn."""
        self._waiting.append(waiting)
        self.hand_out()

    def release(self, worker: Worker) -> None:
        """Take back a process whose task has ended."""
        self._free.append(worker)
        self.hand_out()

    def hand_out(self) -> None:
        """Give free processes to those that wait; one that has died is replaced."""
        for worker in self._free:
            worker.poll()
        while self._waiting and self._free:
            worker = self._next
            self._free.remove(worker)
            self._waiting.popleft().take(worker)

    def take_notices(self) -> list[str]:
        """Sentences about free processes (deaths, replacements) since the last call."""
        return [notice for worker in self._free for notice in worker.take_notices()]


class PooledWorker:
    """A :class:`Worker` as far as its user can tell; now and then its tasks wait for a process."""

    def __init__(self, pool: WorkerPool) -> None:
        self._pool = pool
        self._worker: Worker | None = None
        self._start: Callable[[Worker], int] | None = None
        self._number = 0
        self._stop_asked = False
        self._notices: list[str] = []

    @property
    def busy(self) -> bool:
        """Whether a task has been submitted and has not yet ended."""
        return self._start is not None

    @property
    def waits(self) -> bool:
        """Whether a task waits for a process."""
        return self.busy and self._worker is None

    @property
    def ready(self) -> bool:
        """Whether there is a process that has come up."""
        return self._pool.ready

    @property
    def replaced(self) -> int:
        """Processes of the pool that have been replaced so far."""
        return self._pool.replaced

    @property
    def pid(self) -> int | None:
        """Id of the process that is at the task, or would be; None where there is none."""
        return self._pool.pid if self._worker is None else self._worker.pid

    def submit(self, function: Callable[..., Any], *args: Any, budget: float = math.inf) -> int:
        """As :meth:`Worker.submit`; the budget begins when a process has the task."""
        if self.busy:
            raise RuntimeError("the worker is busy: wait for its task to end")
        self._number += 1
        self._stop_asked = False
        self._start = partial(_submit, function, args, budget)
        self._pool.queue(self)
        return self._number

    def take(self, worker: Worker) -> None:
        """Have the task done by this process."""
        assert self._start is not None
        self._worker = worker
        self._start(worker)
        if self._stop_asked:
            worker.cancel()

    def cancel(self) -> None:
        """As :meth:`Worker.cancel`: the task still ends with an outcome, in its turn."""
        self._stop_asked = True
        if self._worker is not None:
            self._worker.cancel()

    def poll(self) -> list[Outcome]:
        """What has happened since the last call. Never blocks."""
        self._pool.hand_out()
        self._notices += self._pool.take_notices()
        worker = self._worker
        if worker is None:
            return []
        outcomes = [replace(outcome, task=self._number) for outcome in worker.poll()]
        self._notices += worker.take_notices()
        if outcomes and not isinstance(outcomes[-1], Progress):
            self._worker = self._start = None
            self._pool.release(worker)
        return outcomes

    def take_notices(self) -> list[str]:
        """Sentences about the processes (deaths, replacements) since the last call."""
        notices, self._notices = self._notices, []
        return notices


def _submit(
    function: Callable[..., Any], args: tuple[Any, ...], budget: float, worker: Worker
) -> int:
    return worker.submit(function, *args, budget=budget)
