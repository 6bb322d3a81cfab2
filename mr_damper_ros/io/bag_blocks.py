"""The blocks of samples in a bag, put in order by their sequence numbers."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mr_damper_ros.io.bag_files import BagError
from mr_damper_ros.io.bag_messages import Reading, Samples
from mr_damper_ros.signals.arrays import Array, usable
from mr_damper_ros.signals.blocks import LATE_NS, NANOSECONDS, BlockError, SampleBlock

_JITTER_NS = 5_000_000
"""Largest error of a stamp [ns], in addition to a sample period, as on the grid of a stream."""

_SAME = 0.02
"""Largest error of a stamp, in sample periods, with which blocks are joined unchanged."""

_SHORTEST_DISAGREEMENT = 5
"""Number of successive blocks from which stamps that contradict the sequence numbers are believed:
the source has paused, or its clock was set."""

Indices = NDArray[np.intp]


def block_of(message: Samples, bag: str, topic: str) -> SampleBlock:
    """A block of a stream; raises BagError if it cannot be used."""
    try:
        rows = np.frombuffer(message.displacement), np.frombuffer(message.force)
        return SampleBlock(message.stamp_ns, message.seq, message.period, *rows)
    except BlockError as error:
        raise BagError(
            f"the bag '{bag}' cannot be used: in the block on {topic} that "
            f"starts at sample {message.seq}, {error}"
        ) from error


class Readings:
    """All readings of the current in a bag, in compact form: recording times, stamps, values."""

    def __init__(self) -> None:
        self.times, self.stamps, self.values = array("q"), array("q"), array("d")

    def add(self, time_ns: int, message: Reading) -> None:
        """Add a reading with its recording time [ns]."""
        self.times.append(time_ns)
        self.stamps.append(message.stamp_ns)
        self.values.append(message.value)


class Blocks:
    """All blocks of a bag, in compact form.

    ``notes`` say what was repeated, reordered or stamped anew; they are complete after
    :meth:`in_order`.
    """

    def __init__(self, bag: str, topic: str) -> None:
        self.notes: list[str] = []
        self._bag, self._topic = bag, topic
        self._stamps, self._times, self._sequence = array("q"), array("q"), array("Q")
        self._periods, self._counts = array("d"), array("q")
        self._displacement, self._force = bytearray(), bytearray()

    @property
    def sample_count(self) -> int:
        """Number of samples, including repeated ones."""
        return len(self._force) // 8

    def add(self, time_ns: int, message: Samples) -> None:
        """Add a block with its recording time [ns]; raises BagError if it cannot be used."""
        stamp_ns, seq, period, displacement, force = message
        if not force or len(force) != len(displacement) or not 1e-9 <= period < 2**31:
            block_of(message, self._bag, self._topic)
        self._times.append(time_ns)
        self._stamps.append(stamp_ns)
        self._sequence.append(seq)
        self._periods.append(period)
        self._counts.append(len(force) // 8)
        self._displacement += displacement
        self._force += force

    def in_order(self) -> Iterator[SampleBlock]:
        """The blocks in the order of their sequence numbers, uninterrupted ones joined.

        The order starts anew where the source restarts, and where a bag repeats. Raises BagError if
        a value cannot be used, or two blocks contradict each other.
        """
        displacement, force = (np.frombuffer(each) for each in (self._displacement, self._force))
        counts, sequence = np.array(self._counts), np.array(self._sequence).astype(np.int64)
        offsets = np.concatenate(([0], np.cumsum(counts)))
        bad = np.flatnonzero(~(usable(displacement) & usable(force)))
        if bad.size:
            k = int(np.searchsorted(offsets, bad[0], side="right")) - 1
            rows = (each[offsets[k] : offsets[k + 1]].tobytes() for each in (displacement, force))
            block_of(Samples(0, int(sequence[k]), self._periods[k], *rows), self._bag, self._topic)
        periods = np.array(self._periods)
        whole = True
        ends = sequence + counts
        if np.all(sequence[1:] >= ends[:-1]):
            rounds = [np.arange(counts.size)]
        else:
            rounds, whole = self._rounds(sequence, ends, periods), False
        for order in rounds:
            if not whole:
                order = self._once(order, sequence, ends, offsets, displacement, force)
            seq, count, period = sequence[order], counts[order], periods[order]
            stamps, times = (np.array(each)[order] for each in (self._stamps, self._times))
            stamps = self._stamped(stamps, times, seq, count, period)
            runs = _runs(stamps, seq, count, period)
            for first, last in zip(runs[:-1].tolist(), runs[1:].tolist(), strict=True):
                places = order[first:last]
                contiguous = bool(np.all(np.diff(places) == 1))
                yield SampleBlock(
                    int(stamps[first]),
                    int(seq[first]),
                    float(period[first]),
                    *(
                        each[offsets[places[0]] : offsets[places[-1] + 1]]
                        if contiguous
                        else np.concatenate([each[offsets[k] : offsets[k + 1]] for k in places])
                        for each in (displacement, force)
                    ),
                )

    def on_the_clock_of_samples(self, readings: Readings) -> Iterator[tuple[int, float]]:
        """Stamp [ns] and value of the readings.

        A reading without stamp, whose clock had not come, gets the stamp of samples that were
        recorded at the same time.
        """
        own, stamps, values = (
            np.array(each) for each in (self._stamps, readings.stamps, readings.values)
        )
        unknown = stamps == 0
        # A simulated clock may begin with a true zero.
        if np.count_nonzero(unknown) > 1 and np.ptp(values) != 0.0:
            known = own != 0
            ahead = (
                round(float(np.median((own - np.array(self._times))[known]))) if any(known) else 0
            )
            stamps[unknown] = np.array(readings.times)[unknown] + ahead
            self.notes.append(
                f"{np.count_nonzero(unknown)} readings of the current have no stamp: their "
                "recording times were used"
            )
        return zip(stamps.tolist(), values.tolist(), strict=True)

    # ---- order

    def _rounds(
        self, sequence: NDArray[np.int64], ends: NDArray[np.int64], periods: Array
    ) -> list[Indices]:
        """Indices of the blocks, split where the source restarts or the bag repeats."""
        rounds: list[list[int]] = [[]]
        newest, offset = 0, 0.0
        stamps = self._stamps
        for k, (seq, end, period) in enumerate(
            zip(sequence.tolist(), ends.tolist(), periods.tolist(), strict=True)
        ):
            # The time of sample 0 by this block.
            own = stamps[k] - seq * period * NANOSECONDS
            back_ns = (newest - seq) * period * NANOSECONDS
            if rounds[-1] and back_ns > 0.0:
                same = not stamps[k] or abs(own - offset) <= _JITTER_NS + period * NANOSECONDS
                if back_ns > LATE_NS or not same:
                    rounds.append([])
            if not rounds[-1] or end > newest:
                newest = end
                offset = own if stamps[k] else offset
            rounds[-1].append(k)
        return [np.array(each, dtype=np.intp) for each in rounds]

    def _once(
        self,
        order: Indices,
        sequence: NDArray[np.int64],
        ends: NDArray[np.int64],
        offsets: NDArray[np.int64],
        displacement: Array,
        force: Array,
    ) -> Indices:
        """Blocks of a round by their sequence numbers, each once; raises BagError."""
        found = order[np.argsort(sequence[order], kind="stable")]
        if not np.array_equal(found, order):
            self.notes.append(
                f"{np.count_nonzero(found != order)} blocks were not recorded in the order of "
                "their sequence numbers, which was used"
            )
        repeated = np.zeros(found.size, dtype=bool)
        repeated[1:] = ends[found[1:]] <= np.maximum.accumulate(ends[found])[:-1]
        for place in np.flatnonzero(repeated).tolist():
            k = int(found[place])
            twin = int(found[np.flatnonzero(~repeated[:place])[-1]])
            shift = int(sequence[k] - sequence[twin])
            size = int(offsets[k + 1] - offsets[k])
            for each in (displacement, force):
                first = each[offsets[twin] + shift : offsets[twin] + shift + size]
                if not np.array_equal(first, each[offsets[k] : offsets[k + 1]]):
                    raise BagError(
                        f"the bag '{self._bag}' holds two different blocks on {self._topic} that "
                        f"start at sample {sequence[k]}: did two sources publish at the same time? "
                        "record the topic of one of them"
                    )
        if repeated.any():
            samples = int((ends[found] - sequence[found])[repeated].sum())
            self.notes.append(
                f"{np.count_nonzero(repeated)} blocks ({samples} samples) are in the bag twice and "
                "were used once"
            )
        return found[~repeated]

    # ---- stamps

    def _stamped(
        self,
        stamps: NDArray[np.int64],
        times: NDArray[np.int64],
        sequence: NDArray[np.int64],
        counts: NDArray[np.int64],
        periods: Array,
    ) -> NDArray[np.int64]:
        """Stamps (m,) [ns] of blocks in order, where wrong or unknown ones follow from the number.

        A stamp of zero is unknown, because a simulated clock had not come. Without any stamp, the
        recording times (m,) [ns] tell the beginning. Stamps of few blocks that contradict the
        numbers are wrong if those before and after them agree.
        """
        known = stamps != 0
        reference = int(stamps[np.argmax(known)]) or int(times[0])
        # The time of sample 0 by each block, relative to the first known one.
        since = (sequence - sequence[0]) * periods * NANOSECONDS
        start = (stamps - reference) - since
        allowed = _JITTER_NS + periods * NANOSECONDS
        changed = np.zeros(stamps.size, dtype=bool)
        if not known.all():
            # The clock that had not come at the beginning came later.
            places = np.flatnonzero(known)
            if places.size:
                nearest = np.minimum(
                    np.searchsorted(places, np.arange(stamps.size)), places.size - 1
                )
                expected = start[places[nearest]]
            else:
                # A block is recorded at its end.
                late = (times - reference) - since - counts * periods * NANOSECONDS
                expected = np.full(stamps.size, float(np.median(late)))
            unknown = ~known & (np.abs(start - expected) > allowed)
            start[unknown] = expected[unknown]
            changed |= unknown
            if unknown.any():
                self.notes.append(
                    f"{np.count_nonzero(unknown)} blocks have no stamp: their sequence numbers "
                    "were used"
                )
        steps = np.abs(np.diff(start)) > allowed[1:]
        continues = (sequence[1:] == sequence[:-1] + counts[:-1]) & (np.diff(periods) == 0.0)
        jumps = np.flatnonzero(steps & continues).tolist()
        wrong = 0
        for first, last in pairwise(jumps):
            few = last - first < _SHORTEST_DISAGREEMENT
            joined = few and bool(continues[first : last + 1].all())
            if joined and abs(start[last + 1] - start[first]) <= allowed[first]:
                start[first + 1 : last + 1] = np.interp(
                    np.arange(first + 1, last + 1), [first, last + 1], start[[first, last + 1]]
                )
                changed[first + 1 : last + 1] = True
                wrong += last - first
        if wrong:
            self.notes.append(
                f"the stamps of {wrong} blocks contradict their sequence numbers, which were used"
            )
        computed = reference + np.round(start + since).astype(np.int64)
        return np.where(changed, computed, stamps)


def _runs(
    stamps: NDArray[np.int64],
    sequence: NDArray[np.int64],
    counts: NDArray[np.int64],
    periods: Array,
) -> Indices:
    """Index of the first block of each uninterrupted run, and the number of blocks."""
    since = (sequence - sequence[0]) * periods * NANOSECONDS
    start = (stamps - stamps[0]) - since
    cuts = (sequence[1:] != sequence[:-1] + counts[:-1]) | (np.diff(periods) != 0.0)
    allowed = _SAME * float(periods.min()) * NANOSECONDS
    if not cuts.any() and np.ptp(start) <= allowed:
        return np.array([0, stamps.size])
    found, first = [0], float(start[0])
    for k, (cut, own) in enumerate(zip(cuts.tolist(), start[1:].tolist(), strict=True), start=1):
        if cut or abs(own - first) > allowed:
            found.append(k)
            first = own
    return np.array([*found, stamps.size])
