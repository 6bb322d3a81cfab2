"""A supply that speaks SCPI, by the profile of its type, and the thread that drives it."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from mr_damper_ros.rig.commander import CurrentCommander
from mr_damper_ros.rig.supplies.scpi_link import LinkLostError, Patience, ScpiLink

_FILLED_IN = {"current": 1.0, "voltage": 1.0, "seconds": 1.0}
"""Allowed names in the braces of a command."""


@dataclass(frozen=True)
class SupplyProfile:
    """SCPI lines by their effect. A line may hold ``{current}``, ``{voltage}``, ``{seconds}``.

    ``setup`` is sent once, with the output off and zero current. After the lines of ``watchdog``,
    the instrument switches its output off if it receives no line for ``{seconds}``, the requested
    time rounded up to a multiple of ``watchdog_step`` [s]. Without these lines there is no
    watchdog. After the watchdog has tripped, ``rearm`` makes the instrument accept ``output_on``
    again. An answer to ``read_error`` that begins with ``no_error`` means that there are no more
    errors. ``tested`` says in a sentence with which instruments the profile was tested.
    """

    tested: str
    set_current: str = "CURR {current:.4f}"
    read_current: str = "MEAS:CURR?"
    output_on: str = "OUTP ON"
    output_off: str = "OUTP OFF"
    read_error: str = "SYST:ERR?"
    no_error: tuple[str, ...] = ("0,", "+0,")
    setup: tuple[str, ...] = ("VOLT {voltage:.3f}",)
    watchdog: tuple[str, ...] = ()
    watchdog_step: float = 1.0
    rearm: tuple[str, ...] = ()

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
        if key == "watchdog_step":
            if type(value) not in (int, float) or not 0.0 < value < math.inf:
                raise ValueError(f"'{key}' of the profile '{name}' must be a positive number [s]")
            values[key] = float(value)
            continue
        lines = tuple(map(str, value if isinstance(value, list) else [value]))
        for line in lines if key not in ("tested", "no_error") else ():
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


class ScpiSupply:
    """One instrument; every method raises LinkLostError if it does not answer.

    ``connect`` opens a link, on which each answer must arrive within ``timeout`` [s]. ``voltage``
    [V] is the largest coil voltage. ``watchdog`` [s] is the time without a line after which the
    instrument switches its output off, if its profile has a watchdog.
    """

    def __init__(
        self,
        connect: Callable[[Patience], ScpiLink],
        profile: SupplyProfile,
        *,
        voltage: float,
        watchdog: float,
        timeout: float,
    ) -> None:
        self._connect = connect
        self.patience = Patience(timeout)
        self._profile = profile
        self._voltage = voltage
        self._delay = profile.watchdog_delay(watchdog)
        self._link: ScpiLink | None = None
        self._given = ""
        self.switched_on = False
        """Whether the output was switched on and has not been confirmed as off since then."""

    @property
    def watchdog(self) -> float:
        """Watchdog delay of the instrument [s]; NaN if it has no watchdog."""
        return self._delay if self._profile.watchdog else math.nan

    def open(self) -> str:
        """Connect, switch the output off and set the instrument up; returns its identification.

        Raises SupplyError if the instrument reports an error.
        """
        self.close()
        self.patience.end = math.inf
        self._link = self._connect(self.patience)
        name = self._link.query("*IDN?")
        self.switch_off()
        for line in self._profile.setup:
            self._write(line)
        self._require_no_errors("the set-up")
        return name

    def switch_on(self) -> None:
        """Switch the output on, at zero current; raises SupplyError if the instrument objects."""
        self.patience.end = math.inf
        self.switch_off()
        for line in (*self._profile.rearm, *self._profile.watchdog):
            self._write(line)
        self.switched_on = True
        self._write(self._profile.output_on)
        try:
            self._require_no_errors("switching the output on")
        except SupplyError:
            self.switch_off()
            raise

    def switch_off(self) -> None:
        """Set zero current, switch the output off, and check that the lines have arrived."""
        self._given = ""
        self.give(0.0)
        self._write(self._profile.output_off)
        # An answer confirms that the lines before it have arrived. Reported errors may be older.
        if self.errors():
            self._write(self._profile.output_off)
            self._require_no_errors("switching the output off")
        self.switched_on = False

    def give(self, current: float) -> None:
        """Set the current [A], unless it is already set."""
        line = self._profile.set_current.format(current=current)
        if line != self._given:
            self._write(line)
            self._given = line

    def measured(self) -> float:
        """The current [A] measured by the instrument; raises SupplyError for a bad answer."""
        answer = self._linked().query(self._profile.read_current)
        try:
            value = float(answer)
        except ValueError:
            value = math.nan
        if not abs(value) < _NOT_A_NUMBER:
            raise SupplyError(
                f"the supply answers '{answer[:80]}' to {self._profile.read_current}, which is not "
                "a current: is the profile right for this instrument?"
            )
        return value

    def next_error(self) -> str:
        """Read the oldest error in the instrument's queue; empty if there is none."""
        answer = self._linked().query(self._profile.read_error)
        return "" if answer.startswith(self._profile.no_error) else answer

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

    def rescue(self) -> None:
        """Switch the output off over a new link, regardless of the time limit of the old link."""
        self.patience.end = math.inf
        with suppress(LinkLostError):  # the old link is abandoned
            self.close()
        self._link = self._connect(self.patience)
        self.switch_off()

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

    def _linked(self) -> ScpiLink:
        if self._link is None:
            raise LinkLostError("there is no link to the supply")
        return self._link


