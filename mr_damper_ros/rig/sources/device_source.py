"""What sources of a device have in common that is read in a thread and connected to again."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

from mr_damper_ros.rig.acquisition.block_maker import BlockMaker
from mr_damper_ros.rig.acquisition.device_reader import Device, DeviceReader, Portion
from mr_damper_ros.rig.acquisition.host_clock import HostClock
from mr_damper_ros.rig.rig_block import RigBlock
from mr_damper_ros.rig.sources.source import Source, StreamSettings

if TYPE_CHECKING:
    from mr_damper_ros.rig.acquisition.row_times import RowTimes, TimedSample

T = TypeVar("T")

_SILENCE = 2.0
"""Seconds without anything after which a device counts as silent."""


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
        return time.monotonic() - self._heard > _SILENCE

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

    def _read(self, connect: Callable[[], Device[T]], start_ns: int) -> Iterator[RigBlock]:
        """Connect, and give the blocks as they come."""
        self.close()
        self._heard = time.monotonic()
        self._reader = DeviceReader(connect)
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
