"""Work that must not hold up a node: what is written to disk, and what publishing can go before."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class BackgroundWriter(Generic[T]):
    """Calls ``write`` with the newest item in a thread of its own.

    ``write`` may raise OSError or ValueError; :attr:`fault` is what the last call said.
    """

    def __init__(self, write: Callable[[T], object]) -> None:
        self._write = write
        self._changed = threading.Condition()
        self._newest: tuple[int, T] | None = None
        self.given = 0
        """Number of items given so far: that of the newest one."""
        self.done = 0
        """Number of the newest item that was written, or could not be; it includes all before."""
        self._closed = False
        self.fault = ""
        self._thread = threading.Thread(target=self._work, name="state", daemon=True)
        self._thread.start()

    def keep(self, item: T) -> None:
        """Write this item soon."""
        with self._changed:
            self.given += 1
            self._newest = (self.given, item)
            self._changed.notify_all()

    def wait(self, timeout: float) -> bool:
        """Wait until the newest item is written; False where that takes more than ``timeout`` s."""
        with self._changed:
            return self._changed.wait_for(lambda: self.done == self.given, timeout)

    def close(self, timeout: float) -> None:
        """Write what waits, for at most ``timeout`` seconds, and end."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(timeout)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._newest or self._closed)
                if self._newest is None:
                    return
                number, item = self._newest
                self._newest = None
            fault = ""
            try:
                self._write(item)
            except (OSError, ValueError) as error:
                fault = str(error)
            with self._changed:
                self.fault, self.done = fault, number
                self._changed.notify_all()


class Outbox(Generic[T]):
    """Items that go out in their order, each once the state of its number is written.

    A disk must not hold up everything: after ``patience`` seconds an item goes out all the same.
    """

    def __init__(self, patience: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._patience = patience
        self._clock = clock
        self._waiting: deque[tuple[T, int, float]] = deque()
        self.late = 0
        """Items that have gone out before their state was written."""

    def add(self, item: T, number: int) -> None:
        """Have an item go out with the state of this number, as a BackgroundWriter counts them."""
        self._waiting.append((item, number, self._clock() + self._patience))

    def take(self, written: int) -> list[T]:
        """The items that may go out now that this state, and all before it, are written."""
        ready = []
        while self._waiting:
            item, number, deadline = self._waiting[0]
            if number > written:
                if self._clock() < deadline:
                    break
                self.late += 1
            self._waiting.popleft()
            ready.append(item)
        return ready

    def take_all(self) -> list[T]:
        """All items, written or not."""
        items = [item for item, _, _ in self._waiting]
        self._waiting.clear()
        return items


_HEAD_START = 1e-3
"""Seconds from what was published to the rest of the work: on a computer with no processor to
spare who waits for it may be put on this one, and would wait for that work, too."""


class PostponedWork:
    """The rest of the work on the newest block, until its time has come."""

    def __init__(self) -> None:
        self._work: Callable[[], None] | None = None
        self._due = math.inf

    def postpone(self, work: Callable[[], None]) -> None:
        """Do this a moment from now; what was postponed before has been done."""
        self._work, self._due = work, time.perf_counter() + _HEAD_START

    def finish(self) -> None:
        """Do it now, unless it is done already."""
        work, self._work = self._work, None
        if work is not None:
            work()

    def finish_in_time(self) -> float:
        """Do it if its time has come; returns the seconds until then, infinite for nothing."""
        if self._work is None:
            return math.inf
        left = self._due - time.perf_counter()
        if left > 0.0:
            return left
        self.finish()
        return math.inf
