"""Cuts a stream of blocks into windows for identification, by the data's stamps alone.

The cost of adding a block or cutting a window is proportional to its number of samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mr_damper_ros.kinematics.peak_velocity import MEMORY, StreamPeakVelocity
from mr_damper_ros.kinematics.periodic_motion import PHASES
from mr_damper_ros.kinematics.window import averages, holds_cycle
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import Array, RollingRows
from mr_damper_ros.signals.blocks import KEEP_CURRENT, NANOSECONDS, SampleBlock, ZeroOrderHold
from mr_damper_ros.signals.uniform_grid import GridSettings, Placed, UniformGrid
from mr_damper_ros.tracking.screening import long_rest

_HOLD_BACK = 0.05
"""Seconds for which blocks out of order wait for missing blocks; windows are not urgent."""

_GROWTH = 1.25
"""Factor by which a window without a full cycle is extended at each trial."""


@dataclass(frozen=True, eq=False)
class RawWindow:
    """Samples of one window: arrays of shape (n,), SI units; ``temperature`` [°C], NaN if unknown.

    ``peak_velocity`` [m/s] is estimated from the whole stream; None if there is only the window.
    ``look`` is 0 for a window to be fitted. For a change check, which is cut between two windows,
    it is the number of newest samples to compare with the running set. ``force_after`` [sample
    periods] is the delay from each sample to the measurement of its force (None: 0).
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

    def part(self, chosen: slice) -> RawWindow:
        """The samples of a slice without a stride."""
        first, last, _ = chosen.indices(self.force.size)
        if (first, last) == (0, self.force.size):
            return self
        channels: dict[str, Any] = {
            name: None if (values := getattr(self, name)) is None else values[chosen]
            for name in ("displacement", "force", "current", "peak_velocity", "force_after")
        }
        start_ns = self.start_ns + round(first * self.period * NANOSECONDS)
        return replace(self, start_ns=start_ns, **channels)

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
        "more slowly. A window with less than a cycle of the motion is extended into the past "
        "(2 s suffice from 0.5 Hz on).",
        within=(0.01, 3600.0),
    )
    hop: float = option(
        1.0,
        "Time from the start of one window to the start of the next [s], at most `window`. "
        "Half a window uses every sample twice.",
        within=(0.001, 3600.0),
    )
    longest_window: float = option(
        30.0,
        "Largest length to which a window is extended [s] to contain a cycle of the motion; "
        "30 s suffice for 0.05 Hz.",
        within=(0.01, 3600.0),
    )
    centre_memory: float = option(
        MEMORY,
        "Time [s] over which the peak velocity is estimated; it must cover a whole cycle. "
        "Keep it equal to `centre_memory` of model and controller, so that all of them compute "
        "the same peak velocity.",
        within=(0.01, 3600.0),
    )
    looks: int = option(
        3,
        "Number of change checks per hop, which compare the newest samples with the set in "
        "use. After a sudden change of the force, such as a leak, the force scale is fitted at "
        "once, and later windows exclude the samples before the change. 0: no checks; a change is "
        "then detected at the end of a window.",
        within=(0, 1000),
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
    until it does, up to ``longest_window`` seconds. It then uses every third, fifth, ... force,
    with the displacement averaged around each, so that it has at most three times the usual number
    of samples. The next extended window follows once the usual fraction of its samples is new.
    Other windows without a cycle have the usual length and are rejected later.

    A window is returned once a value of the current stamped at or after its last sample has
    arrived, so that it does not depend on the order of the messages. If ``window`` seconds contain
    a cycle, ``looks`` change checks are cut in each hop, see :class:`RawWindow`. A window whose
    current is unknown at its start is omitted; the next change check, of equal length, replaces it.

    ``sequence`` is the uniform grid, which tracks gaps and repeats of the blocks.
    """

    def __init__(
        self, settings: WindowSettings | None = None, grid: GridSettings | None = None
    ) -> None:
        self._settings = settings = settings or WindowSettings()
        self.sequence = UniformGrid(grid, _HOLD_BACK)
        self._peak: StreamPeakVelocity | None = None
        self._longest = max(settings.window, settings.longest_window)
        self._current = ZeroOrderHold(keep=max(KEEP_CURRENT, 2.0 * self._longest))
        self._temperature = math.nan
        self._events: list[str] = []
        self._waiting: list[RawWindow] = []
        self._replacing = False
        self._empty()

    def _empty(self) -> None:
        # The newest samples: displacement, force, peak velocity, delay of the force [samples], and
        # the time [ns] since the first sample. A sample's count is its number since the first one.
        self._rows = RollingRows(5)
        self._begin_ns = self._end = 0
        self._start = 0  # count of the first sample of the present window
        self._newest = 0  # count at which the newest window with a cycle ends
        # Part of the hop: 0 if the next window is to be fitted, otherwise it is a change check.
        self._part = 0

    @property
    def fill(self) -> float:
        """Filled fraction of the present window, 0 to 1."""
        last = self.sequence.last
        if last is None:
            return 0.0
        return min((self._end - self._start) * last.period / self._settings.window, 1.0)

    @property
    def waits_for_current(self) -> bool:
        """Whether a complete window has waited for the current for more than a second.

        With a supply that is read ten times a second, every window waits for a short time.
        """
        last = self.sequence.last
        if not self._waiting or last is None:
            return False
        newest_ns = last.start_ns + round((last.sample_count - 1) * last.period * NANOSECONDS)
        return newest_ns - self._waiting[0].end_ns >= NANOSECONDS

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
        for placed in self.sequence.follow(block):
            self._add(placed)
        return self._ready()

    def _add(self, placed: Placed) -> None:
        block = placed.block
        if placed.sentence:
            self._events.append(placed.sentence)
        if placed.kind == "repeat":
            return
        if placed.restarts:
            self._empty()
        if self._peak is None or placed.restarts:
            self._peak = StreamPeakVelocity(block.period, self._settings.centre_memory)
        if placed.kind == "jump_back":
            # The waiting windows belong to the time before the jump.
            self._waiting.clear()
        if placed.leap_ns:
            self._current.follow_leap(placed.leap_ns, block.end_ns)
        elif placed.kind == "jump_back":
            self._current.follow_jump()
        force, after = placed.measured or (block.force, 0.0)
        if self._end == 0:
            self._begin_ns = block.start_ns
        # Each block restarts from its own stamp, because the real sample rate differs from the
        # nominal one and the error must not accumulate.
        stamps = np.rint(np.arange(block.sample_count) * (block.period * NANOSECONDS))
        stamps += block.start_ns - self._begin_ns
        peak = self._peak.follow(block.displacement)
        self._rows.add((block.displacement, force, peak, after, stamps), block.sample_count)
        self._end += block.sample_count
        self._cut(block.period)

    def add_current(self, stamp_ns: int, current: float) -> list[RawWindow]:
        """Add a value of the supply current [A]; returns the completed windows, oldest first.

        Raises CurrentError if the current is not finite.
        """
        self._current.add(self.sequence.continued(stamp_ns), current)
        return self._ready()

    def add_temperature(self, celsius: float) -> None:
        """Set the temperature [°C] for the windows completed from now on."""
        self._temperature = celsius

    def _cut(self, period: float) -> None:
        length = max(round(self._settings.window / period), 1)
        longest = max(round(self._longest / period), length)
        step = max(round(self._settings.hop / period), 1)
        parts = min(self._settings.looks + 1, step)
        while self._end - self._start >= length:
            to_this, to_next = (step * part // parts for part in (self._part, self._part + 1))
            look = to_this - step * (self._part - 1) // parts if self._part else 0
            end = self._start + length
            reach = self._reach(end, length, longest)
            if not look:
                if reach and (end - self._newest) * length >= step * reach:
                    self._newest = end
                else:
                    reach = length
            # In less than a cycle, model error cannot be distinguished from a change of force.
            if not look or reach == length:
                self._waiting.append(self._window(end, reach, length, period, look))
            self._start += to_next - to_this
            self._part = (self._part + 1) % parts
            # The next window ends later, so samples beyond its reach are discarded.
            self._rows.keep(max(self._end - (self._start + length - longest), 0))

    def _samples(self, start: int, stop: int) -> Array:
        """The samples with these counts, as columns of a view; it is valid until the next block."""
        first = self._end - self._rows.count
        return self._rows.newest[:, start - first : stop - first]

    def _reach(self, end: int, length: int, longest: int) -> int:
        """Number of samples up to ``end`` that hold a cycle, at least ``length``, or else 0."""
        if holds_cycle(self._samples(end - length, end)[0]):
            return length
        most = min(end - (self._end - self._rows.count), longest)
        size = max(length // PHASES, 1)
        points = averages(self._samples(end - most // size * size, end)[0], most // size)
        speed = np.diff(points)
        reach = float(length)
        while reach < most:
            reach = min(reach * _GROWTH, most)
            count = int(reach) // size
            if holds_cycle(points[-count:]):
                # Motion before a stop does not count towards a cycle at the present position.
                return 0 if long_rest(speed[-count:]) is not None else min(count * size, most)
        return 0

    def _window(self, end: int, reach: int, length: int, period: float, look: int) -> RawWindow:
        """The window of ``reach`` samples before ``end``, thinned if it is an extended one."""
        # With an odd stride, each average is centred on a sample.
        stride = max((reach // length - 1) // 2 * 2 + 1, 1)
        count = reach // stride
        samples = self._samples(end - count * stride, end).copy()
        displacement, force, peak, after, stamps = samples[:, stride // 2 :: stride]
        if stride > 1:
            displacement = samples[0].reshape(count, stride).mean(axis=1)
        return RawWindow(
            self._begin_ns + int(stamps[0]),
            stride * period,
            displacement,
            force,
            current=np.full(count, math.nan),
            temperature=self._temperature,
            look=look,
            peak_velocity=peak,
            force_after=after / stride if after.any() else None,
        )

    def _ready(self) -> list[RawWindow]:
        ready = []
        last = self._current.last_stamp_ns
        while self._waiting and last is not None and last >= self._waiting[0].end_ns:
            window = self._waiting.pop(0)
            if not self._current.known_from(window.start_ns):
                self._events.append(
                    "the supply current is unknown at the start of a window: the window is omitted"
                )
                self._replacing = self._replacing or not window.look
                continue
            look, self._replacing = 0 if self._replacing else window.look, False
            current = self._current.at(window.start_ns, window.period, window.force.size)
            ready.append(replace(window, look=look, current=current))
        # A window waits for its current at most as long as the longest window lasts.
        hops = math.ceil(self._longest / self._settings.hop)
        most = hops * (self._settings.looks + 1)
        if len(self._waiting) > most:
            del self._waiting[:-most]
            self._events.append("windows are dropped, because no supply current arrives for them")
        return ready
