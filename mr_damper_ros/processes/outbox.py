"""What others must not hear of before it is on disk: then it survives whatever happens."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


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