_SETTLING = 1.0
"""Settling time [s] of a coil and a supply at a new current; also the interval between two checks
of the instrument's queue of errors."""


_STOP = 3.0
"""Time limit [s] for a supply to confirm that it is off; the process has ten seconds to end."""

_LAST_ANSWER = 0.5 * _STOP
"""Time limit [s] for the last answers over the present link when switching off."""

_RETRY_PERIOD = 0.5
"""Time [s] between two attempts to switch off a supply that does not answer."""


class SupplyDrive:
    """A supply that follows commands in its own thread; it is switched off at the end or on errors.

    ``given`` and ``measured`` are currents [A]; the supply ``deviates`` if they differ by more than
    ``tolerance`` [A] for longer than the settling time. If the instrument does not answer, the
    thread sends the command to switch off over new links, until the instrument confirms it or
    :meth:`end` is called. ``failure`` says why the supply is no longer driven. ``publish`` receives
    the time [ns] by ``clock_ns`` and the measured current [A] every ``period`` [s]; ``log_error``
    receives error messages.
    """

    def __init__(
        self,
        supply: ScpiSupply,
        commander: CurrentCommander,
        *,
        tolerance: float,
        period: float,
        clock_ns: Callable[[], int],
        publish: Callable[[int, float], None],
        log_error: Callable[[str], object],
    ) -> None:
        self._supply = supply
        self._commander = commander
        self._tolerance = tolerance
        self._period = period
        self._clock_ns = clock_ns
        self._publish = publish
        self._log_error = log_error
        self.given, self.measured = 0.0, math.nan
        self.deviates = False
        self.complaints = 0
        self.last_complaint = self.failure = ""
        self._checked = -math.inf
        self._stopping = False
        self._deadline = math.inf
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
        """Whether the thread has ended: the output is off, or :meth:`end` was called."""
        return not self._thread.is_alive()

    def wake(self) -> None:
        """Wake the thread for a new command."""
        self._woken.set()

    def stop(self) -> bool:
        """Switch off; returns whether the instrument confirms it within a few seconds.

        The time limit counts from the first call. Without confirmation, the thread keeps trying.
        """
        now = time.monotonic()
        if not self._stopping:
            self._supply.patience.end = now + _LAST_ANSWER
            self._deadline = now + _STOP
            self._stopping = True
            self._woken.set()
        self._thread.join(max(self._deadline - now, 0.0))
        if not self.finished and not self.failure:
            self.failure = "the supply does not answer"
        return self.finished and not self._supply.switched_on

    def end(self) -> None:
        """Stop trying to switch off, and end the thread."""
        self._ended.set()
        self._supply.patience.end = 0.0
        self._thread.join(1.0)

    def _run(self) -> None:
        try:
            if not self.failure:
                self._follow()
        except Exception as error:  # whatever the error, the current must not stay on
            self.failure = (
                str(error)
                if isinstance(error, (LinkLostError, SupplyError))
                else f"driving the supply failed: {error}"
            )
            self._log_error(f"{self.failure}: trying to switch the output off")
        while self._supply.switched_on and not self._ended.is_set():
            try:
                self._supply.rescue()
            except Exception:  # after any error, as above
                self._ended.wait(_RETRY_PERIOD)

    def _follow(self) -> None:
        due = time.monotonic()
        while not self._stopping:
            self._woken.clear()
            now = time.monotonic()
            self._obey(now)
            if now >= due:
                asked_ns = self._clock_ns()
                self.measured = self._supply.measured()
                if abs(self.measured - self.given) <= self._tolerance:
                    self._agreed = now
                self.deviates = now - self._agreed > _SETTLING
                self._publish((asked_ns + self._clock_ns()) // 2, self.measured)
                # The answer may have taken long.
                self._obey(time.monotonic())
                self._check(now)
                due = max(due + self._period, time.monotonic())
            now = time.monotonic()
            self._woken.wait(max(min(due - now, self._commander.wait(now)), 0.0))
        self.given = 0.0
        self._supply.switch_off()

    def _obey(self, now: float) -> None:
        self.given = self._commander.step(now)
        self._supply.give(self.given)

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
