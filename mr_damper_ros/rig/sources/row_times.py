"""Sample times of a sender's rows, from the sender's count and a rate, or from its stamps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from mr_damper_ros.rig.blocks import Measured
from mr_damper_ros.rig.sources.rows import Row
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.signals.clocks import ArrivalClock, CountedTimes
from mr_damper_ros.signals.stamped_channel import StampedChannel

_WRONG_RATE = 0.02
"""Relative rate error of a sender's clock above which its time unit must be wrong."""

_LARGEST_ADVANCE, _LARGEST_STEP_BACK = 10.0, 1.0
"""Largest plausible jumps [s] of a stamp: ahead of the elapsed time, and backwards."""

_IMPLAUSIBLE_IN_A_ROW = 16
"""This number of implausible stamps in a row means that the clock was set; fewer are errors."""


class TimedSample(NamedTuple):
    """A sample with its number, its time [ns, steady clock], and the sample period [s]."""

    number: int
    time_ns: int
    period: float
    measured: Measured


class CountedRows:
    """Numbers and times of rows by their count, or by the order of arrival."""

    def __init__(self, times: CountedTimes) -> None:
        self._times = times

    def add(self, row: Row, arrival_ns: int) -> list[TimedSample]:
        """Add a row; returns the samples whose number and time are now certain."""
        times = self._times
        index = times.add(row.number, arrival_ns)
        if index is None:
            return []
        return [TimedSample(index, times.time_ns(index), times.period, row.measured)]

    def skip(self) -> None:
        """Skip the number of an unreadable row."""
        self._times.skip()

    def interrupted(self) -> None:
        """Note that the connection, and with it an unknown number of rows, was lost."""
        self._times.interrupted()

    def fault(self) -> str:
        """The fault of the times, as a sentence; empty without a fault."""
        times = self._times
        stated = 1.0 / times.period
        if times.rate_is_wrong:
            return (
                f"the samples arrive at {stated * (1.0 + times.rate_error):.4g} Hz instead of the "
                f"stated {stated:g} Hz, so they are not used: correct the rate"
            )
        if times.being_checked:
            return f"checking whether the samples arrive at the stated {stated:g} Hz"
        return ""

    def values(self) -> Mapping[str, object]:
        """The counts of received, lost and unusable rows."""
        return vars(self._times.counts)


class StampedRows:
    """Numbers and times of rows by the sender's time in units of ``unit`` [s]."""

    def __init__(self, unit: float) -> None:
        self._channel: StampedChannel[Measured] = StampedChannel(0.0)
        # A counter of 32 bits, such as micros() of a microcontroller, wraps around to 0.
        self._around, self._turns = 2.0**32 * unit, 0.0
        self._last: tuple[float, int] | None = None
        self._odd_in_a_row = 0
        self._odd = 0

    def add(self, row: Row, arrival_ns: int) -> list[TimedSample]:
        """Add a row; returns the samples whose number and time are now certain."""
        assert row.time is not None
        time = self._followed(row.time, arrival_ns)
        if time is None:
            return []
        channel = self._channel
        stamp_ns = round(time * NANOSECONDS)
        samples = channel.add(stamp_ns, arrival_ns, row.measured)
        if self._rate_is_wrong:
            return []
        return [
            TimedSample(
                sample.index,
                sample.time_ns + channel.clock.ahead_ns(sample.time_ns),
                channel.period,
                sample.value,
            )
            for sample in samples
        ]

    def skip(self) -> None:
        """Do nothing, because the stamps show missing samples."""

    interrupted = skip

    def fault(self) -> str:
        """The fault of the times, as a sentence; empty without a fault."""
        if self._rate_is_wrong:
            times = 1.0 / max(1.0 + self._channel.clock.rate, 1e-9)
            return (
                f"the sender's clock runs {times:.3g} times as fast as this computer's: is the "
                "unit of the time right?"
            )
        return ""

    def values(self) -> Mapping[str, object]:
        """The counts of received, lost and unusable rows."""
        channel = self._channel
        return {
            **vars(channel.counts),
            "lost": channel.lost,
            "unclear": channel.unclear,
            "wrong stamps": self._odd,
            "rate [Hz]": f"{1.0 / channel.period:.6g}",
        }

    @property
    def _rate_is_wrong(self) -> bool:
        return abs(self._channel.clock.rate) > _WRONG_RATE

    def _followed(self, time: float, arrival_ns: int) -> float | None:
        """The time with the wraps of a counter of 32 bits added; None if it is implausible.

        Several implausible times in a row mean that the clock was set.
        """
        if self._last is None:
            self._last = (time, arrival_ns)
            return time
        last, last_ns = self._last
        turns = self._turns
        half = 0.5 * self._around
        if half < last - turns < self._around and time < last - turns - half:
            turns += self._around
        passed = (arrival_ns - last_ns) / NANOSECONDS
        goes_on = last - _LARGEST_STEP_BACK < time + turns < last + passed + _LARGEST_ADVANCE
        if not goes_on:
            if self._odd_in_a_row < _IMPLAUSIBLE_IN_A_ROW:
                self._odd_in_a_row += 1
                self._odd += 1
                return None
            turns = 0.0
            self._channel.clock = ArrivalClock()
        self._odd_in_a_row, self._turns = 0, turns
        self._last = (time + turns, arrival_ns)
        return time + turns


RowTimes = CountedRows | StampedRows
