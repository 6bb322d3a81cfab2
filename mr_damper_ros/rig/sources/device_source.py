"""Sources of a device that is read in a thread of its own, and connected to again."""

from __future__ import annotations

import queue
import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

from mr_damper_ros.rig.blocks import BlockMaker
from mr_damper_ros.rig.sources.row_times import RowTimes, TimedSample
from mr_damper_ros.rig.sources.source import Source, StreamSettings
from mr_damper_ros.signals.blocks import RigBlock

T = TypeVar("T")

_MOST_WAITING = 256
"""Portions that wait to be taken; a device that brings more is not read meanwhile."""

POLL = 0.1
"""Seconds after which whatever waits for a device looks whether it is to end."""

SILENCE = 2.0
"""Seconds without an answer after which a device, a sender or a driver counts as silent."""

_IDLE = 0.005
"""Seconds until a device that had nothing is looked at again."""

Portions = Generator[T | None, None, None]
"""What a connected device brings: None first, once it is connected, and again where nothing came
within a tenth of a second or so. It may raise anything; closing it lets the device go."""


class Portion(NamedTuple, Generic[T]):
    """What one read gave, when [ns of the steady clock], and by which connection, from 1."""

    data: T
    arrival_ns: int
    connection: int


class DeviceReader(Generic[T]):
    """Reads a device of this name until closed; one that is lost is connected to again."""

    def __init__(self, connect: Callable[[], Portions[T]], name: str) -> None:
        self._connect = connect
        self._name = name
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
            found = [self._waiting.get(timeout=POLL)]
            # No more than were there: who brings without end must not keep us.
            for _ in range(self._waiting.qsize()):
                found.append(self._waiting.get_nowait())
        except queue.Empty:
            return []
        return found

    def close(self) -> None:
        """End it, without waiting for a driver that hangs."""
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
            except Exception as error:  # drivers are others': this thread must not die of them
                self.fault = f"{failed}: {_why(error)}"
            self._ended.wait(5.0 * POLL)  # until the next attempt to connect

    def _read(self, portions: Portions[T]) -> None:
        for data in portions:
            if data is None:
                self._ended.wait(_IDLE)
            else:
                portion = Portion(data, time.monotonic_ns(), self.connections)
                while not self._ended.is_set() and not self._handed_over(portion):
                    pass
            if self._ended.is_set():
                return

    def _handed_over(self, portion: Portion[T]) -> bool:
        try:
            self._waiting.put(portion, timeout=POLL)
        except queue.Full:
            return False
        return True


def _why(error: Exception) -> str:
    """What a library says, in one line, without the codes that follow in a paragraph of its own."""
    told = getattr(error, "error_message", None) or getattr(error, "strerror", None) or str(error)
    text = " ".join(str(told).split("\n\n")[0].split())
    return text if isinstance(error, OSError) and text else f"{type(error).__name__}: {text}"


_SET_NS = 20_000_000
"""The computer's clock was set where it has moved by more than so many nanoseconds."""


class HostClock:
    """Makes stamps of times of the steady clock; the two show ``start_ns`` now.

    When the computer's clock is set, the stamps follow it, as those of other devices do.
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
        """What is to be added to a time of the steady clock for its stamp."""

    def look(self) -> bool:
        """Whether the computer's clock was set since the last look."""
        moved_ns = self._wall() - self._steady() - self._apart_ns
        if abs(moved_ns) > _SET_NS:
            self._apart_ns += moved_ns
            self.ahead_ns += moved_ns
            return True
        return False


class DeviceSource(Source, Generic[T]):
    """Samples from a device that brings portions of type ``T``."""

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
        """The samples of a portion, which may be the first of its connection; None: one is missing.

        A block that has begun does not wait for what may come after the missing one.
        """

    def close(self) -> None:
        """Let the device go."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def _read(
        self, connect: Callable[[], Portions[T]], name: str, start_ns: int
    ) -> Iterator[RigBlock]:
        """Connect, and give the blocks as they come."""
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
                    # However much waits, it does not keep the bridge from stopping.
                    yield from maker.take()
                if clock.look():
                    maker.cut()
                yield from maker.take()
        finally:
            reader.close()
