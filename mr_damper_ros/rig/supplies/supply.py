"""A supply that speaks SCPI, by the profile of its type, and the thread that drives it."""

from __future__ import annotations

import math
import re
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from mr_damper_ros.rig.commander import CurrentCommander
from mr_damper_ros.rig.supplies.off_sequence import FallingCurrent, OffSequence
from mr_damper_ros.rig.supplies.scpi_link import LinkLostError, Patience, ScpiLink

_NUMBERS = {"watchdog_step": (1e-3, 3600.0), "pause": (0.0, 1.0), "zero_timeout": (0.05, 10.0)}
"""Ranges of the numbers in a profile."""

_FILLED_IN = {"current": 1.0, "voltage": 1.0, "seconds": 1.0}
"""Allowed names in the braces of a command."""


@dataclass(frozen=True)
class SupplyProfile:
    """SCPI lines by their effect. A line may hold ``{current}``, ``{voltage}``, ``{seconds}``.

    ``setup`` is sent once, with the output off and zero current. After the lines of ``watchdog``,
    the instrument switches its output off if it receives no line for ``{seconds}``, the requested
    time rounded up to a multiple of ``watchdog_step`` [s]. Without these lines there is no
    watchdog. After the watchdog has tripped, ``rearm`` makes the instrument accept ``output_on``
    again. Lines are sent at least ``pause`` [s] apart. After the current is set to zero, its
    measured value falls by half within each ``zero_timeout`` [s]. ``tested`` says in a sentence
    with which instruments the profile was tested.
    """

    tested: str
    set_current: str = "CURR {current:.4f}"
    read_current: str = "MEAS:CURR?"
    output_on: str = "OUTP ON"
    output_off: str = "OUTP OFF"
    read_error: str = "SYST:ERR?"
    setup: tuple[str, ...] = ("VOLT {voltage:.3f}",)
    watchdog: tuple[str, ...] = ()
    watchdog_step: float = 1.0
    rearm: tuple[str, ...] = ()
    pause: float = 0.0
    zero_timeout: float = 0.5

    def watchdog_delay(self, wanted: float) -> float:
        """The shortest delay [s] of the instrument's watchdog that is at least ``wanted``."""
        return max(math.ceil(wanted / self.watchdog_step - 1e-9), 1) * self.watchdog_step


def read_profile(name: str) -> SupplyProfile:
    """The profile of a name, or of the path of a YAML file; raises ValueError."""
    import yaml  # imported late, because a node without a supply needs no YAML

    path = Path(name) if name.endswith((".yaml", ".yml")) else _FOLDER / f"{name}.yaml"
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        shipped = ", ".join(sorted(each.stem for each in _FOLDER.glob("*.yaml")))
        raise ValueError(
            f"the profile '{name}' cannot be read: name one of {shipped}, or "
            "the path of a YAML file"
        ) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(
            f"the profile '{name}' is not valid YAML: {error}".split("\n")[0]
        ) from error
    return _profile(content, name)


def _profile(content: Any, name: str) -> SupplyProfile:
    if not isinstance(content, dict):
        raise ValueError(f"the profile '{name}' is not a table of names and lines")
    defaults = {field.name: field.default for field in fields(SupplyProfile)}
    values: dict[str, Any] = {}
    for key, value in content.items():
        if key not in defaults:
            raise ValueError(
                f"the profile '{name}' has the unknown entry '{key}': use {', '.join(defaults)}"
            )
        if key in _NUMBERS:
            low, high = _NUMBERS[key]
            if type(value) not in (int, float) or not low <= value <= high:
                raise ValueError(
                    f"'{key}' of the profile '{name}' must be a number from {low:g} to {high:g} [s]"
                )
            values[key] = float(value)
            continue
        lines = tuple(map(str, value if isinstance(value, list) else [value]))
        for line in lines if key != "tested" else ():
            try:
                line.format(**_FILLED_IN)
            except (KeyError, IndexError, ValueError) as error:
                raise ValueError(
                    f"the line '{line}' of the profile is invalid: only {{current}}, {{voltage}} "
                    "and {seconds} may stand in braces"
                ) from error
        values[key] = lines if isinstance(defaults[key], tuple) else str(value)
    if "tested" not in values:
        raise ValueError(
            f"the profile '{name}' does not say with which instruments it was tested: add 'tested'"
        )
    return SupplyProfile(**values)


