"""Sources that read a device in a separate thread and reconnect to it; times of their rows."""

from __future__ import annotations

import math
import queue
import threading
import time
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import closing, suppress
from importlib import import_module
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

from mr_damper_ros.data_check.findings import Finding, Kind
from mr_damper_ros.data_check.stream_watch import StreamWatch
from mr_damper_ros.rig.blocks import BlockMaker, Measured
from mr_damper_ros.rig.sources.source import Source, SourceState
from mr_damper_ros.signals.blocks import NANOSECONDS, SILENCE, RigBlock
from mr_damper_ros.signals.clocks import ArrivalClock, CountedTimes
from mr_damper_ros.signals.stamped_channel import StampedChannel

_WRONG_RATE = 0.02
"""Relative rate error of a sender's clock above which its time unit must be wrong."""

_FAR = 0.25
"""Relative error of a rate or of a sender's clock that a second of arrivals shows. Arrivals in
bursts change the rate of so short a time by up to a fifth."""

_LARGEST_ADVANCE, _LARGEST_STEP_BACK = 10.0, 1.0
"""Largest plausible jumps [s] of a stamp: ahead of the elapsed time, and backwards."""

_IMPLAUSIBLE_IN_A_ROW = 16
"""This number of implausible stamps in a row means that the clock was set; fewer are errors."""


class Row(NamedTuple):
    """A line or a record: measured values, the sender's count and its time [s]; None if absent."""

    measured: Measured
    number: int | None
    time: float | None


TimedSample = tuple[int, int, Measured]
"""Number, time [ns, steady clock] and values of a sample."""


class CountedRows(CountedTimes):
    """Numbers and times of rows by their count, or by the order of arrival."""

    def timed(self, row: Row, arrival_ns: int) -> list[TimedSample]:
        """Add a row; returns the samples whose number and time are now certain."""
        index = self.add(row.number, arrival_ns)
        return [] if index is None else [(index, self.time_ns(index), row.measured)]

    def finding(self, rate: float, speed: float) -> Finding | None:
        """What is wrong with the times; ``rate`` [Hz] is that of the last arrivals, or NaN.

        ``speed``: seconds of the sender's time per second, NaN without them.
        """
        stated = 1.0 / self.period
        if self.rate_is_wrong:
            return Kind.WRONG_RATE.found(rate=stated * (1.0 + self.rate_error), stated=stated)
        if self.being_checked and abs(rate / stated - 1.0) > _FAR:
            return Kind.WRONG_RATE.found(rate=rate, stated=stated)
        return None

    @property
    def doing(self) -> str:
        """What the times wait for, as a sentence; empty if they are known."""
        stated = 1.0 / self.period
        if self.being_checked:
            return f"checking whether the samples arrive at the stated {stated:g} Hz"
        return ""

    newest_ns = None
    """Time of the newest row by the sender [ns]; there is none."""

    def figures(self) -> Mapping[str, object]:
        """The counts of received, lost and unusable rows."""
        return self.counts


