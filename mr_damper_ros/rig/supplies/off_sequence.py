"""How a supply is switched off: escalating means, and a verdict that rests on measured current.

The rule is pure: times are seconds of one steady clock, and the caller sends, waits and measures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum, auto


class Verdict(Enum):
    """What is known about the current after an attempt to switch off."""

    PENDING = auto()
    OFF = auto()
    """No current was measured after the output was switched off."""
    NOT_MEASURED = auto()
    """The lines were sent, but the instrument measures no current."""
    NOT_CONFIRMED = auto()
    """A current was measured, or the instrument cannot be reached."""


class FallingCurrent:
    """Checks that a current falls to zero: by half within each ``halving`` [s].

    Currents of at most ``tolerance`` [A] are zero.
    """

    def __init__(self, now: float, tolerance: float, halving: float) -> None:
        self._tolerance, self._halving = tolerance, halving
        self._reference, self._since = math.inf, now

    def falls(self, now: float, current: float) -> bool:
        """Take a measured current [A]; returns False if the last halving was too long ago."""
        size = abs(current)
        if size <= self._tolerance:
            self._reference, self._since = math.inf, now
        elif size <= 0.5 * self._reference:
            self._reference, self._since = size, now
        return now - self._since < self._halving


@dataclass(frozen=True)
class Attempt:
    """One attempt: after ``wait`` [s], send the lines and measure the current.

    ``zero`` and ``output_off`` say which lines are sent. Lines are at least ``pause`` [s] apart,
    and each answer must arrive within ``timeout`` [s].
    """

    wait: float
    zero: bool
    output_off: bool
    pause: float
    timeout: float


class _Step(Enum):
    ZERO = auto()
    OUTPUT_OFF = auto()
    SILENCE = auto()
    REPEAT = auto()


_OUTPUT_OFF_TIME = 0.2
"""Time [s] within which the current must fall after the command to switch the output off."""

_INTERVAL = 0.12
"""Time [s] between two attempts, longer than most instruments need to accept another line."""

_REPEAT_PERIOD = 0.5
"""Time [s] between attempts that go on after all means have failed."""

_MARGIN = 0.1
"""Time [s] for which a watchdog may be late, and for the current of the coil to fall."""

_LONGEST_BLIND = 2.0
"""Time [s] for an instrument to begin to measure, before it counts as not measuring; longer for an
instrument with a long time limit for answers."""

_TIMEOUTS = 0.3, 2.0
"""Range of the time limits [s] for an answer, which are doubled after each missing answer."""


class OffSequence:
    """Switches a supply off: zero current, output off, silence for its watchdog, repetition.

    The next means is tried when the measured current does not fall: see :class:`FallingCurrent`.
    The supply is off once two consecutive measurements, the second one after the command to switch
    the output off, are within ``tolerance`` [A] of zero. ``watchdog`` [s] is NaN without a
    watchdog; any line restarts it, so that it acts when nothing is sent. ``current`` [A] is the
    last known current, for the sentence, and ``timeout`` [s] the usual time limit for an answer.
    ``at_once``: zero has failed before, or the link, so that
    the first attempt also switches the output off.
    """

    def __init__(
        self,
        now: float,
        *,
        tolerance: float,
        halving: float,
        timeout: float = 0.0,
        watchdog: float = math.nan,
        current: float = math.nan,
        at_once: bool = False,
    ) -> None:
        self.verdict = Verdict.PENDING
        self._tolerance, self._halving, self._watchdog = tolerance, halving, watchdog
        low, high = _TIMEOUTS
        self._timeout = min(max(timeout, low), high)
        silence = 0.0 if math.isnan(watchdog) else watchdog
        self._blind_until = now + max(_LONGEST_BLIND, 3.0 * self._timeout) + silence
        self._was_silent = False
        self._last = now
        self._last_sent = -math.inf
        self._current = abs(current)
        self._zeros = self._attempts = self._misses = 0
        self._reason = ""
        self._enter(_Step.OUTPUT_OFF if at_once else _Step.ZERO, now)

    @property
    def is_off(self) -> bool:
        """Whether no current was measured after the output was switched off."""
        return self.verdict is Verdict.OFF

    @property
    def decided(self) -> bool:
        """Whether the supply is off, or all means have been tried."""
        return self.verdict is not Verdict.PENDING

    @property
    def sentence(self) -> str:
        """The verdict in words, without a full stop."""
        if self.is_off:
            return f"it is measured to be off ({self._current:.3f} A)"
        carries = "the coil may still carry current"
        if self._current > self._tolerance:
            carries = f"the coil may still carry {float(f'{self._current:.2g}')} A"
        if self._reason and math.isfinite(self._last_sent):
            return f"commanded off, not measured: {carries} ({self._reason})"
        reason = self._reason or f"it does not fall to within {self._tolerance:g} A"
        return f"switching off is not confirmed: {carries} ({reason})"

    def next(self, now: float) -> Attempt:
        """The next attempt."""
        due = self._last + (_INTERVAL if self._attempts else 0.0)
        if self._step is _Step.SILENCE:
            due = self._last_sent + self._watchdog + _MARGIN
        elif self._step is _Step.REPEAT and not self._zeros:
            # Attempts restart a watchdog, so it needs time between them.
            watchdog = 0.0 if math.isnan(self._watchdog) else self._watchdog
            due = max(self._last + _REPEAT_PERIOD, self._last_sent + 2.0 * watchdog)
        return Attempt(
            max(due - now, 0.0),
            zero=self._step is not _Step.SILENCE and not self._zeros,
            output_off=self._step in (_Step.OUTPUT_OFF, _Step.REPEAT),
            pause=_INTERVAL if self._attempts else 0.0,
            timeout=min(self._timeout * 2.0**self._misses, _TIMEOUTS[1]),
        )

    def measured(self, now: float, current: float) -> None:
        """Take the current [A] that was measured in an attempt."""
        self._count(now, sent=True)
        self._current, self._reason = abs(current), ""
        falls = self._falling.falls(now, current)
        self._zeros = self._zeros + 1 if self._current <= self._tolerance else 0
        if self._step is _Step.ZERO:
            if self._zeros or not falls:
                self._enter(_Step.OUTPUT_OFF, now)
        elif self._zeros:
            if self._step is _Step.SILENCE:
                self._enter(_Step.OUTPUT_OFF, now)
            elif self._zeros > 1:
                self.verdict = Verdict.OFF
        elif self._step is _Step.OUTPUT_OFF:
            if self._has_watchdog:
                self._enter(_Step.SILENCE, now)
            elif not falls:
                self._give_up(Verdict.NOT_CONFIRMED, now)
        else:
            self._give_up(Verdict.NOT_CONFIRMED, now)

    def missed(self, now: float, reason: str, *, sent: bool) -> None:
        """Take an attempt without a measured current; ``sent``: its lines have been sent."""
        self._count(now, sent)
        self._reason = reason
        self._misses += 1
        if self._step is _Step.OUTPUT_OFF and sent and self._has_watchdog and not self._was_silent:
            self._enter(_Step.SILENCE, now)
        elif self._step is not _Step.REPEAT and now < self._blind_until:
            self._enter(_Step.OUTPUT_OFF, now)
        else:
            reached = math.isfinite(self._last_sent)
            self._give_up(Verdict.NOT_MEASURED if reached else Verdict.NOT_CONFIRMED, now)

    @property
    def _has_watchdog(self) -> bool:
        return not math.isnan(self._watchdog)

    def _count(self, now: float, sent: bool) -> None:
        self._attempts += 1
        self._last = now
        if sent:
            self._last_sent = now

    def _give_up(self, verdict: Verdict, now: float) -> None:
        self.verdict = verdict
        self._enter(_Step.REPEAT, now)

    def _enter(self, step: _Step, now: float) -> None:
        self._step = step
        self._was_silent |= step is _Step.SILENCE
        time = self._halving if step is _Step.ZERO else _OUTPUT_OFF_TIME
        self._falling = FallingCurrent(now, self._tolerance, time)
