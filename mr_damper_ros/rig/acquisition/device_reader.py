"""Reads a device in a thread of its own, and connects to it again when it is lost."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from typing import Generic, NamedTuple, Protocol, TypeVar

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)

_MOST_WAITING = 256
"""Portions that wait to be taken; a device that brings more is not read meanwhile."""

_RETRY = 0.5
"""Seconds between two attempts to connect."""

_POLL = 0.1
"""Seconds after which a thread that waits looks whether it is to end."""

_PATIENCE = 2.0
"""Seconds that the end of the thread is waited for; it ends by itself when the driver returns."""


class Device(Protocol[T_co]):
    """What is connected: a serial line, a socket, a data acquisition device."""

    def read(self) -> T_co | None:
        """What has come, or None where nothing did within a tenth of a second or so.

        Raises OSError, with a sentence, where the device is lost.
        """

    def close(self) -> None:
        """Let it go; raises nothing."""


class Portion(NamedTuple, Generic[T]):
    """What one read gave, when [ns of the steady clock], and by which connection, from 1."""

    data: T
    arrival_ns: int
    connection: int


class DeviceReader(Generic[T]):
    """Connects with ``connect``, which raises OSError with a sentence, and reads until closed."""

    def __init__(self, connect: Callable[[], Device[T]]) -> None:
        self._connect = connect
        self._waiting: queue.Queue[Portion[T]] = queue.Queue(_MOST_WAITING)
        self._ended = threading.Event()
        self.connections = 0
        self.fault = "not connected yet"
        """Why there is no connection, in a sentence; empty while there is one."""
        self._thread = threading.Thread(target=self._run, name="device", daemon=True)
        self._thread.start()

    def take(self) -> list[Portion[T]]:
        """All that has come; waits for a tenth of a second where nothing has."""
        try:
            found = [self._waiting.get(timeout=_POLL)]
            # No more than were there: who brings without end must not keep us.
            for _ in range(self._waiting.qsize()):
                found.append(self._waiting.get_nowait())
        except queue.Empty:
            return []
        return found

    def close(self) -> None:
        """End it, without waiting for a driver that hangs."""
        self._ended.set()
        self._thread.join(_PATIENCE)

    def _run(self) -> None:
        while not self._ended.is_set():
            device = None
            try:
                device = self._connect()
                self.connections += 1
                self.fault = ""
                self._read(device)
            except OSError as error:
                self.fault = str(error)
            except Exception as error:  # drivers are others': this thread must not die of them
                self.fault = f"the driver failed: {type(error).__name__}: {error}"
            finally:
                if device is not None:
                    device.close()
            self._ended.wait(_RETRY)

    def _read(self, device: Device[T]) -> None:
        while not self._ended.is_set():
            data = device.read()
            if data is None:
                continue
            portion = Portion(data, time.monotonic_ns(), self.connections)
            while not self._ended.is_set():
                try:
                    self._waiting.put(portion, timeout=_POLL)
                    break
                except queue.Full:
                    continue
