"""Cuts a stream of blocks into windows for identification, by the data's stamps alone."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from mr_damper_ros.kinematics.peak_velocity import StreamPeakVelocity
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, BlockSequence, SampleBlock
from mr_damper_ros.signals.zero_order_hold import KEEP_CURRENT, ZeroOrderHold

_USUAL_WAIT_NS = 1_000_000_000

_WAIT_FOR_CURRENT = 64
"""At most this many complete windows wait for the current to become known."""


@dataclass(frozen=True, eq=False)
class RawWindow:
    """Samples of one window: arrays of shape (n,), SI units; ``temperature`` [°C], NaN unknown.

    ``peak_velocity`` [m/s] is that of the stream, which knows what went before; None where the
    window is all there is. A look is a window cut early, to see whether its ``look`` newest samples
    still fit the running set; 0 for a window to be fitted.
    """

    start_ns: int
    period: float
    displacement: Array
    force: Array
    current: Array
    temperature: float = math.nan
    look: int = 0
    peak_velocity: Array | None = None

    @property
    def end_ns(self) -> int:
        """Stamp of the last sample."""
        return self.start_ns + round((self.force.size - 1) * self.period * NANOSECONDS)


@dataclass(frozen=True)
class WindowSettings(CheckedSettings):
    """How a stream is cut; raises ValueError where the hop is longer than the window, too."""

    window: float = option(
        2.0,
        "Length of a window [s]; at least one cycle of the motion must fit in.",
        minimum=0.01,
        maximum=3600.0,
    )
    hop: float = option(
        1.0,
        "Time [s] from the start of a window to the start of the next, at most the window's "
        "length.",
        minimum=0.001,
        maximum=3600.0,
    )
    looks: int = option(
        3,
        "Times within a hop that the newest samples are compared with the set in use; 0: never.",
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

    A window is handed out once the current is known for all of it, that is once a value stamped
    at or after its last sample has come: what a window holds then does not depend on the order
    in which the messages of different topics arrive. ``looks`` windows more are cut within each
    hop, see :class:`RawWindow`. A window from whose start the current is not known is left out;
    the next look, which is as long, is then handed out in its place.
    """

    def __init__(self, window: float, hop: float, looks: int = 0) -> None:
        """Raises ValueError, as :class:`WindowSettings` does."""
        self._settings = WindowSettings(window, hop, looks)
        self._sequence = BlockSequence()
        self._peak: StreamPeakVelocity | None = None
        self._current = ZeroOrderHold(keep=max(KEEP_CURRENT, 2.0 * window))
        self._temperature = math.nan
        self._events: list[str] = []
        self._waiting: list[RawWindow] = []
        self._replacing = False
        self._empty()

    def _empty(self) -> None:
        self._blocks: list[SampleBlock] = []
        self._peaks: list[Array] = []
        # Samples of the first block that lie before the present window, and those from there on.
        self._skip = 0
        self._count = 0
        # Of the parts of a hop: 0 where the next window is one to be fitted.
        self._part = 0

    @property
    def sequence(self) -> BlockSequence:
        """How the blocks have followed each other so far."""
        return self._sequence

    @property
    def fill(self) -> float:
        """Part of the present window that is there, 0 to 1."""
        if not self._blocks:
            return 0.0
        return min(self._count * self._blocks[0].period / self._settings.window, 1.0)

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
        verdict = self._sequence.follow(block)
        if verdict.sentence:
            self._events.append(verdict.sentence)
        if verdict.kind == "repeat":
            return []
        if verdict.restarts:
            self._empty()
        if self._peak is None or verdict.restarts:
            self._peak = StreamPeakVelocity(block.period)
        if verdict.kind == "jump_back":
            # Windows that still wait belong to the time before the jump.
            self._waiting.clear()
            self._current.follow_jump()
        self._blocks.append(block)
        self._peaks.append(self._peak.follow(block.displacement))
        self._count += block.sample_count
        self._cut()
        return self._ready()

    def add_current(self, stamp_ns: int, current: float) -> list[RawWindow]:
        """Add a value of the supply current [A]; returns the windows that became complete.

        Raises CurrentError where the current is not finite.
        """
        self._current.add(stamp_ns, current)
        return self._ready()

    def add_temperature(self, celsius: float) -> None:
        """Set the temperature [°C] for the windows completed from now on."""
        self._temperature = celsius

    def _cut(self) -> None:
        period = self._blocks[0].period
        length = max(round(self._settings.window / period), 1)
        step = max(round(self._settings.hop / period), 1)
        parts = min(self._settings.looks + 1, step)
        while self._count >= length:
            to_this, to_next = (step * part // parts for part in (self._part, self._part + 1))
            look = to_this - step * (self._part - 1) // parts if self._part else 0
            end = self._skip + length
            self._waiting.append(
                RawWindow(
                    # From the stamp of its own block: a sample clock that is not quite the
                    # nominal one must not drift away from the stamps.
                    start_ns=self._blocks[0].start_ns + round(self._skip * period * NANOSECONDS),
                    period=period,
                    displacement=self._joined("displacement")[self._skip : end],
                    force=self._joined("force")[self._skip : end],
                    current=np.full(length, math.nan),
                    temperature=self._temperature,
                    look=look,
                    peak_velocity=np.concatenate(self._peaks)[self._skip : end],
                )
            )
            self._count -= to_next - to_this
            self._skip += to_next - to_this
            self._part = (self._part + 1) % parts
            while self._blocks and self._skip >= self._blocks[0].sample_count:
                self._skip -= self._blocks.pop(0).sample_count
                self._peaks.pop(0)

    def _joined(self, name: str) -> Array:
        return np.concatenate([getattr(block, name) for block in self._blocks])

    def _ready(self) -> list[RawWindow]:
        ready = []
        last = self._current.last_stamp_ns
        while self._waiting and last is not None and last >= self._waiting[0].end_ns:
            window = self._waiting.pop(0)
            if not self._current.known_from(window.start_ns):
                self._events.append(
                    "the supply current is not known from the start of a window: it is left out"
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
            self._events.append(
                "windows are dropped, because no supply current comes to go with them"
            )
        return ready
