"""Cuts a stream of blocks into windows for identification, by the data's stamps alone.

The newest samples are kept in one array (:class:`SampleStore`): what is added or cut costs what it
holds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.peak_velocity import MEMORY, StreamPeakVelocity
from mr_damper_ros.kinematics.window import averages, holds_cycle
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import Array, RollingRows
from mr_damper_ros.signals.blocks import KEEP_CURRENT, NANOSECONDS, SampleBlock, ZeroOrderHold
from mr_damper_ros.signals.uniform_grid import GridSettings, Placed, UniformGrid
from mr_damper_ros.tracking.screening import part_at_rest, rests_too_long


class Samples(NamedTuple):
    """Displacement [m], force [N] and peak velocity [m/s] of samples, each of shape (n,).

    ``force_after`` [sample periods]: how long after the sample its force was measured.
    """

    displacement: Array
    force: Array
    peak_velocity: Array
    force_after: Array


class SampleStore:
    """Keeps what was added until it is forgotten; samples are counted from the first one on."""

    def __init__(self) -> None:
        # Those of Samples, and the stamp [ns] after that of the first sample.
        self._rows = RollingRows(len(Samples._fields) + 1)
        self._begin_ns: int | None = None
        self.first = 0
        """Count of the first sample that is kept."""

    @property
    def end(self) -> int:
        """Count of the sample that comes next."""
        return self.first + self._rows.count

    def add(
        self,
        block: SampleBlock,
        peak_velocity: Array,
        measured: tuple[Array, Array] | None = None,
    ) -> None:
        """Add the samples of a block and the peak velocity [m/s] (n,) at them.

        ``measured``: forces [N] in place of the block's, and how many sample periods after each.
        """
        count = block.sample_count
        force, after = measured or (block.force, 0.0)
        if self._begin_ns is None:
            self._begin_ns = block.start_ns
        # From the stamp of its own block: a sample clock that is not quite the nominal one must
        # not drift away from the stamps.
        stamps = np.rint(np.arange(count) * (block.period * NANOSECONDS))
        stamps += block.start_ns - self._begin_ns
        self._rows.add((block.displacement, force, peak_velocity, after, stamps), count)

    def samples(self, start: int, stop: int) -> Samples:
        """The samples with these counts, as arrays of their own."""
        return Samples(*self._part(start, stop)[:-1].copy())

    def displacement(self, start: int, stop: int) -> Array:
        """Displacement [m] of the samples with these counts, shape (n,); to be read at once."""
        return np.asarray(self._part(start, stop)[0])

    def stamp_ns(self, count: int) -> int:
        """Stamp of the sample with this count."""
        assert self._begin_ns is not None
        return self._begin_ns + int(self._part(count, count + 1)[-1, 0])

    def forget(self, before: int) -> None:
        """Let go of the samples before the one with this count."""
        held = self._rows.count
        self._rows.keep(max(self.end - before, 0))
        self.first += held - self._rows.count

    def _part(self, start: int, stop: int) -> Array:
        return self._rows.newest[:, start - self.first : stop - self.first]


_USUAL_WAIT_NS = 1_000_000_000

_HOLD_BACK = 0.05
"""Seconds for which blocks that overtook others wait for them: a window is in no hurry."""

_WAIT_FOR_CURRENT = 64
"""At most this many complete windows wait for the current to become known."""

_GROWTH = 1.25
"""A window that lacks motion is tried again as many times as long."""

_POINTS = 64
"""Whether a longer window holds a cycle is seen in so many points for each window's length."""


@dataclass(frozen=True, eq=False)
class RawWindow:
    """Samples of one window: arrays of shape (n,), SI units; ``temperature`` [°C], NaN unknown.

    ``peak_velocity`` [m/s] is that of the stream, which knows what went before; None where the
    window is all there is. A look is a window cut early, to see whether its ``look`` newest samples
    still fit the running set; 0 for a window to be fitted. ``force_after``: how many sample periods
    after each sample its force was measured; None where all were measured at their samples.
    """

    start_ns: int
    period: float
    displacement: Array
    force: Array
    current: Array
    temperature: float = math.nan
    look: int = 0
    peak_velocity: Array | None = None
    force_after: Array | None = None

    @property
    def end_ns(self) -> int:
        """Stamp of the last sample."""
        return self.start_ns + round((self.force.size - 1) * self.period * NANOSECONDS)


