"""Writing to disk that must not hold up a node."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from mr_damper_ros.processes.files import reason_of

T = TypeVar("T")


class BackgroundWriter(Generic[T]):
    """Calls ``write`` with the newest item in its own thread; older pending items are skipped.

    ``write`` may raise OSError or ValueError; :attr:`fault` is the message of the last call.
    """

    def __init__(self, write: Callable[[T], object]) -> None:
        self._write = write
        self._changed = threading.Condition()
        self._newest: tuple[int, T] | None = None
        self.given = 0
        """Number of items given so far, which is also the number of the newest item."""
        self.done = 0
        """Number of the newest item that was written or failed; older items count as done."""
        self._closed = False
        self.fault = ""
        self._thread = threading.Thread(target=self._work, name="state", daemon=True)

    def __deepcopy__(self, memo: object) -> BackgroundWriter[T]:
        """A copy of an engine, as a trial makes, shares the writer."""
        return self

    def keep(self, item: T) -> None:
        """Write this item soon."""
        with self._changed:
            if not self.given:
                self._thread.start()
            self.given += 1
            self._newest = (self.given, item)
            self._changed.notify_all()

    def wait(self, timeout: float) -> bool:
        """Wait until the newest item is written; False if that takes more than ``timeout`` [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: self.done == self.given, timeout)

    def close(self, timeout: float) -> None:
        """Write the pending item, for at most ``timeout`` [s], and end."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self.given:
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
                fault = reason_of(error)
            with self._changed:
                self.fault, self.done = fault, number
                self._changed.notify_all()


class Outbox(Generic[T]):
    """Items that are released in order, each once its state is written to disk.

    A slow disk delays them only for ``patience`` seconds; then an item is released anyway.
    """

    def __init__(self, patience: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._patience = patience
        self._clock = clock
        self._waiting: deque[tuple[T, int, float]] = deque()
        self.late = 0
        """Number of items released before their state was written."""

    def add(self, item: T, number: int) -> None:
        """Add an item that waits for the state of this number, as counted by a BackgroundWriter."""
        self._waiting.append((item, number, self._clock() + self._patience))

    def take(self, written: int) -> list[T]:
        """Remove and return the released items; ``written``: number of the last state on disk."""
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
        """Remove and return all items, whether their states are written or not."""
        items = [item for item, _, _ in self._waiting]
        self._waiting.clear()
        return items
