"""Supervised worker processes: long computations, while the node goes on receiving.

A process is a fresh interpreter (nothing is forked: DDS threads do not survive a fork). It is not
started by ``multiprocessing``, which would run the node's main script again in the child and load
rclpy there. Tasks and answers are pickles over a private socket pair.

- A worker that dies is detected at once and replaced; the interrupted task is tried once more. The
  same holds for a worker without a sign of life, because it is stopped or hangs in a call into C.
- A task that exceeds its time budget is asked to stop and return its present result. If the worker
  does not answer, it is killed and replaced, and the task has failed.
- The worker dies with its parent, however that one ends.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import pickle
import queue
import socket
import struct
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from multiprocessing.connection import Connection
from typing import Any

from mr_damper_ros.processes import child_process
from mr_damper_ros.processes.blas_threads import keep_one_thread, one_thread

_GRACE = 1.0
"""Seconds for a task to stop after it was asked to."""

_START_LIMIT = 60.0
"""Seconds after which a process that has not reported ready counts as dead."""

_BEAT = 0.25
"""Seconds between two signs of life of a worker, also during a task."""

_SILENCE_LIMIT = 1.5
"""Seconds without a sign of life after which a worker counts as hanging."""

_LONGEST_PAUSE = 0.1
"""Largest time [s] between two polls that counts as silence: a node that was itself held up,
perhaps with the whole computer, has not read the signs of life."""

_RESTART_PAUSE = 1.0
"""Seconds between two starts if the process does not even become ready."""

_TASK, _STOP = b"t", b"s"
"""First byte of a message to the worker; then follows the number of the task, and its pickled call
for a new task."""

_NUMBER = struct.Struct("<Q")


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
    """The task gave no result; ``reason`` is one sentence."""

    task: int
    reason: str


Outcome = Progress | Done | Failed


class Control:
    """The connection of a task in the worker to the node; its methods may be called often."""

    def __init__(self, number: int, send: Callable[[Any], None], stopped: set[int]) -> None:
        self._number = number
        self._send = send
        self._stopped = stopped

    def should_stop(self) -> bool:
        """Whether the task should stop and return its present result."""
        return self._number in self._stopped

    def report(self, value: Any) -> bool:
        """Report any picklable value as a :class:`Progress`; False if the task should stop."""
        self._send(("progress", self._number, value))
        return not self.should_stop()


class _Place:
    """One worker process, with the threads that talk to it; it is replaced if it dies or hangs.

    No method ever blocks. ``process_number`` counts the processes; ``ready`` tells whether the
    present one has loaded its module.
    """

    def __init__(self, module: str) -> None:
        self._module = module
        self.process_number = self.replaced = 0
        self._checked_at = time.monotonic()
        self._start()

    def _start(self) -> None:
        self.process_number += 1
        self.ready = False
        self._started, self._silence = time.monotonic(), 0.0
        ours, theirs = socket.socketpair()
        with theirs:
            self._child: subprocess.Popen[bytes] | None = subprocess.Popen(
                child_process.command(serve, str(theirs.fileno()), self._module),
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

    @property
    def pid(self) -> int | None:
        """Id of the process; None while there is none."""
        return None if self._child is None else self._child.pid

    def send(self, *messages: bytes) -> None:
        """Send messages in a separate thread, because a stopped process does not read."""
        connection, sending = self._connection, self._sending

        def work() -> None:
            # A broken pipe means a dead worker, which the receiving thread reports.
            with sending, contextlib.suppress(OSError):
                for message in messages:
                    connection.send_bytes(message)

        threading.Thread(target=work, daemon=True).start()

    def take_messages(self) -> list[Any]:
        """The messages of the process since the last call.

        ("lost", reason) is the last message of a process that had to be replaced.
        """
        now = time.monotonic()
        self._silence += min(now - self._checked_at, _LONGEST_PAUSE)
        self._checked_at = now
        if self._child is None:
            if now >= self._started + _RESTART_PAUSE:
                self._start()
            return []
        messages = []
        with contextlib.suppress(queue.Empty):
            while True:
                messages.append(self._inbox.get_nowait())
                self._silence = 0.0
        self.ready = self.ready or ("ready",) in messages
        why = ""
        if _GONE in messages:
            why = "the worker process died"
        elif not self.ready and now - self._started > _START_LIMIT:
            why = f"the worker did not start within {_START_LIMIT:g} s"
        elif self.ready and self._silence > _SILENCE_LIMIT:
            why = "the worker process hangs"
        if why:
            self.kill()
            messages.append(("lost", why))
        return messages

    def kill(self) -> None:
        """Kill the process; :meth:`take_messages` starts the next one."""
        child, self._child, self.ready = self._child, None, False
        if child is not None:
            self.replaced += 1
            child.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(timeout=_GRACE)

    def close(self) -> None:
        """End the process for good."""
        self.kill()
        self._started = math.inf


_GONE = ("gone",)
"""The last message of all: the connection has ended."""


def _receive(connection: Connection, sending: threading.Lock, inbox: queue.SimpleQueue) -> None:
    try:
        while True:
            inbox.put(connection.recv())
    except Exception:  # closed, or half a message of a killed process
        inbox.put(_GONE)
    finally:
        # Wait for a running send, which ends by itself: nothing reads it any more.
        with sending:
            connection.close()


class WorkerPool:
    """``count`` supervised processes, which load ``module`` before their first task.

    ``module`` contains the tasks. Loading it takes seconds on a busy computer, and does not count
    towards the time budget of a task. A user of the pool gets a :meth:`worker` once and polls it,
    which also supervises all processes.
    """

    def __init__(self, module: str, count: int = 1) -> None:
        self._places = [_Place(module) for _ in range(count)]
        self._free = deque(self._places)
        self._waiting: deque[Worker] = deque()
        self._notices: list[str] = []
        self.tickets = itertools.count(1)
        """Numbers for the tasks of all workers, unique in the pool."""

    @property
    def ready(self) -> bool:
        """Whether at least one process is ready."""
        return any(place.ready for place in self._places)

    @property
    def replaced(self) -> int:
        """Number of processes replaced so far."""
        return sum(place.replaced for place in self._places)

    @property
    def pid(self) -> int | None:
        """Id of the next free process; None if there is none."""
        return self._next().pid if self._free else None

    def worker(self) -> Worker:
        """A worker that runs one task at a time in a process of this pool."""
        return Worker(self)

    def close(self) -> None:
        """End the processes. They hold no data that could be lost."""
        for place in self._places:
            place.close()

    def queue(self, worker: Worker) -> None:
        """Give the worker a process when its turn comes."""
        self._waiting.append(worker)
        self.supervise()

    def release(self, place: _Place) -> None:
        """Take back the process of a task that has ended."""
        self._free.append(place)
        self.supervise()

    def supervise(self) -> None:
        """Replace free processes that have died, and assign free ones to waiting workers."""
        for place in self._free:
            lost = [message[1] for message in place.take_messages() if message[0] == "lost"]
            self._notices += [f"{why}: the worker is replaced" for why in lost]
        while self._waiting and self._free:
            place = self._next()
            self._free.remove(place)
            self._waiting.popleft().take(place)

    def take_notices(self) -> list[str]:
        """Sentences about free processes (deaths, replacements) since the last call."""
        notices, self._notices = self._notices, []
        return notices

    def _next(self) -> _Place:
        """The first ready process; without one, a process that is still starting."""
        return next((place for place in self._free if place.ready), self._free[0])


class Worker:
    """Runs one function call at a time in a process of a pool; it may have to wait for a process.

    Call :meth:`poll` often: it returns the results, enforces time budgets and replaces a dead
    process.
    """

    def __init__(self, pool: WorkerPool) -> None:
        self._pool = pool
        self._place: _Place | None = None
        self._notices: list[str] = []
        self._number = 0
        self._ticket = b""
        self._task: bytes | None = None
        self._budget = math.inf
        self._retried = False
        self._sent_to = 0  # number of the process that received the task
        self._started: float | None = None  # start time of the task, in a process that is ready
        self._stop_asked: float | None = None

    @property
    def busy(self) -> bool:
        """Whether a task has been submitted and has not yet ended."""
        return self._task is not None

    @property
    def waits(self) -> bool:
        """Whether a task waits for a process."""
        return self.busy and self._place is None

    @property
    def ready(self) -> bool:
        """Whether at least one process of the pool is ready."""
        return self._pool.ready

    @property
    def replaced(self) -> int:
        """Number of processes of the pool replaced so far."""
        return self._pool.replaced

    @property
    def pid(self) -> int | None:
        """Id of the process for the task, or of the next free one; None if there is none."""
        return (self._place or self._pool).pid

    def submit(self, function: Callable[..., Any], *args: Any, budget: float = math.inf) -> int:
        """Start ``function(*args, control)`` in a process and return the task's number.

        The process must be able to import the function, and passes it a :class:`Control`.
        ``budget`` is the time limit [s] from the start in the process. Raises RuntimeError while
        another task runs.
        """
        if self.busy:
            raise RuntimeError("the worker is busy: wait for its task to end")
        self._number += 1
        self._ticket = _NUMBER.pack(next(self._pool.tickets))
        self._task = _TASK + self._ticket + pickle.dumps((function, args), -1)
        self._budget, self._retried = budget, False
        self._started = self._stop_asked = None
        self._pool.queue(self)
        return self._number

    def take(self, place: _Place) -> None:
        """Run the task in this process."""
        self._place = place
        self._send(place)

    def _send(self, place: _Place) -> None:
        """Send the task to the process, if there is one."""
        if self._task is None or place.pid is None:
            return
        self._sent_to = place.process_number
        self._started = time.monotonic() if place.ready else None
        stop = () if self._stop_asked is None else (_STOP + self._ticket,)
        place.send(self._task, *stop)

    def cancel(self) -> None:
        """Ask the task to stop with its present result; :meth:`poll` still returns it."""
        if self.busy and self._stop_asked is None:
            self._stop_asked = time.monotonic()
            if self._place is not None and self._place.pid is not None:
                self._place.send(_STOP + self._ticket)

    def poll(self) -> list[Outcome]:
        """Return the outcomes since the last call, and end overdue tasks. Never blocks."""
        self._pool.supervise()
        self._notices += self._pool.take_notices()
        place = self._place
        if place is None:
            return []
        outcomes: list[Outcome] = []
        for kind, *content in place.take_messages():
            if kind == "lost":
                outcomes += self._lost(content[0])
            elif kind == "ready":
                self._started = time.monotonic()
            elif content and self.busy and content[0] == _NUMBER.unpack(self._ticket)[0]:
                if kind == "progress":
                    outcomes.append(Progress(self._number, content[1]))
                    continue
                self._task = None
                outcomes.append((Done if kind == "done" else Failed)(self._number, content[1]))
        if self._sent_to != place.process_number:
            self._send(place)
        outcomes += self._overdue(place)
        if not self.busy:
            self._place = None
            self._pool.release(place)
        return outcomes

    def take_notices(self) -> list[str]:
        """Sentences about the processes (deaths, replacements) since the last call."""
        notices, self._notices = self._notices, []
        return notices

    def _overdue(self, place: _Place) -> list[Outcome]:
        now = time.monotonic()
        if self._task is None or self._started is None:
            return []
        over_budget = now - self._started > self._budget
        if over_budget:
            self.cancel()
        if self._stop_asked is None or now <= max(self._stop_asked, self._started) + _GRACE:
            return []
        place.kill()
        why = f"the task exceeded its {self._budget:g} s" if over_budget else "it was cancelled"
        return self._lost(f"{why} and did not stop when asked to", retry=False)

    def _lost(self, why: str, *, retry: bool = True) -> list[Outcome]:
        """Try the task once more in the next process, otherwise give it up."""
        self._started = None
        if self._task is None:
            self._notices.append(f"{why}: the worker is replaced")
            return []
        again = retry and not self._retried and self._stop_asked is None
        self._notices.append(
            f"{why}: the worker is replaced and its task "
            + ("starts again" if again else "is given up")
        )
        if again:
            self._retried = True
            return []
        self._task = None
        return [Failed(self._number, why)]


def serve(descriptor: str, module: str) -> None:
    """Run the tasks of a module as the worker at this socket, until the socket closes."""
    import_module(module)
    keep_one_thread(with_scipy=False)  # the module has loaded all libraries of its tasks
    connection = Connection(int(descriptor))
    tasks: queue.SimpleQueue[tuple[int, memoryview]] = queue.SimpleQueue()
    stopped: set[int] = set()

    def receive() -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                message = connection.recv_bytes()
                (number,) = _NUMBER.unpack_from(message, 1)
                if message[:1] == _STOP:
                    stopped.add(number)
                else:
                    tasks.put((number, memoryview(message)[1 + _NUMBER.size :]))
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
        number, call = tasks.get()
        send(_answer(number, call, Control(number, send, stopped)))


def _answer(number: int, call: memoryview, control: Control) -> bytes:
    try:
        function, args = pickle.loads(call)
        return pickle.dumps(("done", number, function(*args, control)), -1)
    except Exception as error:
        return pickle.dumps(("failed", number, f"{type(error).__name__}: {error}"))


class InlineWorker:
    """Runs a task when it is submitted, and returns its outcome after a latency in data time.

    The user sets ``now`` [s], the time of the data. If it jumps back because a clock was set, a
    pending outcome is not delayed by the jump. ``latency`` returns the seconds until the outcome of
    a task, from the task's first argument. ``processor_time`` [s] is the processor time of all
    tasks so far.
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
            self._outcome = Failed(self._number, f"{type(error).__name__}: {error}")
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
        """Always empty: there is no separate process that could fail."""
        return []


TaskRunner = Worker | InlineWorker
"""Runs one task at a time, in another process or in this one."""
