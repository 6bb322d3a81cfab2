"""Placing of arriving blocks on a uniform grid: the time policy that all consumers share.

The stamps of the data are the only clock. Sample ``index`` of the grid is the sample with that
index in the count of the source. Its time is that of the clock estimated from the stamps
(:class:`mr_damper_ros.signals.clocks.StampClock`), or the stamp itself if it does not jitter. Every
interruption has a name and is handled in the same way everywhere:

- a *bridged* gap (few samples lost): interpolated from the samples on both sides, and marked;
- a *gap* (more samples lost, the source paused or restarted): the windows and the motion restart;
- a *jump back* (a bag that loops, a clock that was set): the windows and the motion restart;
- a *repeat* (samples that came before, or that already count as lost): ignored;
- a *changed period*: the windows and the motion restart.

None of them changes what has been identified.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import LATE_NS, NANOSECONDS, SampleBlock
from mr_damper_ros.signals.clocks import StampClock

_FEWEST, _AROUND = 3, 12
"""Smallest and largest number of samples that determine the slope beside a gap. The larger number
is also the number of stored past samples, and of neighbours in the interpolation of a sample."""

_RIDGE = 1e-9

_DECIDED = 3.0
"""Standard errors by which the share must differ from one half for a decision."""

_TOGETHER, _ENOUGH = 32, 30
"""Number of samples that are evaluated together if none is lost, and the smallest number for a
decision."""

_FORGETTING = 0.9997
"""Forgetting factor per sample."""


def on_a_line(before: Array, after: Array, count: int) -> Array:
    """``count`` values on the straight line from the last of ``before`` to the first of ``after``.

    It serves for the force, whose sharp reversals leave no advantage to a cubic.
    """
    place = np.arange(1.0, count + 1.0) / (count + 1.0)
    return np.asarray(before[-1] + (after[0] - before[-1]) * place)


def on_a_cubic(before: Array, after: Array, count: int) -> Array:
    """``count`` values between the last of ``before`` (n,) and the first of ``after`` (m,).

    The values lie on a cubic Hermite polynomial with the values and slopes at both ends. It is a
    parabola if ``after`` holds fewer than three values, and a straight line if ``before`` does.
    Each slope is that of a parabola fitted to the nearest samples. This function serves for the
    displacement: over a twentieth of a cycle, its error is a tenth of that of a straight line.
    """
    width = count + 1.0
    place = np.arange(1.0, width) / width
    low, high = float(before[-1]), float(after[0])
    line = on_a_line(before, after, count)
    if before.size < _FEWEST:
        return line
    points = min(max(count + 2, _FEWEST), _AROUND)
    # Slopes relative to that of the line, times the width of the gap.
    start = width * _end_slope(before[-points:]) - (high - low)
    if after.size < _FEWEST:
        return line + start * place * (1.0 - place)
    end = -width * _end_slope(after[points - 1 :: -1] if after.size >= points else after[::-1])
    end -= high - low
    return np.asarray(line + place * (1.0 - place) * (start * (1.0 - place) - end * place))


def at_even_times(wanted: Array, places: Array, values: Array) -> Array:
    """The last n of the ``values`` (m,), sampled at ``places`` (m,), moved to ``wanted`` (n,).

    Each value moves to its new time parallel to the cubic that fits its neighbours best, and so
    keeps its own noise. Linear interpolation would reduce the noise by an amount that depends on
    the distance from the samples. A filter that recognises noise because it is white would then
    interpret the remaining noise as motion.
    """
    width = min(_AROUND + 1, places.size)
    powers = np.arange(min(3, width - 1) + 1)
    own = np.arange(places.size - wanted.size, places.size)
    first = np.clip(own - width // 2, 0, places.size - width)
    around = first[:, np.newaxis] + np.arange(width)
    unit = 0.5 * width
    time = (places[around] - places[own, np.newaxis]) / unit
    columns = time[:, :, np.newaxis] ** powers
    rows = columns.transpose(0, 2, 1)
    # The ridge keeps the matrix regular if many samples have the same stamp.
    square = rows @ columns + _RIDGE * np.eye(powers.size)
    away = values[around] - values[own, np.newaxis]
    cubic = np.linalg.solve(square, rows @ away[:, :, np.newaxis])[:, :, 0]
    way = ((wanted - places[own]) / unit)[:, np.newaxis] ** powers
    return np.asarray(values[own] + (cubic * way)[:, 1:].sum(axis=1))


def _end_slope(values: Array) -> float:
    """Slope per sample, at the last value, of the least-squares parabola through the values."""
    time = np.arange(1.0 - values.size, 1.0)
    columns = np.stack([np.ones(values.size), time, time * time], axis=1)
    weights, *_ = np.linalg.lstsq(columns, values, rcond=None)
    return float(weights[1])


class UnevenSampling:
    """Decides whether the jitter of stamps comes from non-uniform sampling.

    With non-uniform sampling, a sample differs from the mean of its neighbours by the velocity
    times the difference between its stamp and the mean of theirs. If only the stamps jitter, it
    does not. A least-squares fit gives the share of this difference: 1 for non-uniform sampling
    and 0 for inaccurate stamps.
    """

    def __init__(self) -> None:
        self._late: list[Array] = []
        self._values: list[Array] = []
        self._waiting = 0
        self._next = 0
        self._product, self._square, self._rest, self._count = 0.0, 0.0, 0.0, 0.0
        self.found = False

    def learn(self, index: int, late: float, displacement: Array) -> None:
        """Add a block whose stamp is ``late`` [sample periods], negative for early.

        ``index`` is that of its first sample. After a jump of the index, samples are not compared
        across it.
        """
        if index != self._next:
            self._look()
            self._late, self._values, self._waiting = [], [], 0
        self._next = index + displacement.size
        self._late.append(np.full(displacement.size, late))
        self._values.append(displacement)
        self._waiting += displacement.size
        if self._waiting >= _TOGETHER:
            self._look()

    def _look(self) -> None:
        if self._waiting == 0:
            return
        late, values = np.concatenate(self._late), np.concatenate(self._values)
        # The last two samples are neighbours of the next ones.
        self._late, self._values, self._waiting = [late[-2:]], [values[-2:]], 0
        off = values[1:-1] - 0.5 * (values[:-2] + values[2:])
        expected = 0.5 * (values[2:] - values[:-2]) * (late[1:-1] - 0.5 * (late[:-2] + late[2:]))
        moved = expected != 0.0
        off, expected = off[moved], expected[moved]
        known = _FORGETTING**off.size
        self._product = known * self._product + float(off @ expected)
        self._square = known * self._square + float(expected @ expected)
        self._rest = known * self._rest + float(off @ off)
        self._count = known * self._count + off.size
        if self._count < _ENOUGH or self._square == 0.0:
            return
        share = self._product / self._square
        noise = max(self._rest / self._square - share**2, 0.0) / self._count
        if abs(share - 0.5) > _DECIDED * noise**0.5:
            self.found = share > 0.5


_JITTER_NS, _JITTER = 5_000_000, 1.5
"""Largest error of a stamp in [ns] or sample periods, whichever is more, while the sample count
continues: computers assign stamps with a variable delay."""

_EVEN = 0.1
"""A stamp with an error of at most this fraction of a period is used unchanged."""

_NOTICED = 0.02
"""Stamps with an error above this fraction of a period show whether the sampling is non-uniform."""

_DELAY, _SLEW = 0.5, 0.01
"""Delay of the grid with non-uniform sampling, in sample periods, so that it lies between samples
that have arrived, and the change of this delay per sample, which avoids a step."""


@dataclass(frozen=True)
class GridSettings(CheckedSettings):
    """Options for placing a stream with jitter or gaps on a uniform grid."""

    stamps: str = option(
        "auto",
        "Meaning of stamp jitter: 'clock', the sampling is uniform and the stamps are "
        "inaccurate, as with a controller; 'sampling', each sample was taken at the time of "
        "its stamp; 'auto' decides from the motion and starts as clock.",
        choices=("auto", "clock", "sampling"),
    )
    longest_gap: float = option(
        0.05,
        "Longest gap of lost samples that is interpolated [s]; after a longer gap the motion "
        "is learnt again. 0: no gap is interpolated.",
        minimum=0.0,
        maximum=1.0,
    )


@dataclass(frozen=True)
class Continuity:
    """Relation of a block to its predecessor.

    ``kind`` is "first", "next", "bridged", "gap", "jump_back", "repeat" or "changed_period".
    ``lost`` counts the samples missing before the block. ``sentence`` describes the interruption;
    it is empty for the first three kinds.
    """

    kind: str
    lost: int = 0
    sentence: str = ""

    @property
    def restarts(self) -> bool:
        """Whether windows and motion must restart."""
        return self.kind in ("gap", "jump_back", "changed_period")


@dataclass(frozen=True, eq=False)
class Placed:
    """A block on the grid; its first ``bridged`` samples were not measured.

    ``arrived`` is the new part of the arriving block, with its original stamp. For a repeat,
    ``arrived`` and ``block`` are the arriving block. ``stamp_ns`` is the time of the first measured
    value: the stamp of ``arrived``, or another time if the values were moved on the time axis.
    ``measured`` holds a measured force [N] for each sample, shape (n,), and the time from the
    sample to this force in sample periods. It is None if the forces of the block are as measured.
    """

    block: SampleBlock
    arrived: SampleBlock
    bridged: int
    continuity: Continuity
    stamp_ns: int
    measured: tuple[Array, Array] | None = None


_NEXT = Continuity("next")
_FIRST = Continuity("first")
_REPEAT = Continuity("repeat", sentence="a block came twice or too late: it is ignored")


class UniformGrid:
    """Places the blocks of a stream on a uniform grid and counts interruptions.

    A block that arrives out of order waits for the missing blocks until the stream has advanced by
    ``hold_back`` [s]. Blocks in order never wait. A stream without jitter, gaps or repeats passes
    unchanged.

    The attributes count, since the start, the lost samples, the bridged ones among them, the
    samples that were repeated or too late, and the interruptions. ``last_interruption`` describes
    the last interruption.
    """

    def __init__(self, settings: GridSettings | None = None, hold_back: float = 0.0) -> None:
        self._settings = settings or GridSettings()
        self._hold_back = hold_back
        self._held: list[SampleBlock] = []
        self._last: SampleBlock | None = None
        self._clock: StampClock | None = None
        self._uneven = UnevenSampling()
        # The latest blocks and the delays of their stamps [sample periods].
        self._recent: deque[tuple[SampleBlock, float]] = deque()
        self._delay = 0.0
        self.lost_samples = 0
        self.bridged_samples = 0
        self.repeated_samples = 0
        self.interruptions = 0
        self.last_interruption = ""

    @property
    def last(self) -> SampleBlock | None:
        """The last block on the grid."""
        return self._last

    @property
    def uneven(self) -> bool:
        """Whether the sampling is non-uniform: each sample was taken at the time of its stamp."""
        if self._settings.stamps == "auto":
            return self._uneven.found
        return self._settings.stamps == "sampling"

    def follow(self, block: SampleBlock) -> list[Placed]:
        """Add a block; returns the blocks placed on the grid, which is one block if none waits."""
        verdict = self._judge(block)
        if self._hold_back == 0.0 or (not self._held and verdict.kind != "bridged"):
            return [self._place(block, verdict)]
        # Waiting blocks belong to the time before a restart.
        placed = self.flush() if verdict.restarts else []
        self._held.append(block)
        self._held.sort(key=lambda held: held.sequence)
        while self._held:
            verdict = self._judge(self._held[0])
            if verdict.kind == "bridged" and self._may_wait(self._held[-1]):
                break
            placed.append(self._place(self._held.pop(0), verdict))
        return placed

    def flush(self) -> list[Placed]:
        """Place and return the blocks that still wait for missing samples."""
        held, self._held = self._held, []
        return [self._place(block, self._judge(block)) for block in held]

    def _may_wait(self, newest: SampleBlock) -> bool:
        assert self._last is not None
        ahead = newest.sequence + newest.sample_count - _end(self._last)
        return ahead * self._last.period < self._hold_back + newest.sample_count * newest.period

    def _judge(self, block: SampleBlock) -> Continuity:
        last = self._last
        if last is None or self._clock is None:
            return _FIRST
        if not math.isclose(block.period, last.period, rel_tol=1e-6):
            return Continuity(
                "changed_period",
                sentence=f"the sample period changed from {last.period:g} s to {block.period:g} s: "
                "windows and motion restart",
            )
        due_ns = self._clock.at(_end(last))
        late_ns = block.start_ns - due_ns
        missing = block.sequence - _end(last)
        # Difference between the stamp and the time that follows from the count.
        off_ns = abs(late_ns - missing * block.period * NANOSECONDS)
        allowed_ns = max(_JITTER_NS, _JITTER * block.period * NANOSECONDS)
        if off_ns <= allowed_ns:
            if -block.sample_count < missing <= 0:
                return _NEXT
            if missing > 0 and missing * block.period <= self._settings.longest_gap + 1e-9:
                return Continuity("bridged", missing)
            if missing < 0 and off_ns < abs(late_ns) < LATE_NS:
                return _REPEAT
        if abs(late_ns) <= allowed_ns and missing != 0:
            # The stamps continue but the count does not: the source was restarted.
            return Continuity(
                "gap",
                sentence="the sample count was set back or forward (was the source restarted?): "
                "windows and motion restart",
            )
        late = late_ns / NANOSECONDS
        if late > 0.0:
            lost = max(missing, 0)
            detail = (
                f"{lost} samples were lost (by a busy computer or network, or left out by their "
                "source?)"
                if lost
                else f"the samples pause for {late:.3g} s"
            )
            return Continuity("gap", lost, f"{detail}: windows and motion restart")
        if block.end_ns <= due_ns + allowed_ns and -late_ns < LATE_NS and missing < 0:
            return _REPEAT
        return Continuity(
            "jump_back",
            sentence=f"the stamps jump back by {-late:.3g} s: windows and motion restart",
        )

    def _place(self, block: SampleBlock, verdict: Continuity) -> Placed:
        if verdict.sentence:
            self.interruptions += 1
            self.last_interruption = verdict.sentence
        if verdict.kind == "repeat":
            self.repeated_samples += block.sample_count
            return Placed(block, block, 0, verdict, block.start_ns)
        self.lost_samples += verdict.lost
        if verdict.restarts or self._clock is None:
            self._clock = StampClock(block.sequence, block.start_ns, block.period)
            self._recent.clear()
            self._last = block
            self._remember(block, 0.0)
            return Placed(block, block, 0, verdict, block.start_ns)
        assert self._last is not None
        known = _end(self._last) - block.sequence
        if known > 0:
            self.repeated_samples += known
            block = block.part(known)
        self._clock.learn(block.sequence, block.start_ns)
        late = (block.start_ns - self._clock.at(block.sequence)) / (block.period * NANOSECONDS)
        if self._settings.stamps == "auto" and (abs(late) > _NOTICED or self._uneven.found):
            self._uneven.learn(block.sequence, late, block.displacement)
        stamp_ns, measured = block.start_ns, None
        if self.uneven or self._delay > 0.0:
            placed, after = self._between(block, late, verdict.lost)
            stamp_ns = placed.start_ns + round(verdict.lost * block.period * NANOSECONDS)
            measured = _measured(block.force, after, verdict.lost)
            self._remember(block, late)
        else:
            placed = self._in_time(block, late, verdict.lost)
            if verdict.lost:
                measured = _measured(block.force, np.zeros(placed.sample_count), verdict.lost)
            self._remember(placed, late)
        self.bridged_samples += verdict.lost
        self._last = placed
        return Placed(placed, block, verdict.lost, verdict, stamp_ns, measured)

    def _in_time(self, block: SampleBlock, late: float, lost: int) -> SampleBlock:
        """The block with its samples unchanged, preceded by the ``lost`` ones, interpolated."""
        assert self._clock is not None
        if lost == 0:
            if abs(late) <= _EVEN:
                return block
            return replace(block, start_ns=self._clock.at(block.sequence))
        _, displacement, force = self._tail()
        return replace(
            block,
            start_ns=self._clock.at(block.sequence - lost),
            sequence=block.sequence - lost,
            displacement=np.concatenate(
                [on_a_cubic(displacement, block.displacement, lost), block.displacement]
            ),
            force=np.concatenate([on_a_line(force, block.force, lost), block.force]),
        )

    def _between(self, block: SampleBlock, late: float, lost: int) -> tuple[SampleBlock, Array]:
        """The block moved from the sample times to the grid between them.

        The second value is the time from each grid point to the sample with the same index, in
        sample periods.
        """
        assert self._clock is not None
        first = block.sequence - lost
        count = lost + block.sample_count
        step = _SLEW if self.uneven else -_SLEW
        delays = np.clip(self._delay + step * np.arange(1.0, count + 1.0), 0.0, _DELAY)
        self._delay = float(delays[-1])
        wanted = np.arange(count) - delays
        before, displacement, force = self._tail()
        places = np.concatenate([before - first, np.arange(lost, count) + late])
        placed = replace(
            block,
            start_ns=self._clock.at(first) - round(float(delays[0]) * block.period * NANOSECONDS),
            sequence=first,
            displacement=_brought(
                wanted, places, np.concatenate([displacement, block.displacement]), lost
            ),
            # Samples whose stamps are not in order keep their order.
            force=np.interp(
                wanted, np.maximum.accumulate(places), np.concatenate([force, block.force])
            ),
        )
        return placed, delays + late

    def _remember(self, block: SampleBlock, late: float) -> None:
        recent = self._recent
        recent.append((block, late))
        while len(recent) > _AROUND or (len(recent) > 1 and recent[1][0].sample_count >= _AROUND):
            recent.popleft()

    def _tail(self) -> tuple[Array, Array, Array]:
        """Times of the latest samples [sample periods], their displacement and their force."""
        places, displacement, force = (
            np.concatenate(parts)
            for parts in zip(
                *(
                    (
                        block.sequence + np.arange(block.sample_count) + late,
                        block.displacement,
                        block.force,
                    )
                    for block, late in self._recent
                ),
                strict=True,
            )
        )
        return places[-_AROUND:], displacement[-_AROUND:], force[-_AROUND:]


def _brought(wanted: Array, places: Array, displacement: Array, lost: int) -> Array:
    """Displacement (m,) of samples taken at ``places`` (m,), moved to the ``wanted`` places (n,).

    The first ``lost`` of the wanted places have no sample and are interpolated. The samples before
    them come first in ``displacement``.
    """
    if lost == 0:
        return at_even_times(wanted, places, displacement)
    known = displacement.size - (wanted.size - lost)
    earlier = wanted[0] - np.arange(known, 0.0, -1.0)
    even = at_even_times(np.concatenate([earlier, wanted[lost:]]), places, displacement)
    bridge = on_a_cubic(even[:known], even[known:], lost)
    return np.concatenate([bridge, even[known:]])


def _measured(force: Array, after: Array, lost: int) -> tuple[Array, Array]:
    """Measured forces as in :class:`Placed`; lost samples get the force of the next measured one.

    ``after`` (n,) is the time from the place of each sample to its measurement [sample periods].
    """
    after = after.copy()
    after[:lost] = after[lost] + np.arange(lost, 0.0, -1.0)
    return np.concatenate([np.full(lost, force[0]), force]), after


def _end(block: SampleBlock) -> int:
    return block.sequence + block.sample_count
