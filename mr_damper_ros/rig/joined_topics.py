"""Two stamped channels as one source of samples, and the judgement of what arrives on them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping

from mr_damper_ros.data_check.findings import Finding, Kind
from mr_damper_ros.data_check.stream_watch import Publishers, StreamWatch
from mr_damper_ros.rig.blocks import BlockMaker, Measured
from mr_damper_ros.signals.blocks import NANOSECONDS, RigBlock, fits_a_stamp
from mr_damper_ros.signals.stamped_channel import ChannelJoin, StampedChannel

CHANNELS = ("displacement", "force")

_SMALLEST_DRIFT = 5e-6
"""Smallest drift of two clocks that is reported."""


class JoinedTopics:
    """Joins the values of two ``topics`` (by channel) at the sample times of the force.

    ``hold_back`` [s], ``own_clocks`` and ``sampled_at_stamps`` are as in
    :class:`~mr_damper_ros.signals.stamped_channel.ChannelJoin`; ``block_size`` is the number of
    samples in a block; ``publishers`` names the publishers of a topic. Values may arrive in another
    thread than the one that takes the blocks.
    """

    def __init__(
        self,
        topics: Mapping[str, str],
        block_size: int,
        publishers: Publishers,
        *,
        hold_back: float = 0.0,
        own_clocks: bool = False,
        sampled_at_stamps: bool = False,
    ) -> None:
        self.watch = StreamWatch(
            topics, own_clocks=own_clocks, block=block_size, publishers=publishers
        )
        self._own_clocks = own_clocks
        self._join = ChannelJoin(
            StampedChannel(hold_back),
            StampedChannel(hold_back),
            own_clocks=own_clocks,
            sampled_at_stamps=sampled_at_stamps,
        )
        self._maker = BlockMaker(block_size)
        self._arrived: dict[str, deque[tuple[int, int, float]]] = {name: deque() for name in topics}

    def arrive(
        self, channel: str, time: float, arrival_ns: int, stamp_ns: int, value: float
    ) -> None:
        """Take a value that arrived; without a stamp (0) it is only judged.

        ``time`` [s] is that of a steady clock, ``arrival_ns`` that of the clock to which the stamps
        are mapped with own clocks.
        """
        if not fits_a_stamp(stamp_ns):
            stamp_ns = 0
        self.watch.arrive(channel, time, stamp_ns, value)
        if stamp_ns != 0:
            self._arrived[channel].append((stamp_ns, arrival_ns, value))

    def take(self) -> list[RigBlock]:
        """The complete blocks; one block without samples if there are none."""
        displacement, force = (self._arrived[name] for name in CHANNELS)
        while force:
            self._join.lead(*force.popleft())
        while displacement:
            self._join.follow(*displacement.popleft())
        for run in self._join.take():
            period = self._join.leader.period
            for k, pair in enumerate(zip(run.following, run.leading, strict=True)):
                stamp_ns = run.start_ns + round(k * period * NANOSECONDS)
                self._maker.add(run.index + k, stamp_ns, period, Measured(*pair))
        return self._maker.take()

    def figures(self) -> dict[str, object]:
        """The counts of received, lost and unusable values, by name."""
        join = self._join
        values: dict[str, object] = {
            f"{name} {what}": count
            for name, channel in (("force", join.leader), ("displacement", join.follower))
            for what, count in channel.figures().items()
        }
        values["force without displacement"] = join.without_partner
        return values

    def findings(self, time: float) -> Iterator[Finding]:
        """What is wrong with the channels, the first cause first; ``time`` [s] as on arrival."""
        yield from self.watch.findings(time)
        clocks = self._join.follower.clock, self._join.leader.clock
        drift = clocks[0].rate - clocks[1].rate
        doubt = clocks[0].rate_bound + clocks[1].rate_bound
        if not self._own_clocks and abs(drift) > max(doubt, _SMALLEST_DRIFT):
            other, channel = CHANNELS
            size = {"drift": 1e6 * abs(drift), "doubt": 1e6 * doubt}
            yield Kind.CLOCKS_DRIFT.found(channel, value=drift, error=doubt, other=other, **size)
