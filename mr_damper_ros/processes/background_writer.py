"""Keeps the newest state on disk without holding up whoever has it.

Writing to disk may take as long as the disk likes; a thread does it. What comes while it writes
replaces what waits: only the newest state counts.
"""

from __future__ import annotations

import threading
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
        self._given = 0
        self._done = 0
        self._closed = False
        self.fault = ""
        self._thread = threading.Thread(target=self._work, name="state", daemon=True)
        self._thread.start()

    @property
    def given(self) -> int:
        """Number of items given so far: that of the newest one."""
        return self._given

    @property
    def done(self) -> int:
        """Number of the newest item that was written, or could not be; it includes all before."""
        return self._done

    def keep(self, item: T) -> None:
        """Write this item soon."""
        with self._changed:
            self._given += 1
            self._newest = (self._given, item)
            self._changed.notify_all()

    def wait(self, timeout: float) -> bool:
        """Wait until the newest item is written; False where that takes more than ``timeout`` s."""
        with self._changed:
            return self._changed.wait_for(lambda: self._done == self._given, timeout)

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
                self.fault, self._done = fault, number
                self._changed.notify_all()
