"""Supervised worker processes for long computations, during which the node continues to receive.

A process is a new interpreter that loads only the module of its tasks
(:mod:`mr_damper_ros.processes.child_process`). Tasks and answers are pickles over a private socket
pair.

- A worker that dies is replaced at once, and the interrupted task is tried once more. A worker
  without a sign of life (stopped, or hanging in a C function) is treated like a dead one.
- A task that exceeds its time budget is asked to stop and return its present result. If the worker
  does not answer, it is killed and replaced, and the task has failed.
- The worker ends with its parent, even if the parent is killed.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import pickle
import queue
import socket
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from multiprocessing.connection import Connection
from typing import Any

from mr_damper_ros.processes import child_process
from mr_damper_ros.processes.blas_threads import keep_one_thread, one_thread

_GRACE = 1.0
"""Time [s] that a task has to stop after it was asked to."""

_START_LIMIT = 60.0
"""Time [s] after which a process that has not become ready counts as dead."""

_BEAT = 0.25
"""Seconds between two signs of life of a worker, also during a task."""

_SILENCE_LIMIT = 1.5
"""Seconds without a sign of life after which a worker counts as hanging."""

_LONGEST_PAUSE = 0.1
"""Largest time [s] between two polls that counts towards the silence of a worker. If the node
itself was delayed, perhaps with the whole computer, it could not read the signs of life."""

_RESTART_PAUSE = 1.0
"""Time [s] between two starts if the process does not become ready."""


@dataclass(frozen=True)
class Progress:
    """A progress value that the running task reported."""

    task: int
    value: Any


@dataclass(frozen=True)
class Done:
    """The task returned a result."""

    task: int
    result: Any


@dataclass(frozen=True)
class Failed:
    """The task gave no result; ``reason`` is one sentence.

    ``error`` is the exception of the task, or a TimeoutError if it did not stop when asked to; None
    if its process was lost.
    """

    task: int
    reason: str
    error: Exception | None = field(default=None, compare=False)


Outcome = Progress | Done | Failed

_OUTCOMES: dict[str, type[Outcome]] = {"progress": Progress, "done": Done, "failed": Failed}
"""Outcomes by the first word of a message from the worker."""


class Control:
    """The connection of a task in the worker to the node; calls take little time.

    ``stopped`` holds the tickets of the tasks that should stop.
    """

    def __init__(self, ticket: int, send: Callable[[Any], None], stopped: set[int]) -> None:
        self._ticket = ticket
        self._send = send
        self._stopped = stopped

    def should_stop(self) -> bool:
        """Whether the task should stop and return its present result."""
        return self._ticket in self._stopped

    def report(self, value: Any) -> bool:
        """Report any picklable value as a :class:`Progress`; False if the task should stop."""
        self._send(("progress", value))
        return not self.should_stop()


@dataclass(eq=False)
class _Task:
    """A task: its number in its worker, its ticket in the pool, and its pickled call."""

    number: int
    ticket: int
    call: bytes
    budget: float
    outcomes: list[Outcome] = field(default_factory=list)
    notices: list[str] = field(default_factory=list)
    retried: bool = False
    stop_asked: float | None = None


class _Place:
    """One worker process and its task; the process is replaced if it dies or hangs.

    No method ever blocks: threads talk to the process. ``ready`` says whether the process has
    loaded its module.
    """

    def __init__(self, modules: str, grace: float, silence_limit: float) -> None:
        self._modules, self._grace, self._silence_limit = modules, grace, silence_limit
        self.task: _Task | None = None
        self.replaced = 0
        self._checked_at = time.monotonic()
        self._start()

    def _start(self) -> None:
        self.ready = False
        self._started, self._silence = time.monotonic(), 0.0
        ours, theirs = socket.socketpair()
        with theirs:
            self._child: subprocess.Popen[bytes] | None = subprocess.Popen(
                child_process.command(serve, str(theirs.fileno()), self._modules),
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                # Ctrl-C goes to the whole group of the terminal; the worker must not receive it.
                start_new_session=True,
            )
        self._inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._connection, self._sending = Connection(ours.detach()), threading.Lock()
        threading.Thread(
            target=_receive, args=(self._connection, self._sending, self._inbox), daemon=True
        ).start()
        if self.task is not None:
            self.run(self.task)

    @property
    def pid(self) -> int | None:
        """Id of the process; None while there is none."""
        return None if self._child is None else self._child.pid

    def run(self, task: _Task) -> None:
        """Run a task in the present process, or in the next one."""
        self.task = task
        # The time until the process is ready does not count towards the budget.
        self._began = time.monotonic() if self.ready else math.inf
        self._send((task.ticket, task.call))
        if task.stop_asked is not None:
            self.stop_task()

    def stop_task(self) -> None:
        """Ask the task to stop with its present result."""
        if self.task is not None:
            self._send((self.task.ticket, None))

    def _send(self, message: Any) -> None:
        """Send a message in a separate thread, because a stopped process does not read."""
        connection, sending = self._connection, self._sending

        def work() -> None:
            # A broken pipe means a dead worker, which the receiving thread reports.
            with sending, contextlib.suppress(OSError):
                connection.send(message)

        threading.Thread(target=work, daemon=True).start()

    def supervise(self, notices: list[str]) -> None:
        """Pass on messages of the process, enforce the time budget, and replace a lost process.

        ``notices`` receives sentences about a process without a task.
        """
        now = time.monotonic()
        self._silence += min(now - self._checked_at, _LONGEST_PAUSE)
        self._checked_at = now
        if self._child is None:
            if now >= self._started + _RESTART_PAUSE:
                self._start()
            return
        lost = ""
        while not self._inbox.empty():
            kind, *content = self._inbox.get_nowait()
            self._silence = 0.0
            if kind == "gone":
                lost = "the worker process died"
            elif kind == "ready":
                self.ready, self._began = True, now
            elif self.task is not None and content:
                self.task.outcomes.append(_OUTCOMES[kind](self.task.number, *content))
                self.task = self.task if kind == "progress" else None
        if not lost and not self.ready and now - self._started > _START_LIMIT:
            lost = f"the worker did not start within {_START_LIMIT:g} s"
        elif not lost and self.ready and self._silence > self._silence_limit:
            lost = "the worker process hangs"
        if lost:
            self._lose(lost, notices)
        elif self.task is not None:
            self._check_time(self.task, now, notices)

    def _check_time(self, task: _Task, now: float, notices: list[str]) -> None:
        """Ask an overdue task to stop, and kill its process if it does not."""
        over_budget = now - self._began > task.budget
        if over_budget and task.stop_asked is None:
            task.stop_asked = now
            self.stop_task()
        if task.stop_asked is not None and now > max(task.stop_asked, self._began) + self._grace:
            why = f"the task exceeded its {task.budget:g} s" if over_budget else "it was cancelled"
            task.retried = True
            late = TimeoutError(f"{why} and did not stop when asked to")
            self._lose(str(late), notices, late)

    def _lose(self, why: str, notices: list[str], error: Exception | None = None) -> None:
        """Kill the process; its task is tried once more in the next one."""
        self._kill()
        task = self.task
        if task is None:
            notices.append(f"{why}: the worker is replaced")
            return
        again = not task.retried and task.stop_asked is None
        end = "starts again" if again else "is given up"
        task.notices.append(f"{why}: the worker is replaced and its task {end}")
        task.retried = True
        if not again:
            task.outcomes.append(Failed(task.number, why, error))
            self.task = None

    def _kill(self) -> None:
        child, self._child, self.ready = self._child, None, False
        if child is not None:
            self.replaced += 1
            child.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(timeout=_GRACE)

    def close(self) -> None:
        """End the process for good."""
        self._kill()
        self._started = math.inf


def _receive(connection: Connection, sending: threading.Lock, inbox: queue.SimpleQueue) -> None:
    try:
        while True:
            inbox.put(connection.recv())
    except Exception:  # closed, or an incomplete message of a killed process
        inbox.put(("gone",))
    finally:
        # A running send ends by itself, because the other end is closed; wait for it.
        with sending:
            connection.close()


class WorkerPool:
    """``count`` supervised processes, which load modules before their first task.

    ``modules`` are names, separated by blanks. Loading them may take seconds, which do not count
    towards the time budget of a task. A user of the pool creates a :meth:`worker` and polls it
    regularly, which also supervises all processes.

    A process is killed if its task does not stop within ``grace`` [s] after it was asked to, or if
    there is no sign of life for ``silence_limit`` [s].
    """

    def __init__(
        self,
        modules: str,
        count: int = 1,
        *,
        grace: float = _GRACE,
        silence_limit: float = _SILENCE_LIMIT,
    ) -> None:
        self._places = [_Place(modules, grace, silence_limit) for _ in range(count)]
        self._waiting: deque[_Task] = deque()
        self._tickets = itertools.count(1)
        self.notices: list[str] = []
        """Messages about processes without a task (deaths, replacements), passed on by a worker."""

    @property
    def ready(self) -> bool:
        """Whether at least one process is ready."""
        return any(place.ready for place in self._places)

    @property
    def replaced(self) -> int:
        """Number of processes replaced so far."""
        return sum(place.replaced for place in self._places)

    def worker(self) -> Worker:
        """A worker that runs one task at a time in a process of this pool."""
        return Worker(self)

    def close(self) -> None:
        """End the processes; no data can be lost."""
        for place in self._places:
            place.close()

    def submit(self, number: int, call: bytes, budget: float) -> _Task:
        """Run a pickled call in a process when its turn comes."""
        task = _Task(number, next(self._tickets), call, budget)
        self._waiting.append(task)
        self.supervise()
        return task

    def supervise(self) -> None:
        """Supervise all processes, and assign free ones to waiting tasks, ready ones first."""
        for place in self._places:
            place.supervise(self.notices)
        while self._waiting and (free := self.place_of(None)) is not None:
            free.run(self._waiting.popleft())

    def place_of(self, task: _Task | None) -> _Place | None:
        """The process of a task, or the next free one; None if there is none."""
        places = [place for place in self._places if place.task is task]
        return min(places, key=lambda place: not place.ready, default=None)


class Worker:
    """Runs one function call at a time in a process of a pool, once a process is free.

    Call :meth:`poll` often: it returns results, enforces budgets and replaces a dead process.
    """

    def __init__(self, pool: WorkerPool) -> None:
        self.pool = pool
        self._task: _Task | None = None
        self._number = 0
        self._notices: list[str] = []

    @property
    def busy(self) -> bool:
        """Whether there is a task whose outcome :meth:`poll` has not returned yet."""
        return self._task is not None

    @property
    def waits(self) -> bool:
        """Whether a task waits for a process."""
        return self._task is not None and self.pool.place_of(self._task) is None

    @property
    def pid(self) -> int | None:
        """Id of the process for the task, or of the next free one; None if there is none."""
        place = self.pool.place_of(self._task) or self.pool.place_of(None)
        return None if place is None else place.pid

    def submit(self, function: Callable[..., Any], *args: Any, budget: float = math.inf) -> int:
        """Start ``function(*args, control)`` in a process and return the task's number.

        The process must be able to import the function, which receives a :class:`Control` last.
        ``budget`` is the time limit [s] from the start in the process. Raises RuntimeError while
        another task runs.
        """
        if self.busy:
            raise RuntimeError("the worker is busy: wait for its task to end")
        self._number += 1
        self._task = self.pool.submit(self._number, pickle.dumps((function, args), -1), budget)
        return self._number

    def cancel(self) -> None:
        """Ask the task to stop with its present result; :meth:`poll` still returns it."""
        if self._task is not None and self._task.stop_asked is None:
            self._task.stop_asked = time.monotonic()
            place = self.pool.place_of(self._task)
            if place is not None:
                place.stop_task()

    def poll(self) -> list[Outcome]:
        """Return the outcomes since the last call, and end overdue tasks. Never blocks."""
        self.pool.supervise()
        return self.collect()

    def collect(self) -> list[Outcome]:
        """As :meth:`poll`, for a caller that supervises the pool itself."""
        if self._task is None:
            return []
        outcomes, self._task.outcomes = self._task.outcomes, []
        self._notices += self._task.notices
        self._task.notices = []
        if outcomes and not isinstance(outcomes[-1], Progress):
            self._task = None
        return outcomes

    def take_notices(self) -> list[str]:
        """Messages about the processes (deaths, replacements) since the last call."""
        notices = self._notices + self.pool.notices
        self._notices, self.pool.notices = [], []
        return notices


def serve(descriptor: str, modules: str) -> None:
    """Run tasks as the worker at this socket, until the socket closes."""
    for name in modules.split():
        import_module(name)
    keep_one_thread(with_scipy=False)  # the modules have loaded SciPy if tasks need it
    connection = Connection(int(descriptor))
    tasks: queue.SimpleQueue[tuple[int, bytes]] = queue.SimpleQueue()
    stopped: set[int] = set()

    def receive() -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                ticket, call = connection.recv()
                if call is None:
                    stopped.add(ticket)
                else:
                    tasks.put((ticket, call))
        os._exit(0)

    sending = threading.Lock()

    def send(message: Any) -> None:
        data = message if isinstance(message, bytes) else pickle.dumps(message, -1)
        with sending:
            connection.send_bytes(data)

    def beat() -> None:
        with contextlib.suppress(OSError):
            while True:
                time.sleep(_BEAT)
                send(("alive",))

    send(("ready",))
    for work in (receive, beat):
        threading.Thread(target=work, daemon=True).start()
    while True:
        ticket, call = tasks.get()
        send(_answer(call, Control(ticket, send, stopped)))


def _answer(call: bytes, control: Control) -> bytes:
    try:
        function, args = pickle.loads(call)
        return pickle.dumps(("done", function(*args, control)), -1)
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        try:
            data = pickle.dumps(("failed", reason, error))
            pickle.loads(data)  # raises if the exception cannot be unpickled
        except Exception:
            data = pickle.dumps(("failed", reason, RuntimeError(reason)))
        return data


class InlineWorker:
    """Runs a task when it is submitted, and returns its outcome after a latency in data time.

    The user sets ``now`` [s], the time of the data. If it jumps back because a clock was set, a
    pending outcome is not delayed by the jump. ``latency`` computes the time [s] until the outcome
    of a task from the first argument of the task. ``processor_time`` [s] is the processor time of
    all tasks so far.
    """

    def __init__(self, latency: Callable[[Any], float]) -> None:
        self._now = -math.inf
        self.processor_time = 0.0
        self._latency = latency
        self._number = 0
        self._outcome: Outcome | None = None
        self._due = -math.inf

    @property
    def now(self) -> float:
        """Time of the data [s]."""
        return self._now

    @now.setter
    def now(self, time: float) -> None:
        if time < self._now:
            self._due -= self._now - time
        self._now = time

    @property
    def busy(self) -> bool:
        """Whether a task has been submitted whose outcome has not been returned."""
        return self._outcome is not None

    def submit(self, function: Callable[..., Any], *args: Any, budget: float = math.inf) -> int:
        """Run ``function(*args, control)`` with one BLAS thread; returns the task's number.

        ``budget`` limits the wall-clock time in a worker process and has no effect here. An
        exception becomes a :class:`Failed`, as in a worker process. Raises RuntimeError while
        another task waits.
        """
        if self.busy:
            raise RuntimeError("the worker is busy: wait for its task to end")
        self._number += 1
        control = Control(self._number, lambda message: None, set())
        began = time.process_time()
        try:
            with one_thread():
                self._outcome = Done(self._number, function(*args, control))
        except Exception as error:
            self._outcome = Failed(self._number, f"{type(error).__name__}: {error}", error)
        self.processor_time += time.process_time() - began
        self._due = self.now + self._latency(args[0])
        return self._number

    def cancel(self) -> None:
        """Return the outcome at the next :meth:`poll`."""
        self._due = self.now

    def poll(self) -> list[Outcome]:
        """The outcome, if it is due."""
        if self._outcome is None or self.now < self._due:
            return []
        outcome, self._outcome = self._outcome, None
        return [outcome]

    def take_notices(self) -> list[str]:
        """Always empty, because there is no separate process that could fail."""
        return []


TaskRunner = Worker | InlineWorker
"""Runs one task at a time, in another process or in this one."""
