"""Cuts a stream of blocks into windows for identification, by the data's stamps alone.

:class:`SampleStore` keeps the newest samples in one array. The cost of adding a block or cutting a
window is proportional to its number of samples.
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

    ``force_after`` [sample periods] is the delay from a sample to the measurement of its force.
    """

    displacement: Array
    force: Array
    peak_velocity: Array
    force_after: Array


class SampleStore:
    """Keeps samples until they are discarded; a sample's count is its number since the first."""

    def __init__(self) -> None:
        # The rows of Samples, and the stamp [ns] relative to that of the first sample.
        self._rows = RollingRows(len(Samples._fields) + 1)
        self._begin_ns: int | None = None
        self.first = 0
        """Count of the first sample kept."""

    @property
    def end(self) -> int:
        """Count of the next sample to arrive."""
        return self.first + self._rows.count

    def add(
        self,
        block: SampleBlock,
        peak_velocity: Array,
        measured: tuple[Array, Array] | None = None,
    ) -> None:
        """Add the samples of a block and the peak velocity [m/s] (n,) at them.

        ``measured`` holds forces [N] that replace the block's, and their delays after the samples
        [sample periods].
        """
        count = block.sample_count
        force, after = measured or (block.force, 0.0)
        if self._begin_ns is None:
            self._begin_ns = block.start_ns
        # Stamps start from that of each block, because the real sample rate differs from the
        # nominal one and the error must not accumulate.
        stamps = np.rint(np.arange(count) * (block.period * NANOSECONDS))
        stamps += block.start_ns - self._begin_ns
        self._rows.add((block.displacement, force, peak_velocity, after, stamps), count)

    def samples(self, start: int, stop: int) -> Samples:
        """Copy the samples with these counts."""
        return Samples(*self._part(start, stop)[:-1].copy())

    def displacement(self, start: int, stop: int) -> Array:
        """Displacement [m] of the samples with these counts, shape (n,).

        This is a view, valid until the next change of the store.
        """
        return np.asarray(self._part(start, stop)[0])

    def stamp_ns(self, count: int) -> int:
        """Stamp of the sample with this count."""
        assert self._begin_ns is not None
        return self._begin_ns + int(self._part(count, count + 1)[-1, 0])

    def forget(self, before: int) -> None:
        """Discard the samples before the one with this count."""
        held = self._rows.count
        self._rows.keep(max(self.end - before, 0))
        self.first += held - self._rows.count

    def _part(self, start: int, stop: int) -> Array:
        return self._rows.newest[:, start - self.first : stop - self.first]


_USUAL_WAIT_NS = 1_000_000_000

_HOLD_BACK = 0.05
"""Seconds for which blocks out of order wait for the missing ones; windows are not urgent."""

_WAIT_FOR_CURRENT = 64
"""Largest number of complete windows that wait for their current."""

_GROWTH = 1.25
"""Factor by which a window without a full cycle is extended at each trial."""

_POINTS = 64
"""Number of averaged points per window length in the search for a cycle in a longer window."""


@dataclass(frozen=True, eq=False)
class RawWindow:
    """Samples of one window: arrays of shape (n,), SI units; ``temperature`` [°C], NaN if unknown.

    ``peak_velocity`` [m/s] is estimated from the whole stream; None if there is only the window.
    ``look`` is 0 for a window to be fitted. For a change check it is the number of newest samples
    that are compared with the running set; such a window is cut early. ``force_after`` [sample
    periods] is the delay from each sample to the measurement of its force; None if there is no
    delay.
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
    """How a stream is cut; raises ValueError for a value out of range or a hop above the window."""

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

    If these seconds do not contain a cycle of the motion, the window is extended into the past
    until it does, up to ``longest`` seconds. An extended window uses every third, fifth, ... force,
    so that it has at most three times the usual number of samples. Its displacement is averaged
    around each of these samples. The next extended window follows when the same fraction of it is
    new as of a usual window. Windows in between, and windows without a cycle at any length, are
    returned with the usual length, and are rejected later.

    A window is returned once the current is known for all of it, that is, once a value stamped at
    or after its last sample has arrived. Its content therefore does not depend on the order in
    which the messages of different topics arrive. If ``window`` seconds contain a cycle, ``looks``
    change checks are cut in each hop, see :class:`RawWindow`. A window whose current is unknown at
    its start is omitted; the next change check, which has the same length, replaces it.
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
        """Raise ValueError as :class:`WindowSettings` does; ``longest`` None takes the default."""
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
        # Count of the first sample of the present window.
        self._start = 0
        # Count of the end of the newest window with a cycle.
        self._newest = 0
        # Part of the hop: 0 if the next window is to be fitted, else a change check.
        self._part = 0

    @property
    def sequence(self) -> UniformGrid:
        """The uniform grid, which tracks gaps and repeats of the blocks."""
        return self._sequence

    @property
    def fill(self) -> float:
        """Filled fraction of the present window, 0 to 1."""
        last = self._sequence.last
        if last is None:
            return 0.0
        count = self._store.end - self._start
        return min(count * last.period / self._settings.window, 1.0)

    @property
    def waits_for_current(self) -> bool:
        """Whether a complete window has waited for the current for more than a second.

        With a supply that is read ten times a second, every window waits for a short time.
        """
        last = self._sequence.last
        if not self._waiting or last is None:
            return False
        newest_ns = last.start_ns + round((last.sample_count - 1) * last.period * NANOSECONDS)
        return newest_ns - self._waiting[0].end_ns >= _USUAL_WAIT_NS

    def take_events(self) -> list[str]:
        """Return the messages since the last call."""
        events, self._events = self._events, []
        return events

    def reset(self) -> None:
        """Discard the samples collected so far; the stream continues."""
        self._empty()
        self._waiting.clear()

    def add_block(self, block: SampleBlock) -> list[RawWindow]:
        """Add a block; returns the completed windows, oldest first."""
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
            # The waiting windows belong to the time before the jump.
            self._waiting.clear()
            self._current.follow_jump()
        self._store.add(block, self._peak.follow(block.displacement), placed.measured)
        self._cut(block.period)

    def add_current(self, stamp_ns: int, current: float) -> list[RawWindow]:
        """Add a value of the supply current [A]; returns the completed windows, oldest first.

        Raises CurrentError if the current is not finite.
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
                # In less than a cycle, model error cannot be distinguished from a change of force.
                if reach == length:
                    self._waiting.append(self._window(end, length, length, period, look))
            elif reach and (end - self._newest) * length >= step * reach:
                self._newest = end
                self._waiting.append(self._window(end, reach, length, period))
            else:
                self._waiting.append(self._window(end, length, length, period))
            self._start += to_next - to_this
            self._part = (self._part + 1) % parts
            # The next window ends later, so samples beyond its reach are discarded.
            longest = max(round(self._longest / period), length)
            self._store.forget(self._start + length - longest)

    def _reach(self, end: int, length: int, period: float) -> int:
        """Number of samples before ``end`` that contain a cycle, at least ``length``, or 0."""
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
                # Motion before a stop does not count towards a cycle at the present position.
                resting = rests_too_long(part_at_rest(speed[-count:]))
                return 0 if resting else min(count * size, most)
        return 0

    def _window(self, end: int, reach: int, length: int, period: float, look: int = 0) -> RawWindow:
        """The window of ``reach`` samples before ``end``, thinned if it is an extended one."""
        # With an odd stride, each average is centred on a sample.
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