_FOLDER = Path(__file__).parent / "profiles"

_MOST_ERRORS = 50
"""A queue with more errors means that the profile does not match the instrument."""

_NOT_A_NUMBER = 9.9e37
"""Larger values mean infinity or "not a number" (SCPI-99, volume 1, 7.2.1)."""


class SupplyError(ValueError):
    """The instrument gives an unexpected answer; the message is a sentence."""


class NotOffError(SupplyError):
    """The instrument is not measured to be off; the message is a sentence."""


def reports_error(answer: str) -> bool:
    """Whether an answer to ``read_error`` is an error: a number other than 0, or other words.

    The number ends at the first separator; "no error" needs no number.
    """
    number = _ERROR_NUMBER.match(answer)
    if number is not None:
        return float(number[1]) != 0.0
    return _NO_ERROR.search(answer) is None


_ERROR_NUMBER = re.compile(r"[\s\"']*([+-]?\d+(?:\.\d*)?)(?![\w.])")
_NO_ERROR = re.compile(r"\bno[\s_-]*errors?\b", re.IGNORECASE)


class ScpiSupply:
    """One instrument; every method raises LinkLostError if it does not answer.

    ``connect`` opens a link, on which each answer must arrive within ``timeout`` [s]. ``voltage``
    [V] is the largest coil voltage. ``watchdog`` [s] is the time without a line after which the
    instrument switches its output off, if its profile has a watchdog. Currents of at most
    ``tolerance`` [A] are zero.
    """

    def __init__(
        self,
        connect: Callable[[Patience, str], ScpiLink],
        profile: SupplyProfile,
        *,
        voltage: float,
        watchdog: float,
        timeout: float,
        tolerance: float,
    ) -> None:
        self._connect = connect
        self._timeout = timeout
        self.patience = Patience(timeout)
        self.tolerance, self.zero_timeout = tolerance, profile.zero_timeout
        self._profile = profile
        self._voltage = voltage
        self._delay = profile.watchdog_delay(watchdog)
        self._link: ScpiLink | None = None
        self._identity = ""
        self._given = ""
        self._setpoint = self._measured = math.nan
        self.switched_on = False
        """Whether the output was switched on and has not been measured as off since then."""

    @property
    def watchdog(self) -> float:
        """Watchdog delay of the instrument [s]; NaN if it has no watchdog."""
        return self._delay if self._profile.watchdog else math.nan

    def open(self) -> str:
        """Connect, switch the output off and set the instrument up; returns its identification.

        Raises SupplyError if the instrument reports an error, NotOffError if it is not measured to
        be off.
        """
        self.close()
        self._identity = ""
        self._set_patience(self._timeout)
        self._identity = self._linked().identify()
        off = self.off_sequence()
        while not off.decided:
            self.attempt(off, time.sleep)
        if not off.is_off:
            raise NotOffError(off.sentence)
        self._begin_setup()
        self.errors()  # they are older
        for line in self._profile.setup:
            self._write(line)
        self._require_no_errors("the set-up")
        return self._identity

    def switch_on(self) -> None:
        """Switch the output on at zero current, which is measured.

        Raises SupplyError if the instrument reports an error or gives a current.
        """
        self._begin_setup()
        self.give(0.0, again=True)
        self._write(self._profile.output_off)
        self.errors()  # zero is checked by measurement
        for line in (*self._profile.rearm, *self._profile.watchdog):
            self._write(line)
        self.switched_on = True
        self._write(self._profile.output_on)
        self._require_no_errors("switching the output on")
        time.sleep(_RISE)
        current = self.measured()
        if abs(current) > self.tolerance:
            raise SupplyError(_not_zero(current))
        self._linked().command_pause = 0.0

    def off_sequence(self, *, at_once: bool = False) -> OffSequence:
        """A new sequence of attempts to switch this supply off."""
        return OffSequence(
            time.monotonic(),
            tolerance=self.tolerance,
            halving=self.zero_timeout,
            timeout=self._timeout,
            watchdog=self.watchdog,
            current=float(np.fmax(abs(self._measured), abs(self._setpoint))),
            at_once=at_once,
        )

    def attempt(self, off: OffSequence, sleep: Callable[[float], object]) -> None:
        """Make the next attempt to switch off, over a new link if the present one fails.

        It is abandoned if ``sleep``, which waits for a time [s], returns True.
        """
        made = off.next(time.monotonic())
        self._set_patience(made.timeout)
        if sleep(made.wait):
            return
        sent = False
        try:
            link = self._linked()
            link.command_pause = made.pause
            sent = True
            if made.zero:
                self.give(0.0, again=True)
            if made.output_off:
                self._write(self._profile.output_off)
            current = self.measured()
        except Exception as error:  # whatever the error, attempts must go on
            if not isinstance(error, SupplyError):
                with suppress(LinkLostError):
                    self.close()
            if not self.patience.ended:
                off.missed(time.monotonic(), str(error), sent=sent)
        else:
            off.measured(time.monotonic(), current)
        if off.is_off:
            self.switched_on = False

    def give(self, current: float, *, again: bool = False) -> None:
        """Set the current [A], unless it is already set and not to be sent ``again``."""
        line = self._profile.set_current.format(current=current)
        if again or line != self._given:
            self._given = ""
            self._setpoint = current
            self._write(line)
            self._given = line

    def repeat(self, current: float) -> None:
        """Set the current [A] again, after a pause in which the instrument can execute lines."""
        link = self._linked()
        link.command_pause = _SETUP_PAUSE
        self.give(current, again=True)
        link.command_pause = 0.0

    def measured(self) -> float:
        """The current [A] measured by the instrument; raises SupplyError for a bad answer."""
        link = self._linked()
        for _ in range(_MOST_LATE_ANSWERS):
            answer = link.query(self._profile.read_current)
            try:
                value = float(answer)
            except ValueError:
                link.synchronise()  # it may be the answer to another query
            else:
                break
        else:
            value = math.nan
        if not abs(value) < _NOT_A_NUMBER:
            raise SupplyError(
                f"the supply answers '{answer[:80]}' to {self._profile.read_current}, which is not "
                "a current: is the profile right for this instrument?"
            )
        self._measured = value
        return value

    def next_error(self) -> str:
        """Read the oldest error in the instrument's queue; empty if there is none."""
        answer = self._linked().query(self._profile.read_error)
        return answer if reports_error(answer) else ""

    def errors(self) -> list[str]:
        """Read all errors in the instrument's queue."""
        found: list[str] = []
        while error := self.next_error():
            found.append(error)
            if len(found) == _MOST_ERRORS:
                raise SupplyError(
                    f"the supply's error queue does not end: it always answers {error[:80]} to "
                    f"{self._profile.read_error}; is the profile right for this instrument?"
                )
        return found

    def close(self) -> None:
        """Close the link; the instrument keeps its state."""
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def _require_no_errors(self, what: str) -> None:
        errors = self.errors()
        if errors:
            raise SupplyError(
                f"the supply reports an error after {what}: {'; '.join(errors)[:200]}"
            )

    def _write(self, line: str) -> None:
        self._linked().write(line.format(voltage=self._voltage, seconds=self._delay))

    def _begin_setup(self) -> None:
        """Send the next lines with pauses, because some instruments lose lines without notice."""
        self._set_patience(self._timeout)
        self._linked().command_pause = _SETUP_PAUSE

    def _set_patience(self, timeout: float) -> None:
        self.patience.timeout, self.patience.end = timeout, math.inf

    def _linked(self) -> ScpiLink:
        """The present link, or a new one."""
        if self._link is None:
            self._link = self._connect(self.patience, self._identity)
            self._link.pause = self._profile.pause
        return self._link


