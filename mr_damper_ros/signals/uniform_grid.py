"""Places arriving blocks on a uniform grid, by the same rules for all consumers.

The stamps of the data are the only clock. A sample of the grid has the same index as in the count
of the source. Its time is given by the clock estimated from the stamps
(:class:`mr_damper_ros.signals.clocks.StampClock`), or by the stamp itself if it does not jitter.
Every interruption has a name and is handled in the same way everywhere:

- a *bridged* gap (few samples lost): interpolated from the samples on both sides, and marked;
- a *gap* (more samples lost, the source paused or restarted): the windows and the motion restart;
- a *jump back* (a bag that loops, a clock that was set): the windows and the motion restart;
- a *repeat* (samples that were received before, or already count as lost, or values of the last
  block under a new count): ignored;
- a *changed period*: the windows and the motion restart;
- *frozen* stamps (the count continues, the stamp does not change): the count gives the time.

None of them changes identified parameters.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import SIGMAS, Array, largest_magnitude, span_of
from mr_damper_ros.signals.blocks import LATE_NS, NANOSECONDS, SampleBlock
from mr_damper_ros.signals.clocks import StampClock
from mr_damper_ros.signals.recording import LARGEST_MOTION

_NEIGHBOURS = 12
"""Largest number of samples that determine the slope at a gap. It is also the number of stored past
samples, and of neighbours that interpolate a sample."""


def on_a_cubic(before: Array, after: Array, count: int) -> Array:
    """``count`` values between the last of ``before`` (n,) and the first of ``after`` (m,).

    They lie on the cubic Hermite polynomial that matches the values and slopes at both ends. If one
    end has fewer than three values, it is a parabola; if both have, a straight line. Each slope is
    the slope of a parabola fitted to the nearest samples. Over a twentieth of a cycle, the error of
    a displacement is a tenth of the error of linear interpolation.
    """
    width = count + 1.0
    place = np.arange(1.0, width) / width
    rise = float(after[0] - before[-1])
    points = min(max(count + 2, 3), _NEIGHBOURS)
    # Slopes minus the slope of the straight line, times the width of the gap.
    start = width * _end_slope(before[-points:]) - rise
    end = -width * _end_slope(after[:points][::-1]) - rise
    if math.isnan(start):
        start = 0.0 if math.isnan(end) else -end
    if math.isnan(end):
        end = -start
    line = before[-1] + rise * place
    return np.asarray(line + place * (1.0 - place) * (start * (1.0 - place) - end * place))


def at_uniform_times(wanted: Array, places: Array, values: Array) -> Array:
    """The last n of the ``values`` (m,), sampled at ``places`` (m,), moved to ``wanted`` (n,).

    Each value moves to its new time parallel to the cubic that fits its neighbours best, so that it
    keeps its own noise. Linear interpolation would reduce the noise by an amount that depends on
    the distance from the samples; it would no longer be white, and a filter that recognises noise
    by its whiteness would interpret the remaining noise as motion.
    """
    width = min(_NEIGHBOURS + 1, places.size)
    powers = np.arange(min(3, width - 1) + 1)
    own = np.arange(places.size - wanted.size, places.size)
    first = np.clip(own - width // 2, 0, places.size - width)
    around = first[:, np.newaxis] + np.arange(width)
    unit = 0.5 * width
    time = (places[around] - places[own, np.newaxis]) / unit
    # The pseudo-inverse also exists if many samples have the same stamp.
    fit = np.linalg.pinv(time[:, :, np.newaxis] ** powers)
    away = values[around] - values[own, np.newaxis]
    cubic = (fit @ away[:, :, np.newaxis])[:, :, 0]
    way = ((wanted - places[own]) / unit)[:, np.newaxis] ** powers
    return np.asarray(values[own] + (cubic * way)[:, 1:].sum(axis=1))


def _end_slope(values: Array) -> float:
    """Slope per sample, at the last value, of the least-squares parabola through the values."""
    if values.size < 3:
        return math.nan
    return float(np.polynomial.polynomial.polyfit(np.arange(1 - values.size, 1), values, 2)[1])


class NonUniformSampling:
    """Decides whether the jitter of stamps comes from non-uniform sampling.

    With non-uniform sampling, the displacement of a sample differs from the mean of its neighbours
    by the velocity times the difference between its stamp and the mean stamp of its neighbours. If
    only the stamps jitter, this difference is absent. A least-squares fit gives its share: 1 for
    non-uniform sampling and 0 for inaccurate stamps.
    """

    def __init__(self, found: bool = False) -> None:
        # Delay and displacement of the last two samples, the neighbours of the next ones.
        self._tail = np.empty((2, 0))
        self._next = 0
        # Sums of the products and squares of both differences, and the number of samples.
        self._sums = np.zeros(4)
        self.found = found

    def learn(self, index: int, late: float, displacement: Array) -> None:
        """Add a block whose stamp is ``late`` [sample periods], negative for early.

        ``index`` is the index of its first sample. Samples across a jump of the index are not
        compared.
        """
        tail = self._tail if index == self._next else self._tail[:, :0]
        self._next = index + displacement.size
        block = np.stack([np.full(displacement.size, late), displacement])
        times, values = np.concatenate([tail, block], axis=1)
        self._tail = np.stack([times[-2:], values[-2:]])
        off = values[1:-1] - 0.5 * (values[:-2] + values[2:])
        expected = 0.5 * (values[2:] - values[:-2]) * (times[1:-1] - 0.5 * (times[:-2] + times[2:]))
        count = float(np.count_nonzero(expected))
        off = off[expected != 0.0]
        expected = expected[expected != 0.0]
        self._sums += [off @ expected, expected @ expected, off @ off, count]
        product, square, rest, count = self._sums.tolist()
        if square == 0.0:
            return
        share = product / square
        # The noise counts as at least as large as the expected difference, so that a few samples do
        # not decide.
        noise = max(rest / square - share**2, 1.0) / count
        if abs(share - 0.5) > SIGMAS * noise**0.5:
            self.found = share > 0.5


_JITTER_NS = 5_000_000
"""Largest error of a stamp [ns], in addition to a sample period, while the sample count continues.
Computers assign stamps with a variable delay."""

_PERIOD_ERROR = 2e-3
"""A block whose period deviates by at most this fraction has the period of the blocks before: some
sources compute the period of each block from inaccurate stamps."""

_EVEN = 0.02
"""A stamp with an error of at most this fraction of a period is used unchanged. Stamps with larger
errors show whether the sampling is non-uniform."""

_DELAY = 0.5
"""Delay of the grid with non-uniform sampling, in sample periods, so that its points lie between
samples that have arrived."""


@dataclass(frozen=True)
class GridSettings(CheckedSettings):
    """Options for placing a stream with jitter or gaps on a uniform grid."""

    stamps: str = option(
        "auto",
        "Meaning of stamp jitter. 'clock': the sampling is uniform and the stamps are "
        "inaccurate, as with the controller of a machine; 'sampling': each sample was taken at the "
        "time of its stamp; 'auto': 'clock' until the motion shows which of the two applies.",
        choices=("auto", "clock", "sampling"),
    )
    longest_gap: float = option(
        0.05,
        "Longest gap of lost samples that is interpolated [s]; after a longer gap the estimate of "
        "the motion restarts. 0: no gap is interpolated.",
        within=(0.0, 1.0),
    )


@dataclass(frozen=True, eq=False)
class Placed:
    """A block on the grid, and its relation to its predecessor.

    ``kind`` is "first", "next", "bridged", "displaced" (after an impossible displacement), "gap",
    "jump_back", "repeat" or "changed_period". ``sentence`` describes an interruption; it is empty
    for "first", "next" and "bridged". The first ``bridged`` samples of the block were not measured.

    The block excludes samples that arrived before; for a repeat, it is the arriving block.
    ``stamp_ns`` is the time of the first measured value: its own stamp, unless the stamps are
    frozen or the values were moved on the time axis. In the latter case, ``measured`` holds a
    measured force (n,) [N] for each sample, and the time (n,) from the sample to this force in
    sample periods; otherwise it is None.
    ``leap_ns`` is the time by which the stamps of a "gap" or "jump_back" leapt more than the count:
    a clock was set or, after a gap, the source paused. It is 0 if the count was set back.
    """

    kind: str
    sentence: str
    block: SampleBlock
    stamp_ns: int
    bridged: int = 0
    measured: tuple[Array, Array] | None = None
    leap_ns: int = 0

    @property
    def restarts(self) -> bool:
        """Whether windows and motion must restart."""
        return self.kind in _RESTARTS


_RESTARTS = ("displaced", "gap", "jump_back", "changed_period")

_SAME_BUFFER = (
    "the source sends the samples of its last block again, with new numbers: it is ignored (is the "
    "buffer of the data acquisition refilled?)"
)

_Verdict = tuple[str, int, str]
"""Kind of a block, number of samples lost before it, and sentence, as in :class:`Placed`."""


class UniformGrid:
    """Places the blocks of a stream on a uniform grid and counts interruptions.

    A block that arrives out of order waits for the missing blocks until the stream has advanced by
    ``hold_back`` [s]. Blocks in order never wait. A stream without faults passes unchanged.

    Attributes count, since the start, the lost samples, the bridged samples among them, the
    repeated or late samples, and the interruptions. ``last_interruption`` describes the last
    interruption.
    """

    def __init__(self, settings: GridSettings | None = None, hold_back: float = 0.0) -> None:
        self._settings = settings or GridSettings()
        self._hold_back = hold_back
        self._held: list[SampleBlock] = []
        self.last: SampleBlock | None = None
        """The last block on the grid."""
        self._clock: StampClock | None = None
        # Stamp of the last block as it arrived.
        self._stamp_ns = 0
        # Time since the stamps are frozen, 0 if they are not.
        self._frozen_ns = 0
        self._sampling = NonUniformSampling()
        # The latest blocks, each with the delay of its samples [sample periods].
        self._past: deque[tuple[SampleBlock, float]] = deque(maxlen=_NEIGHBOURS)
        self.lost_samples = 0
        self.bridged_samples = 0
        self.repeated_samples = 0
        self.interruptions = 0
        self.last_interruption = ""

    @property
    def non_uniform(self) -> bool:
        """Whether the sampling is non-uniform: each sample was taken at the time of its stamp."""
        if self._settings.stamps == "auto":
            return self._sampling.found
        return self._settings.stamps == "sampling"

    def follow(self, block: SampleBlock) -> list[Placed]:
        """Add a block; returns the blocks placed on the grid, which is one block if none waits."""
        before = block.period if self.last is None else self.last.period
        if 0.0 < abs(block.period - before) <= _PERIOD_ERROR * before:
            block = replace(block, period=before)
        verdict = self._judge(block)
        if self._hold_back == 0.0 or (not self._held and verdict[0] != "bridged"):
            return [self._place(block, verdict)]
        # Blocks still waiting belong to the time before the restart.
        placed = self.flush() if verdict[0] in _RESTARTS else []
        self._held.append(block)
        self._held.sort(key=lambda held: held.sequence)
        newest = self._held[-1]
        while self._held:
            verdict = self._judge(self._held[0])
            if verdict[0] == "bridged":
                assert self.last is not None
                since = newest.sequence - _end(self.last)
                if since * block.period < self._hold_back:
                    break
            placed.append(self._place(self._held.pop(0), verdict))
        return placed

    def flush(self) -> list[Placed]:
        """Place and return the blocks that still wait for missing samples."""
        held, self._held = self._held, []
        return [self._place(block, self._judge(block)) for block in held]

    def _judge(self, block: SampleBlock) -> _Verdict:
        last = self.last
        if last is None or self._clock is None:
            return "first", 0, ""
        if block.period != last.period:
            changed = f"the sample period changed from {last.period:.9g} s to {block.period:.9g} s"
            return "changed_period", 0, f"{changed} (every block must state the nominal period)"
        due_ns = self._clock.at(_end(last))
        late_ns = 0 if self._is_frozen(block) else block.start_ns - due_ns
        late = late_ns / NANOSECONDS
        missing = block.sequence - _end(last)
        # Difference between the stamp and the time that follows from the count.
        off_ns = abs(late_ns - missing * block.period * NANOSECONDS)
        allowed_ns = _JITTER_NS + block.period * NANOSECONDS
        if off_ns <= allowed_ns:
            # The motion restarts, because such a sample would distort its statistics for a minute.
            if missing == 0 and (step := _jump(last, block)):
                jump = f"the displacement jumps by {step:.3g} m between two samples"
                return "displaced", 0, f"{jump} (a loose cable, or millimetres?)"
            if missing >= 0 and _is_same_buffer(last, block):
                return "repeat", 0, _SAME_BUFFER
            if -block.sample_count < missing <= 0:
                return "next", 0, ""
            if missing > 0 and missing * block.period <= self._settings.longest_gap + 1e-9:
                return "bridged", missing, ""
        continues = off_ns <= allowed_ns and off_ns < abs(late_ns) < LATE_NS
        ends_before = block.end_ns <= due_ns + allowed_ns and -LATE_NS < late_ns <= 0
        if missing < 0 and (continues or (ends_before and abs(late_ns) > allowed_ns)):
            return "repeat", 0, "a block arrived twice or too late: it is ignored"
        if abs(late_ns) <= allowed_ns and missing != 0:
            # The stamps continue but the count does not.
            return "gap", 0, "the sample count was set back or forward (was the source restarted?)"
        if late <= 0.0:
            return "jump_back", 0, f"the stamps jump back by {-late:.3g} s"
        if missing <= 0:
            return "gap", 0, f"the samples pause for {late:.3g} s"
        why = "is the computer or network overloaded, or did the source omit them?"
        return "gap", missing, f"{missing} samples were lost ({why})"

    def continued(self, stamp_ns: int) -> int:
        """The time of a value of another channel, whose stamp is frozen if those of samples are."""
        if self.last is None or stamp_ns > self._stamp_ns:
            return stamp_ns
        return stamp_ns + self._frozen_ns

    def _is_frozen(self, block: SampleBlock) -> bool:
        """Whether a block continues the count with the stamp of the last block."""
        return (
            self.last is not None
            and block.start_ns == self._stamp_ns
            and block.sequence == _end(self.last)
        )

    def _place(self, block: SampleBlock, verdict: _Verdict) -> Placed:
        kind, lost, sentence = verdict
        frozen = self._is_frozen(block)
        restarts = kind in _RESTARTS
        if sentence:
            sentence += ": windows and motion restart" if restarts else ""
            self.interruptions += 1
            self.last_interruption = sentence
        if kind == "repeat":
            self.repeated_samples += block.sample_count
            return Placed(kind, sentence, block, block.start_ns)
        self._stamp_ns, self._frozen_ns = block.start_ns, 0
        self.lost_samples += lost
        if restarts or self._clock is None:
            leap_ns = 0
            counts_on = self.last is not None and block.sequence >= _end(self.last)
            if kind in ("gap", "jump_back") and counts_on and self._clock is not None:
                leap_ns = block.start_ns - self._clock.at(block.sequence)
            self._clock = StampClock(block.sequence, block.start_ns, block.period)
            self._sampling = NonUniformSampling(self._sampling.found)
            self._past.clear()
            self.last = block
            self._past.append((block, 0.0))
            return Placed(kind, sentence, block, block.start_ns, leap_ns=leap_ns)
        assert self.last is not None
        if frozen:
            self._frozen_ns = self._clock.at(block.sequence) - block.start_ns
            block = replace(block, start_ns=block.start_ns + self._frozen_ns)
        known = _end(self.last) - block.sequence
        if known > 0:
            self.repeated_samples += known
            block = block.part(known)
        if not frozen:
            self._clock.learn(block.sequence, block.start_ns)
        late = (block.start_ns - self._clock.at(block.sequence)) / (block.period * NANOSECONDS)
        if self._settings.stamps == "auto" and (abs(late) > _EVEN or self._sampling.found):
            self._sampling.learn(block.sequence, late, block.displacement)
        stamp_ns, measured, placed = block.start_ns, None, block
        moves = self.non_uniform
        if not moves:
            if abs(late) > _EVEN:
                placed = replace(block, start_ns=self._clock.at(block.sequence))
            late = 0.0
        if moves or lost:
            delay = _DELAY if moves else 0.0
            placed = self._resampled(block, late, lost, delay)
            # A lost sample has the force of the next measured one.
            after = delay + late + np.maximum(lost - np.arange(placed.sample_count), 0.0)
            measured = np.concatenate([np.full(lost, block.force[0]), block.force]), after
        if moves:
            stamp_ns = placed.start_ns + round(lost * block.period * NANOSECONDS)
        self._past.append((block, late))
        self.bridged_samples += lost
        self.last = placed
        return Placed(kind, sentence, placed, stamp_ns, lost, measured)

    def _resampled(self, block: SampleBlock, late: float, lost: int, delay: float) -> SampleBlock:
        """The block, preceded by the ``lost`` samples, moved from the sample times to the grid.

        The grid has a ``delay`` [sample periods], as its points lie between the samples with
        non-uniform sampling.
        """
        assert self._clock is not None
        first = block.sequence - lost
        count = lost + block.sample_count
        wanted: Array = np.arange(count, dtype=float) - delay
        past = zip(*(_rows(*each) for each in self._past), strict=True)
        places, displacement, force = (np.concatenate(row)[-_NEIGHBOURS:] for row in past)
        places = np.concatenate([places - first, np.arange(lost, count) + late])
        displacement = np.concatenate([displacement, block.displacement])
        known = places.size - block.sample_count
        if lost:
            # The lost samples are interpolated between the past and the new ones.
            earlier = wanted[0] - np.arange(known, 0.0, -1.0)
            even = at_uniform_times(np.concatenate([earlier, wanted[lost:]]), places, displacement)
            bridge = on_a_cubic(even[:known], even[known:], lost)
            displacement = np.concatenate([bridge, even[known:]])
        else:
            displacement = at_uniform_times(wanted, places, displacement)
        return replace(
            block,
            start_ns=self._clock.at(first) - round(delay * block.period * NANOSECONDS),
            sequence=first,
            displacement=displacement,
            # Samples keep their order even if their stamps do not. The force has sharp reversals,
            # where a cubic has no advantage.
            force=np.interp(
                wanted, np.maximum.accumulate(places), np.concatenate([force, block.force])
            ),
        )


def _rows(block: SampleBlock, late: float) -> tuple[Array, Array, Array]:
    """Time [sample periods], displacement and force (n,) of a block that is ``late``."""
    places = block.sequence + late + np.arange(block.sample_count, dtype=float)
    return places, block.displacement, block.force


def _jump(last: SampleBlock, block: SampleBlock) -> float:
    """Largest change of the displacement [m] between two samples, if it is impossible, else 0."""
    lows, highs = zip(span_of(last.displacement), span_of(block.displacement), strict=True)
    if max(highs) - min(lows) <= LARGEST_MOTION:
        return 0.0
    step = largest_magnitude(np.diff(np.concatenate((last.displacement, block.displacement))))
    return step if step > LARGEST_MOTION else 0.0


_SEAM = 2.0
"""Between two equal blocks, the displacement of a buffer that is sent again jumps by more than this
multiple of the largest step within. A motion that repeats with each block does not jump."""


def _is_same_buffer(last: SampleBlock, block: SampleBlock) -> bool:
    """Whether a block holds the values of its predecessor although the motion does not repeat."""
    values = block.displacement
    if values[0] != last.displacement[0] or values.size < 2:
        return False
    return (
        np.array_equal(values, last.displacement)
        and np.array_equal(block.force, last.force)
        and abs(values[0] - values[-1]) > _SEAM * largest_magnitude(np.diff(values))
    )


def _end(block: SampleBlock) -> int:
    return block.sequence + block.sample_count