class StampedRows(StampedChannel[Measured]):
    """Numbers and times of rows by the sender's time in units of ``unit`` [s]."""

    def __init__(self, unit: float) -> None:
        super().__init__(0.0)
        # A counter of 32 bits, such as micros() of a microcontroller, wraps around to 0.
        self._around, self._turns = 2.0**32 * unit, 0.0
        self._last: tuple[float, int] | None = None
        self._odd_in_a_row = 0
        self.counts["wrong stamps"] = 0

    def timed(self, row: Row, arrival_ns: int) -> list[TimedSample]:
        """Add a row; returns the samples whose number and time are now certain."""
        assert row.time is not None
        time = self._followed(row.time, arrival_ns)
        if time is None:
            return []
        samples = self.add(round(time * NANOSECONDS), arrival_ns, row.measured)
        if self._rate_is_wrong:
            return []
        return [(s.index, s.time_ns + self.clock.ahead_ns(s.time_ns), s.value) for s in samples]

    def skip(self) -> None:
        """Do nothing, because the stamps show missing samples."""

    interrupted = skip

    doing = ""

    @property
    def newest_ns(self) -> int:
        """Time of the newest row by the sender [ns]."""
        return 0 if self._last is None else round(self._last[0] * NANOSECONDS)

    def finding(self, rate: float, speed: float) -> Finding | None:
        """What is wrong with the times, as :meth:`CountedRows.finding`."""
        if self._rate_is_wrong:
            speed = 1.0 / max(1.0 + self.clock.rate, 1e-9)
            return Kind.WRONG_TIME_UNIT.found(speed=speed)
        if not 1.0 - _FAR < speed < 1.0 + _FAR and not math.isnan(speed):
            return Kind.WRONG_TIME_UNIT.found(speed=speed)
        return None

    def _pause_ns(self, stamped_ns: int, waited_ns: int) -> int:
        """Length of a pause [ns]: the sender's time counts, because leaps were already removed."""
        return stamped_ns

    @property
    def _rate_is_wrong(self) -> bool:
        return abs(self.clock.rate) > _WRONG_RATE

    def _followed(self, time: float, arrival_ns: int) -> float | None:
        """The time with the wraps of a counter of 32 bits added; None if it is implausible.

        Several implausible times in a row mean that the clock was set.
        """
        last, last_ns = self._last or (time, arrival_ns)
        turns = self._turns
        half = 0.5 * self._around
        if half < last - turns < self._around and time < last - turns - half:
            turns += self._around
        passed = (arrival_ns - last_ns) / NANOSECONDS
        goes_on = last - _LARGEST_STEP_BACK < time + turns < last + passed + _LARGEST_ADVANCE
        if not goes_on:
            if self._odd_in_a_row < _IMPLAUSIBLE_IN_A_ROW:
                self._odd_in_a_row += 1
                self.counts["wrong stamps"] += 1
                return None
            turns = 0.0
            self.clock = ArrivalClock()
        self._odd_in_a_row, self._turns = 0, turns
        self._last = (time + turns, arrival_ns)
        return time + turns


RowTimes = CountedRows | StampedRows


T = TypeVar("T")

_ROWS = "rows"
"""Name of the channel on which the rows of a device arrive."""

_MOST_WAITING = 256
"""Largest number of waiting portions; while the queue is full, the device is not read."""

POLL = 0.1
"""Longest wait [s] for a device before the reader checks whether it must end."""

_IDLE = 0.005
"""Pause [s] before the next read of a device without new data."""

Portions = Generator[T | None, None, None]
"""Yields None as soon as the device is connected, then the data of each read, or None after about
0.1 s without data. The generator may raise any exception; closing it releases the device."""


def library(module: str, user: str, install: str) -> Any:
    """The Python module that the ``user`` needs; raises ValueError that says how to install it."""
    try:
        return import_module(module)
    except (ImportError, OSError, RuntimeError) as error:
        raise ValueError(
            f"{user} needs {module}, which is not installed: pip install {install} ({error})"
        ) from error


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
        self.fault = ""
        """The reason why there is no connection, as a sentence; empty while it is being made."""
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

    def __init__(self, start_ns: int) -> None:
        self._apart_ns = time.time_ns() - time.monotonic_ns()
        self.ahead_ns = start_ns - time.monotonic_ns()
        """Offset to add to a time of the steady clock to get its stamp."""

    def was_set(self) -> bool:
        """Whether the computer's clock was set since the last call; updates the offset."""
        moved_ns = time.time_ns() - time.monotonic_ns() - self._apart_ns
        if abs(moved_ns) > _SET_NS:
            self._apart_ns += moved_ns
            self.ahead_ns += moved_ns
            return True
        return False


