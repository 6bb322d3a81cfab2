"""Supervised worker processes for long computations, during which the node continues to receive.

A process is a new interpreter that loads only the module of its tasks, not a fork, because DDS
threads do not survive a fork. It finds the modules of its parent, but none in the working directory
of the program. Tasks and answers are pickles over a private socket pair.

- A worker that dies is replaced at once, and the interrupted task is tried once more. A worker
  without a sign of life (stopped, or hanging in a C function) is treated like a dead one.
- A task that exceeds its time budget is asked to stop and return its present result. If the worker
  does not answer, it is killed and replaced, and the task has failed.
- Ctrl-C, which goes to all processes of a terminal, is left to the parent. The worker ends with its
  parent, even if the parent is killed.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import pickle
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from multiprocessing.connection import Connection
from typing import Any

from mr_damper_ros.processes.blas_threads import keep_one_thread, one_thread
from mr_damper_ros.processes.files import reason_of
from mr_damper_ros.processes.programs import PATIENCE, signal_at_death_of

GRACE = 1.0
"""Time [s] that a task has to stop after it was asked to, that a killed process has to end, that a
disk has to write a state, and between two starts of a process that does not become ready."""

LONGEST_PAUSE = 0.1
"""Seconds between two signs of life of a worker, also during a task, and largest time between two
polls that counts towards its silence. If the node itself was delayed, perhaps with the whole
computer, it could not read the signs of life."""

_START = (
    "import sys; count, *rest = sys.argv[1:]; "
    "sys.path[:] = rest[int(count):]; del rest[int(count):]; "
    f"from {__name__} import _run; _run(*rest)"
)


def child_command(function: Callable[..., object], *arguments: str) -> list[str]:
    """Command line of a child that calls ``function(*arguments)``, a function of a module.

    Start the child in its own session.
    """
    call = [str(os.getpid()), function.__module__, function.__qualname__, *arguments]
    paths = map(os.path.abspath, sys.path)
    # Isolated: only the given import paths count, not the environment.
    return [sys.executable, "-I", "-c", _START, str(len(call)), *call, *paths]


def _run(parent: str, module: str, function: str, *arguments: str) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal_at_death_of(int(parent), signal.SIGKILL)
    getattr(import_module(module), function)(*arguments)


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
"""A message of a process on a task; the other messages are these three."""

_READY, _ALIVE, _GONE = "ready", "alive", "gone"


class Control:
    """The connection of the task ``number`` in the worker to the node; calls take little time.

    ``stopped`` holds the numbers of the tasks that should stop. A call is a :meth:`report`.
    """

    def __init__(self, number: int, send: Callable[[Any], None], stopped: set[int]) -> None:
        self.number = number
        self._send = send
        self._stopped = stopped

    def should_stop(self) -> bool:
        """Whether the task should stop and return its present result."""
        return self.number in self._stopped

    def report(self, value: Any) -> bool:
        """Report any picklable value as a :class:`Progress`; False if the task should stop."""
        self._send(Progress(self.number, value))
        return not self.should_stop()

    __call__ = report


class _Process:
    """A process and the worker that it serves; threads talk to it, so no method blocks.

    ``ready`` says whether the process has loaded its ``modules``. ``news`` is set when a message
    of the process has arrived.
    """

    def __init__(self, modules: str, news: threading.Event) -> None:
        self.user: Worker | None = None
        self.ready = False
        self.started = self._followed = time.monotonic()
        # The silence of the process [s], and the time at which its task began.
        self._silence, self._began = 0.0, math.inf
        self._inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        ours, theirs = socket.socketpair()
        with theirs:
            self._child = subprocess.Popen(
                child_command(serve, str(theirs.fileno()), modules),
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                # Ctrl-C goes to the whole group of the terminal; the worker must not receive it.
                start_new_session=True,
            )
        self.pid = self._child.pid
        self._connection, self._sending = Connection(ours.detach()), threading.Lock()
        threading.Thread(target=self._receive, args=(news,), daemon=True).start()

    def _receive(self, news: threading.Event) -> None:
        message: Any = None
        while message != _GONE:
            try:
                message = self._connection.recv()
            except Exception:  # closed, or an incomplete message of a killed process
                message = _GONE
            self._inbox.put(message)
            news.set()
        # A running send ends by itself, because the other end is closed; wait for it.
        with self._sending:
            self._connection.close()

    def send(self, number: int, call: bytes | None) -> None:
        """Send a task, or a request to stop it if ``call`` is None; never wait for the process."""

        def work() -> None:
            # A broken pipe means a dead worker, which the receiving thread reports.
            with self._sending, contextlib.suppress(OSError):
                self._connection.send((number, call))

        threading.Thread(target=work, daemon=True).start()

    def run(self, user: Worker) -> None:
        """Run a task; the time until the process is ready does not count towards the budget."""
        self.user = user
        self._began = time.monotonic() if self.ready else math.inf
        self.send(user.number, user.call)
        if user.stop_asked is not None:
            self.send(user.number, None)

    def follow(self, grace: float, silence_limit: float) -> Exception | None:
        """Take messages and enforce the budget; returns why the process must be replaced."""
        now = time.monotonic()
        self._silence += min(now - self._followed, LONGEST_PAUSE)
        self._followed = now
        while not self._inbox.empty():
            message = self._inbox.get_nowait()
            self._silence = 0.0
            if isinstance(message, ModuleNotFoundError):
                return message
            if message == _GONE:
                return ChildProcessError("the worker process died")
            if message == _READY:
                self.ready, self._began = True, now
            elif self.user is not None and message != _ALIVE:
                self.user.outcomes.append(message)
                self.user = self.user if isinstance(message, Progress) else None
        if not self.ready and now - self.started > PATIENCE:
            return ChildProcessError(f"the worker did not start within {PATIENCE:g} s")
        if self.ready and self._silence > silence_limit:
            return ChildProcessError("the worker process hangs")
        user = self.user
        if user is None:
            return None
        over_budget = now - self._began > user.budget
        if over_budget:
            user.cancel()
        if user.stop_asked is None or now <= max(user.stop_asked, self._began) + grace:
            return None
        why = f"the task exceeded its {user.budget:g} s" if over_budget else "it was cancelled"
        return TimeoutError(f"{why} and did not stop when asked to")

    def kill(self) -> None:
        """End the process."""
        self._child.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._child.wait(timeout=GRACE)


class WorkerPool:
    """``count`` supervised processes, which load modules before their first task.

    ``modules`` are names, separated by blanks. Loading them may take seconds, which do not count
    towards the time budget of a task. A user of the pool creates a :class:`Worker` and polls it
    regularly, which also supervises all processes.

    A process is killed if its task does not stop within ``grace`` [s] after it was asked to, or if
    there is no sign of life for ``silence_limit`` [s].
    """

    def __init__(
        self, modules: str, count: int = 1, *, grace: float = GRACE, silence_limit: float = 1.5
    ) -> None:
        self._modules = modules
        self.count = count
        """Number of processes; missing ones are started by :meth:`supervise`."""
        self._limits = grace, silence_limit
        self._news = threading.Event()
        self._processes: list[_Process] = []
        self._start_at = -math.inf
        # The numbers of tasks, and the workers whose tasks wait for a process.
        self.numbers, self.waiting = itertools.count(1), deque[Worker]()
        self.replaced = 0
        """Number of processes replaced so far."""
        self.notices: list[str] = []
        """Messages about processes without a task (deaths, replacements), passed on by a worker."""
        self.supervise()

    @property
    def ready(self) -> bool:
        """Whether at least one process is ready."""
        return any(process.ready for process in self._processes)

    def close(self) -> None:
        """End the processes; no data can be lost."""
        self.count = 0
        while self._processes:
            self._processes.pop().kill()

    def supervise(self, patience: float = 0.0) -> None:
        """Supervise all processes, and assign free ones to waiting tasks, ready ones first.

        Waits at most ``patience`` [s] for a message of a process. Raises ModuleNotFoundError if
        the modules need one that is not installed; once processes have been replaced, such a
        process is replaced, too.
        """
        self._news.wait(patience)
        self._news.clear()
        for process in self._processes.copy():
            lost = process.follow(*self._limits)
            if isinstance(lost, ModuleNotFoundError) and not self.replaced:
                raise lost
            if lost is not None:
                self._replace(process, lost)
        while len(self._processes) < self.count and time.monotonic() >= self._start_at:
            self._processes.append(_Process(self._modules, self._news))
        while self.waiting and (free := self.process_of(None)) is not None:
            free.run(self.waiting.popleft())

    def _replace(self, process: _Process, lost: Exception) -> None:
        """Kill a process; its task is tried once more unless it was asked to stop."""
        process.kill()
        self._processes.remove(process)
        self._start_at = process.started + GRACE
        self.replaced += 1
        user = process.user
        if user is None:
            self.notices.append(f"{lost}: the worker is replaced")
            return
        again = not user.retried and user.stop_asked is None
        end = "starts again" if again else "is given up"
        user.notices.append(f"{lost}: the worker is replaced and its task {end}")
        if again:
            user.retried = True
            self.waiting.appendleft(user)
        else:
            error = lost if isinstance(lost, TimeoutError) else None
            user.outcomes.append(Failed(user.number, str(lost), error))

    def process_of(self, user: Worker | None) -> _Process | None:
        """The process of a worker, or the next free one; None if there is none."""
        those = [process for process in self._processes if process.user is user]
        return min(those, key=lambda process: not process.ready, default=None)


class Worker:
    """Runs one function call at a time in a process of a pool, once a process is free.

    Call :meth:`poll` often: it returns results, enforces budgets and replaces a dead process.
    """

    def __init__(self, pool: WorkerPool) -> None:
        self.pool = pool
        self.busy = False
        """Whether there is a task whose outcome :meth:`poll` has not returned yet."""
        # The task: its number in the pool, its pickled call, its time limit, and whether its
        # process was lost before.
        self.number, self.call, self.budget, self.retried = 0, b"", math.inf, False
        self.stop_asked: float | None = None
        """Time [s] at which the task was asked to stop."""
        # What has not been returned yet.
        self.outcomes: list[Outcome] = []
        self.notices: list[str] = []

    @property
    def waits(self) -> bool:
        """Whether a task waits for a process."""
        return self in self.pool.waiting

    @property
    def pid(self) -> int | None:
        """Id of the process for the task, or of the next free one; None if there is none."""
        process = self.pool.process_of(self) or self.pool.process_of(None)
        return None if process is None else process.pid

    def submit(self, function: Callable[..., Any], *args: Any, budget: float = math.inf) -> int:
        """Start ``function(*args, control)`` in a process and return the task's number.

        The process must be able to import the function, which receives a :class:`Control` last.
        ``budget`` is the time limit [s] from the start in the process. Raises RuntimeError while
        another task runs.
        """
        if self.busy:
            raise RuntimeError("the worker is busy: wait for its task to end")
        self.call, self.budget = pickle.dumps((function, args), -1), budget
        self.number = next(self.pool.numbers)
        self.busy, self.retried, self.stop_asked = True, False, None
        self.pool.waiting.append(self)
        self.pool.supervise()
        return self.number

    def cancel(self) -> None:
        """Ask the task to stop with its present result; :meth:`poll` still returns it."""
        if self.busy and self.stop_asked is None:
            self.stop_asked = time.monotonic()
            process = self.pool.process_of(self)
            if process is not None:
                process.send(self.number, None)

    def poll(self, patience: float = 0.0) -> list[Outcome]:
        """Return the outcomes since the last call, and end overdue tasks.

        Waits at most ``patience`` [s] for a message of a process of the pool.
        """
        self.pool.supervise(patience)
        return self.collect()

    def collect(self) -> list[Outcome]:
        """As :meth:`poll`, for a caller that supervises the pool itself."""
        outcomes, self.outcomes = self.outcomes, []
        self.busy = self.busy and all(isinstance(each, Progress) for each in outcomes)
        return outcomes

    def take_notices(self) -> list[str]:
        """Messages about the processes (deaths, replacements) since the last call."""
        notices = self.notices + self.pool.notices
        self.notices, self.pool.notices = [], []
        return notices


def serve(descriptor: str, modules: str) -> None:
    """Run tasks as the worker at this socket, until the socket closes."""
    connection = Connection(int(descriptor))
    try:
        for name in modules.split():
            import_module(name)
    except ModuleNotFoundError as error:
        connection.send(error)
        return
    keep_one_thread(with_scipy=False)  # the modules have loaded SciPy if tasks need it
    tasks: queue.SimpleQueue[tuple[int, bytes]] = queue.SimpleQueue()
    stopped: set[int] = set()

    def receive() -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                number, call = connection.recv()
                if call is None:
                    stopped.add(number)
                else:
                    tasks.put((number, call))
        os._exit(0)

    sending = threading.Lock()

    def send(message: Any) -> None:
        data = message if isinstance(message, bytes) else pickle.dumps(message, -1)
        with sending:
            connection.send_bytes(data)

    def beat() -> None:
        with contextlib.suppress(OSError):
            while True:
                time.sleep(LONGEST_PAUSE)
                send(_ALIVE)

    send(_READY)
    for work in (receive, beat):
        threading.Thread(target=work, daemon=True).start()
    while True:
        number, call = tasks.get()
        send(_answer(call, Control(number, send, stopped)))


def _answer(call: bytes, control: Control) -> bytes:
    try:
        function, args = pickle.loads(call)
        return pickle.dumps(Done(control.number, function(*args, control)), -1)
    except Exception as error:
        reason = reason_of(error)
        try:
            data = pickle.dumps(Failed(control.number, reason, error))
            pickle.loads(data)  # raises if the exception cannot be unpickled
        except Exception:
            data = pickle.dumps(Failed(control.number, reason, RuntimeError(reason)))
        return data


class InlineWorker:
    """Runs a task when it is submitted, and returns its outcome after a latency in data time.

    ``latency`` computes the time [s] until the outcome of a task from the first argument of the
    task. ``processor_time`` [s] is the processor time of all tasks so far.
    """

    def __init__(self, latency: Callable[[Any], float]) -> None:
        self._now = -math.inf
        self.processor_time = 0.0
        self._latency = latency
        self._number = 0
        self._outcome: Outcome | None = None
        self._due = -math.inf

    def set_time(self, now: float) -> None:
        """Set the time of the data [s]; a jump back does not delay a pending outcome."""
        if now < self._now:
            self._due -= self._now - now
        self._now = now

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
            self._outcome = Failed(self._number, reason_of(error), error)
        self.processor_time += time.process_time() - began
        self._due = self._now + self._latency(args[0])
        return self._number

    def cancel(self) -> None:
        """Return the outcome at the next :meth:`poll`."""
        self._due = self._now

    def poll(self) -> list[Outcome]:
        """The outcome, if it is due."""
        if self._outcome is None or self._now < self._due:
            return []
        outcome, self._outcome = self._outcome, None
        return [outcome]

    def take_notices(self) -> list[str]:
        """Always empty, because there is no separate process that could fail."""
        return []


TaskRunner = Worker | InlineWorker
"""Runs one task at a time, in another process or in this one."""
