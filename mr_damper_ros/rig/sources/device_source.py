"""Sources that read a device in a separate thread and reconnect to it."""

from __future__ import annotations

import queue
import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, suppress
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

from mr_damper_ros.rig.blocks import BlockMaker
from mr_damper_ros.rig.sources.row_times import RowTimes, TimedSample
from mr_damper_ros.rig.sources.source import Source, StreamSettings
from mr_damper_ros.signals.blocks import RigBlock

T = TypeVar("T")

_MOST_WAITING = 256
"""Largest number of waiting portions; while the queue is full, the device is not read."""

POLL = 0.1
"""Longest wait [s] for a device before the reader checks whether it must end."""

SILENCE = 2.0
"""Time [s] without an answer after which a device, a sender or a driver counts as silent."""

_IDLE = 0.005
"""Pause [s] before the next read of a device without new data."""

Portions = Generator[T | None, None, None]
"""Yields None as soon as the device is connected, then the data of each read, or None after about
0.1 s without data. The generator may raise any exception; closing it releases the device."""


class Portion(NamedTuple, Generic[T]):
    """The data of one read, its arrival [ns, steady clock], and the connection's number from 1."""

    data: T
    arrival_ns: int
    connection: int


class DeviceReader(Generic[T]):
    """Reads the device of this name until closed, and reconnects if the device is lost."""

    def __init__(self, connect: Callable[[], Portions[T]], name: str) -> None:
        self._connect = connect
        self._name = name
        self._waiting: queue.Queue[Portion[T]] = queue.Queue(_MOST_WAITING)
        self._ended = threading.Event()
        self.connections = 0
        self.fault = "not connected yet"
        """The reason why there is no connection, as a sentence; empty while connected."""
        self._thread = threading.Thread(target=self._run, name="device", daemon=True)
        self._thread.start()

    def take(self) -> list[Portion[T]]:
        """Return all waiting portions; waits for up to 0.1 s if there are none."""
        try:
            found = [self._waiting.get(timeout=POLL)]
            # Only the portions present now, because a continuous stream must not block the caller.
            for _ in range(self._waiting.qsize()):
                found.append(self._waiting.get_nowait())
        except queue.Empty:
            return []
        return found

    def close(self) -> None:
        """End the thread, without waiting for a driver that hangs."""
        self._ended.set()
        self._thread.join(SILENCE)

    def _run(self) -> None:
        while not self._ended.is_set():
            failed = f"no connection to {self._name}"
            try:
                with closing(self._connect()) as portions:
                    next(portions)
                    failed = f"{self._name} was lost"
                    self.connections += 1
                    self.fault = ""
                    self._read(portions)
            except Exception as error:  # drivers are foreign code; this thread must survive them
                self.fault = f"{failed}: {_reason(error)}"
            self._ended.wait(5.0 * POLL)  # pause before the next attempt to connect

    def _read(self, portions: Portions[T]) -> None:
        for data in portions:
            if data is None:
                self._ended.wait(_IDLE)
            else:
                portion = Portion(data, time.monotonic_ns(), self.connections)
                while not self._ended.is_set():
                    with suppress(queue.Full):
                        self._waiting.put(portion, timeout=POLL)
                        break
            if self._ended.is_set():
                return


def _reason(error: Exception) -> str:
    """The message of a library in one line, without the paragraph of codes that may follow."""
    told = getattr(error, "error_message", None) or getattr(error, "strerror", None) or str(error)
    text = " ".join(str(told).split("\n\n")[0].split())
    return text if isinstance(error, OSError) and text else f"{type(error).__name__}: {text}"


_SET_NS = 20_000_000
"""A larger jump [ns] between the clocks means that the computer's clock was set."""


class HostClock:
    """Converts times of the steady clock to stamps; the present stamp is ``start_ns``.

    If the computer's clock is set, the stamps follow it, as the stamps of other devices do.
    """

    def __init__(
        self,
        start_ns: int,
        steady: Callable[[], int] = time.monotonic_ns,
        wall: Callable[[], int] = time.time_ns,
    ) -> None:
        self._steady, self._wall = steady, wall
        self._apart_ns = wall() - steady()
        self.ahead_ns = start_ns - steady()
        """Offset to add to a time of the steady clock to get its stamp."""

    def was_set(self) -> bool:
        """Whether the computer's clock was set since the last call; updates the offset."""
        moved_ns = self._wall() - self._steady() - self._apart_ns
        if abs(moved_ns) > _SET_NS:
            self._apart_ns += moved_ns
            self.ahead_ns += moved_ns
            return True
        return False


class DeviceSource(Source, Generic[T]):
    """Samples from a device whose reads give portions of type ``T``."""

    live: ClassVar[bool] = True

    def __init__(self, settings: Any, stream: StreamSettings) -> None:
        super().__init__(settings, stream)
        self._reader: DeviceReader[T] | None = None
        self._times: RowTimes | None = None
        self._heard = 0.0

    @property
    def _silent(self) -> bool:
        return time.monotonic() - self._heard > SILENCE

    @abstractmethod
    def _samples(self, portion: Portion[T], *, begins: bool) -> Iterable[TimedSample | None]:
        """The samples of a portion, None for a missing one; ``begins`` marks a new connection.

        A missing sample ends the current block at once.
        """

    def close(self) -> None:
        """Release the device."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def _read(
        self, connect: Callable[[], Portions[T]], name: str, start_ns: int
    ) -> Iterator[RigBlock]:
        """Connect, and yield the blocks as they arrive."""
        self.close()
        self._heard = time.monotonic()
        self._reader = DeviceReader(connect, name)
        return self._stream(self._reader, HostClock(start_ns))

    def _stream(self, reader: DeviceReader[T], clock: HostClock) -> Iterator[RigBlock]:
        maker, connection = BlockMaker(self.stream.block_size), 0
        try:
            while True:
                for portion in reader.take():
                    self._heard = time.monotonic()
                    begins = portion.connection != connection
                    if begins and connection and self._times is not None:
                        self._times.interrupted()
                    connection = portion.connection
                    for sample in self._samples(portion, begins=begins):
                        if sample is None:
                            maker.cut()
                            continue
                        stamp_ns = sample.time_ns + clock.ahead_ns
                        maker.add(sample.number, stamp_ns, sample.period, sample.measured)
                    # Yield within the loop, so that a long queue does not delay the end of the
                    # bridge.
                    yield from maker.take()
                if clock.was_set():
                    maker.cut()
                yield from maker.take()
        finally:
            reader.close()