@dataclass(frozen=True)
class WindowSettings(CheckedSettings):
    """How a stream is cut; raises ValueError where the hop is longer than the window, too."""

    window: float = option(
        2.0,
        "Length of a window [s]. Longer windows give smaller standard errors and track drift "
        "more slowly. If it contains less than a cycle of the motion (2 s suffice from 0.5 Hz "
        "on), the window is extended into the past.",
        minimum=0.01,
        maximum=3600.0,
    )
    hop: float = option(
        1.0,
        "Time from the start of one window to the start of the next [s], at most `window`. "
        "Half a window uses every sample twice.",
        minimum=0.001,
        maximum=3600.0,
    )
    longest_window: float = option(
        30.0,
        "Largest length to which a window is extended [s] to contain a cycle of the motion; "
        "30 s suffice for 0.05 Hz.",
        minimum=0.01,
        maximum=3600.0,
    )
    centre_memory: float = option(
        MEMORY,
        "Time [s] over which the peak velocity is estimated; it must cover a whole cycle. "
        "Keep it equal to `centre_memory` of model and controller, so that a set is used at "
        "the peak velocities at which it was identified.",
        minimum=0.01,
        maximum=3600.0,
    )
    looks: int = option(
        3,
        "Number of change checks per hop, which compare the newest samples with the set in "
        "use. After a sudden change of the force, such as a leak, its scale is fitted at "
        "once, and later windows exclude the samples before the change. 0: never; changes are "
        "then detected at the end of a window.",
        minimum=0,
        maximum=1000,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.hop > self.window:
            raise ValueError(
                f"hop ({self.hop:g} s) is longer than window ({self.window:g} s): "
                "samples between two windows would never be used"
            )


class WindowAssembler:
    """Collects blocks into windows of ``window`` seconds, one every ``hop`` seconds of data.

    Where these seconds hold no cycle of the motion, the window reaches further back: to where it
    holds one, up to ``longest``. Of such a window only every third, fifth, ... force is taken, so
    that it has no more than three times the usual number of samples, and the displacement is the
    average about it. The next one comes when as large a part of it is new as of a usual window;
    what lacks motion in between, or at any length, is handed out as it is, to be refused.

    A window is handed out once the current is known for all of it, that is once a value stamped
    at or after its last sample has come: what a window holds then does not depend on the order
    in which the messages of different topics arrive. ``looks`` windows more are cut within each
    hop where ``window`` seconds hold a cycle, see :class:`RawWindow`. A window from whose start the
    current is not known is left out; the next look, which is as long, is then handed out in its
    place.
    """

    def __init__(
        self,
        window: float,
        hop: float,
        looks: int = 0,
        longest: float | None = None,
        grid: GridSettings | None = None,
        centre_memory: float = MEMORY,
    ) -> None:
        """Raises ValueError, as :class:`WindowSettings` does; ``longest`` None: its default."""
        longest = WindowSettings.longest_window if longest is None else longest
        self._settings = WindowSettings(window, hop, longest, centre_memory, looks)
        self._sequence = UniformGrid(grid, _HOLD_BACK)
        self._peak: StreamPeakVelocity | None = None
        self._longest = max(window, self._settings.longest_window)
        self._current = ZeroOrderHold(keep=max(KEEP_CURRENT, 2.0 * self._longest))
        self._temperature = math.nan
        self._events: list[str] = []
        self._waiting: list[RawWindow] = []
        self._replacing = False
        self._empty()

    def _empty(self) -> None:
        self._store = SampleStore()
        # Samples from the start of the present window on are counted so.
        self._start = 0
        # End of the newest window with a cycle.
        self._newest = 0
        # Of the parts of a hop: 0 where the next window is one to be fitted.
        self._part = 0

    @property
    def sequence(self) -> UniformGrid:
        """How the blocks have followed each other so far."""
        return self._sequence

    @property
    def fill(self) -> float:
        """Part of the present window that is there, 0 to 1."""
        last = self._sequence.last
        if last is None:
            return 0.0
        count = self._store.end - self._start
        return min(count * last.period / self._settings.window, 1.0)

    @property
    def waits_for_current(self) -> bool:
        """Whether a complete window still waits for a value of the current a second later.

        A supply that is read ten times a second lets every window wait for a moment.
        """
        last = self._sequence.last
        if not self._waiting or last is None:
            return False
        newest_ns = last.start_ns + round((last.sample_count - 1) * last.period * NANOSECONDS)
        return newest_ns - self._waiting[0].end_ns >= _USUAL_WAIT_NS

    def take_events(self) -> list[str]:
        """What happened since the last call, in sentences."""
        events, self._events = self._events, []
        return events

    def reset(self) -> None:
        """Forget the samples collected so far; the stream goes on."""
        self._empty()
        self._waiting.clear()

    def add_block(self, block: SampleBlock) -> list[RawWindow]:
        """Add a block; returns the windows that became complete, oldest first."""
        for placed in self._sequence.follow(block):
            self._add(placed)
        return self._ready()

    def _add(self, placed: Placed) -> None:
        block, verdict = placed.block, placed.continuity
        if verdict.sentence:
            self._events.append(verdict.sentence)
        if verdict.kind == "repeat":
            return
        if verdict.restarts:
            self._empty()
        if self._peak is None or verdict.restarts:
            self._peak = StreamPeakVelocity(block.period, self._settings.centre_memory)
        if verdict.kind == "jump_back":
            # Windows that still wait belong to the time before the jump.
            self._waiting.clear()
            self._current.follow_jump()
        self._store.add(block, self._peak.follow(block.displacement), placed.measured)
        self._cut(block.period)

    def add_current(self, stamp_ns: int, current: float) -> list[RawWindow]:
        """Add a value of the supply current [A]; returns the windows that became complete.

        Raises CurrentError where the current is not finite.
        """
        self._current.add(stamp_ns, current)
        return self._ready()

    def add_temperature(self, celsius: float) -> None:
        """Set the temperature [°C] for the windows completed from now on."""
        self._temperature = celsius

    def _cut(self, period: float) -> None:
        length = max(round(self._settings.window / period), 1)
        step = max(round(self._settings.hop / period), 1)
        parts = min(self._settings.looks + 1, step)
        while self._store.end - self._start >= length:
            to_this, to_next = (step * part // parts for part in (self._part, self._part + 1))
            look = to_this - step * (self._part - 1) // parts if self._part else 0
            end = self._start + length
            reach = self._reach(end, length, period)
            if look:
                # In part of a cycle what a law leaves of the force looks like a change of it.
                if reach == length:
                    self._waiting.append(self._window(end, length, length, period, look))
            elif reach and (end - self._newest) * length >= step * reach:
                self._newest = end
                self._waiting.append(self._window(end, reach, length, period))
            else:
                self._waiting.append(self._window(end, length, length, period))
            self._start += to_next - to_this
            self._part = (self._part + 1) % parts
            # The next window ends after this one: what it does not reach is let go of.
            longest = max(round(self._longest / period), length)
            self._store.forget(self._start + length - longest)

    def _reach(self, end: int, length: int, period: float) -> int:
        """Samples back from the end that hold a cycle, ``length`` at least; 0 where too few do."""
        store = self._store
        if holds_cycle(store.displacement(end - length, end)):
            return length
        most = min(end - store.first, max(round(self._longest / period), length))
        size = max(length // _POINTS, 1)
        points = averages(store.displacement(end - most // size * size, end), most // size)
        speed = np.diff(points)
        reach = float(length)
        while reach < most:
            reach = min(reach * _GROWTH, most)
            count = int(reach) // size
            if holds_cycle(points[-count:]):
                # What a machine did before it stopped says nothing of where it stands now.
                resting = rests_too_long(part_at_rest(speed[-count:]))
                return 0 if resting else min(count * size, most)
        return 0

    def _window(self, end: int, reach: int, length: int, period: float, look: int = 0) -> RawWindow:
        """The window of so many samples before the end, thinned where it is a long one."""
        # An odd number: then the sample in the middle is the average's own.
        stride = max((reach // length - 1) // 2 * 2 + 1, 1)
        count = reach // stride
        start = end - count * stride
        samples = self._store.samples(start, end)
        middle = stride // 2
        displacement = samples.displacement.reshape(count, stride)
        after = samples.force_after[middle::stride]
        return RawWindow(
            start_ns=self._store.stamp_ns(start + middle),
            period=stride * period,
            displacement=displacement.mean(axis=1) if stride > 1 else samples.displacement,
            force=samples.force[middle::stride],
            current=np.full(count, math.nan),
            temperature=self._temperature,
            look=look,
            peak_velocity=samples.peak_velocity[middle::stride],
            force_after=after / stride if after.any() else None,
        )

    def _ready(self) -> list[RawWindow]:
        ready = []
        last = self._current.last_stamp_ns
        while self._waiting and last is not None and last >= self._waiting[0].end_ns:
            window = self._waiting.pop(0)
            if not self._current.known_from(window.start_ns):
                self._events.append(
                    "the supply current is unknown at the start of a window: the window is left out"
                )
                self._replacing = self._replacing or not window.look
                continue
            if self._replacing:
                window = replace(window, look=0)
                self._replacing = False
            current = self._current.at(window.start_ns, window.period, window.force.size)
            ready.append(replace(window, current=current))
        most = _WAIT_FOR_CURRENT * (self._settings.looks + 1)
        if len(self._waiting) > most:
            del self._waiting[:-most]
            self._events.append("windows are dropped, because no supply current arrives for them")
        return ready