class DeviceSource(Source, Generic[T]):
    """Samples from a device whose reads give portions of type ``T``."""

    live: ClassVar[bool] = True

    counted: tuple[str, ...]
    """Names of the counts in :meth:`state`."""

    _connect: Callable[[], Portions[T]]
    _name: str
    """Connects to the device of this name; both are set by :meth:`open`."""

    sender: str
    """What sends the data, in words; set by :meth:`open`."""

    _reader: DeviceReader[T] | None = None
    _times: RowTimes | None = None

    @abstractmethod
    def _new_times(self, data: T) -> RowTimes:
        """The times of rows, chosen by the first data."""

    @abstractmethod
    def _rows(self, portion: Portion[T], *, begins: bool) -> Iterable[tuple[Row | None, int]]:
        """The rows of a portion and their times [ns, steady clock], None for an unreadable row.

        ``begins`` marks the first portion of a connection.
        """

    @abstractmethod
    def _finding_of(self, counts: Counter[str]) -> Finding | None:
        """What the counts of the last second show."""

    def blocks(self, start_ns: int) -> Iterator[RigBlock]:
        """Connect, and yield the samples as they arrive."""
        self.close()
        self._counts = Counter(dict.fromkeys(self.counted, 0))
        self.watch = StreamWatch({_ROWS: self.sender}, block=self.stream.block_size)
        self._times = None
        self._heard = time.monotonic()
        self._reader = DeviceReader(self._connect, self._name)
        return self._stream(self._reader, HostClock(start_ns))

    def state(self) -> SourceState:
        """The state of the connection, of the samples and of their times."""
        if self._reader is None or self.watch is None:
            return SourceState(None, {})
        values: dict[str, object] = {"connections": self._reader.connections, **self._counts}
        times, doing = self._times, ""
        if times is not None:
            values |= times.figures()
            doing = times.doing
        return SourceState(self._finding(self._reader, self.watch), values, doing)

    def _finding(self, reader: DeviceReader[T], watch: StreamWatch) -> Finding | None:
        now, times = time.monotonic(), self._times
        if reader.fault:
            return Kind.NO_LINK.found(reason=reader.fault)
        if now - self._heard > SILENCE:
            return Kind.NO_DATA.found(sender=self.sender)
        if times is None:
            return None
        found = self._finding_of(watch.counts(_ROWS, now)) or times.finding(*watch.pace(_ROWS, now))
        if found or times.doing:
            return found
        return next(iter(watch.findings(now)), None)

    def close(self) -> None:
        """Release the device."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def _stream(self, reader: DeviceReader[T], clock: HostClock) -> Iterator[RigBlock]:
        maker, connection = BlockMaker(self.stream.block_size), 0
        watch = self.watch
        assert watch is not None
        try:
            while True:
                for portion in reader.take():
                    self._heard = time.monotonic()
                    begins, connection = portion.connection != connection, portion.connection
                    if self._times is None:
                        self._times = self._new_times(portion.data)
                    elif begins:
                        self._times.interrupted()
                    before, received = self._counts.copy(), 0
                    for row, arrival_ns in self._rows(portion, begins=begins):
                        if row is None:
                            self._times.skip()
                            continue
                        received += 1
                        for number, time_ns, measured in self._times.timed(row, arrival_ns):
                            # Unusable samples are also numbered, so that they count as missing.
                            if measured.possible:
                                stamp_ns = time_ns + clock.ahead_ns
                                maker.add(number, stamp_ns, self._times.period, measured)
                            else:
                                maker.cut()
                    for what, count in (self._counts - before).items():
                        watch.note(_ROWS, what, self._heard, count)
                    if received:
                        newest_ns = self._times.newest_ns
                        watch.arrive(_ROWS, self._heard, newest_ns, 0.0, received)
                    # Yield within the loop, so that a long queue does not delay the end of the
                    # bridge.
                    yield from maker.take()
                if clock.was_set():
                    maker.cut()
                yield from maker.take()
        finally:
            reader.close()
