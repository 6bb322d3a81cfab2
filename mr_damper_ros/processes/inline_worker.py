"""A worker that computes in the process of its user: for data that no clock drives."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from mr_damper_ros.processes.worker import Control, Done, Failed, Outcome


class InlineWorker:
    """Runs a task when it is submitted; its outcome is handed out some time of the data later.

    ``now`` [s] is the time of the data: the user sets it. ``latency`` returns the seconds until
    the outcome of a task, of which it is given the first argument. ``processor_time`` [s] is what
    the tasks have taken so far.
    """

    def __init__(self, latency: Callable[[Any], float]) -> None:
        self.now = -math.inf
        self.processor_time = 0.0
        self._latency = latency
        self._number = 0
        self._outcome: Outcome | None = None
        self._due = -math.inf

    @property
    def busy(self) -> bool:
        """Whether a task has been submitted whose outcome has not been handed out."""
        return self._outcome is not None

    def submit(self, function: Callable[..., Any], *args: Any, budget: float = math.inf) -> int:
        """Run ``function(*args, control)`` and return the task's number.

        The ``budget`` of a worker process bounds a wall-clock time and has no meaning here. An
        exception becomes a :class:`Failed`, as in a worker process. Raises RuntimeError while
        another task runs.
        """
        if self.busy:
            raise RuntimeError("the worker is busy: wait for its task to end")
        self._number += 1
        control = Control(self._number, lambda message: None, set())
        began = time.process_time()
        try:
            self._outcome = Done(self._number, function(*args, control))
        except Exception as error:
            self._outcome = Failed(self._number, f"{type(error).__name__}: {error}")
        self.processor_time += time.process_time() - began
        self._due = self.now + self._latency(args[0])
        return self._number

    def cancel(self) -> None:
        """Hand out the outcome at the next :meth:`poll`."""
        self._due = self.now

    def poll(self) -> list[Outcome]:
        """The outcome that is due, if there is one."""
        if self._outcome is None or self.now < self._due:
            return []
        outcome, self._outcome = self._outcome, None
        return [outcome]

    def take_notices(self) -> list[str]:
        """Nothing happens to a process that is one's own."""
        return []