def _not_zero(current: float) -> str:
    return f"the supply is set to zero current but gives {current:.3f} A"


_MOST_LATE_ANSWERS = 3
"""Answers that may be late before one counts as the instrument's own."""

_SETTLING = 1.0
"""Settling time [s] of a coil and a supply at a new current; also the interval between two checks
of the instrument's queue of errors."""

_SETUP_PAUSE = 0.06
"""Pause [s] before each line of the set-up, and before a line that is repeated."""

_RISE = 0.1
"""Time [s] in which the current of an output that is not at zero becomes measurable."""

_LOST = 0.1
"""Time [s] after which a setpoint that is not reached is sent again: the line may be lost."""

_FAST_PERIOD = 0.02
"""Longest time [s] between two readings until the current has fallen to zero."""

_GRACE = 0.1
"""Time [s] that an awaited answer has when the supply must be switched off."""

_LAST_TRY = 1.0
"""Time [s] for another attempt on a supply that was not measured to be off before."""

_LONGEST_STOP = 6.0
"""Longest wait [s] for a verdict; the process has ten seconds to end."""

_REMINDER_PERIOD = 10.0
"""Time [s] between two log entries while the supply is not measured to be off."""


class SupplyDrive:
    """A supply that follows commands in its own thread; it is switched off at the end or on errors.

    ``given`` and ``measured`` are currents [A]; the supply ``deviates`` if they differ by more than
    the tolerance for longer than the settling time. ``failure`` says why the supply is no longer
    driven. ``off`` is the sequence that switches it off; its attempts go on until the instrument
    measures no current or :meth:`end` is called. ``publish`` receives the time [ns] by ``clock_ns``
    and the measured current [A] every ``period`` [s]; ``log_error`` receives error messages.
    """

    def __init__(
        self,
        supply: ScpiSupply,
        commander: CurrentCommander,
        *,
        period: float,
        clock_ns: Callable[[], int],
        publish: Callable[[int, float], None],
        log_error: Callable[[str], object],
    ) -> None:
        self._supply = supply
        self._commander = commander
        self._period = period
        self._clock_ns = clock_ns
        self._publish = publish
        self._log_error = log_error
        self.given, self.measured = 0.0, math.nan
        self.deviates = False
        self.complaints = 0
        self.last_complaint = self.failure = ""
        self.off: OffSequence | None = None
        self._off_target = False
        self._changed = -math.inf
        self._checked = -math.inf
        self._stopping = False
        self._stopped_at = math.inf
        self._woken = threading.Event()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="supply", daemon=True)

    def start(self) -> None:
        """Switch on at zero current, then follow the commands.

        Raises LinkLostError and SupplyError. If the output may still be on, the thread runs, but
        only to switch it off.
        """
        try:
            try:
                self._supply.switch_on()
            except LinkLostError:
                # The instrument may be reachable again.
                self._supply.open()
                self._supply.switch_on()
        except (ValueError, OSError) as error:
            self.failure = str(error)
            raise
        finally:
            if self._supply.switched_on:
                self._agreed = time.monotonic()
                self._commander.start(self._agreed)
                self._thread.start()

    @property
    def finished(self) -> bool:
        """Whether the thread has ended: the supply is off, or :meth:`end` was called."""
        return not self._thread.is_alive()

    @property
    def problem(self) -> str:
        """The failure, and whether the supply is off, in words; empty without a failure."""
        return "; ".join(filter(None, [self.failure, self.off.sentence if self.off else ""]))

    def wake(self) -> None:
        """Wake the thread for a new command."""
        self._woken.set()

    def stop(self) -> bool:
        """Switch off; returns whether no current is measured, after a few seconds at most.

        The time limit counts from the first call. Without this measurement, the thread goes on.
        """
        now = time.monotonic()
        if not self._stopping:
            self._stopped_at = now
            if self.off is None:
                self._supply.patience.end = now + _GRACE
            self._stopping = True
            self._woken.set()
        while not self.finished:
            decided = self.off is not None and self.off.decided
            if time.monotonic() - self._stopped_at > (_LAST_TRY if decided else _LONGEST_STOP):
                break
            self._thread.join(0.01)
        if self.off is not None and self.off.is_off:
            self._thread.join(1.0)
        return self.finished and not self._supply.switched_on

    def end(self) -> None:
        """Stop trying to switch off, and end the thread."""
        self._ended.set()
        self._supply.patience.end = -math.inf
        self._thread.join(1.0)

    def _run(self) -> None:
        try:
            if not self.failure:
                self._follow()
        except Exception as error:  # whatever the error, the current must not stay on
            if not self._stopping:
                self.failure = (
                    str(error)
                    if isinstance(error, (LinkLostError, SupplyError))
                    else f"driving the supply failed: {error}"
                )
                self._log_error(f"{self.failure}: trying to switch the output off")
            if isinstance(error, LinkLostError) and not self._stopping:
                with suppress(LinkLostError):  # the old link is abandoned
                    self._supply.close()
            at_once = True
        else:
            at_once = False
        self.given = 0.0
        self._switch_off(at_once=at_once)

    def _switch_off(self, *, at_once: bool) -> None:
        off = self.off = self._supply.off_sequence(at_once=at_once)
        reminded = -math.inf
        while not off.is_off and not self._ended.is_set():
            self._supply.attempt(off, self._ended.wait)
            now = time.monotonic()
            if off.decided and not off.is_off and now > reminded:
                self._log_error(self.problem)
                reminded = now + _REMINDER_PERIOD

    def _follow(self) -> None:
        due = time.monotonic()
        falling: FallingCurrent | None = None
        while not self._stopping:
            self._woken.clear()
            now = time.monotonic()
            self._obey(now)
            if self._off_target and now >= max(due, self._changed + _LOST):
                self._supply.repeat(self.given)
            if self.given != 0.0:
                falling = None
            elif falling is None:
                falling, due = FallingCurrent(now, *self._zero), min(due, now + _FAST_PERIOD)
            if now >= due:
                asked_ns = self._clock_ns()
                self.measured = self._supply.measured()
                self._off_target = abs(self.measured - self.given) > self._supply.tolerance
                if not self._off_target:
                    self._agreed = now
                self.deviates = now - self._agreed > _SETTLING
                self._publish((asked_ns + self._clock_ns()) // 2, self.measured)
                if falling is not None and not falling.falls(time.monotonic(), self.measured):
                    raise SupplyError(_not_zero(self.measured))
                # The answer may have taken long.
                self._obey(time.monotonic())
                self._check(now)
                period = self._period
                if falling is not None and self._off_target:
                    period = min(period, _FAST_PERIOD)
                due = max(due + period, time.monotonic())
            now = time.monotonic()
            self._woken.wait(max(min(due - now, self._commander.wait(now)), 0.0))

    def _obey(self, now: float) -> None:
        before, self.given = self.given, self._commander.step(now)
        if self.given != before:
            self._changed = now
        self._supply.give(self.given)

    @property
    def _zero(self) -> tuple[float, float]:
        return self._supply.tolerance, self._supply.zero_timeout

    def _check(self, now: float) -> None:
        """Read the next error of the instrument, regularly, or at once after another error."""
        if now - self._checked < _SETTLING:
            return
        complaint = self._supply.next_error()
        if complaint:
            self.complaints += 1
            self.last_complaint = complaint
        else:
            self._checked = now
