"""A supply that speaks SCPI, by the profile of its kind, and the thread that drives it."""

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
"""What a command may have in braces."""


class ProfileError(ValueError):
    """A profile that cannot be used; the message says what to change."""


@dataclass(frozen=True)
class SupplyProfile:
    """Lines of SCPI by what they do. A line may hold ``{current}``, ``{voltage}``, ``{seconds}``.

    ``setup`` is sent once, with the output off and no current. ``watchdog`` makes the instrument
    switch off by itself where it hears nothing for ``{seconds}``, a whole multiple of
    ``watchdog_step`` [s] of at least that; without these lines it has none. ``rearm`` makes it take
    ``output_on`` again after that. An answer to ``read_error`` that begins with ``no_error`` says
    that there are no errors (any more). ``tested`` says in a sentence what the profile was tried
    on.

    Raises ProfileError where a line has something else in braces.
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

    def __post_init__(self) -> None:
        lines = (self.set_current, self.read_current, self.output_on, self.output_off)
        for line in (*lines, self.read_error, *self.setup, *self.watchdog, *self.rearm):
            try:
                line.format(**_FILLED_IN)
            except (KeyError, IndexError, ValueError) as error:
                raise ProfileError(
                    f"the line '{line}' of the profile cannot be filled in: it may hold "
                    "{current}, {voltage} and {seconds}, and no other braces"
                ) from error
        if not (math.isfinite(self.watchdog_step) and self.watchdog_step > 0.0):
            raise ProfileError("watchdog_step of the profile must be positive [s]")

    def watchdog_delay(self, wanted: float) -> float:
        """The shortest delay [s] of the instrument's watchdog that is not below ``wanted``."""
        return max(math.ceil(wanted / self.watchdog_step - 1e-9), 1) * self.watchdog_step


def shipped_profiles() -> list[str]:
    """Names of the profiles that come with the package."""
    return sorted(path.stem for path in _FOLDER.glob("*.yaml"))


def read_profile(name: str) -> SupplyProfile:
    """The profile of a name, or of the path of a YAML file; raises ProfileError."""
    import yaml  # here: a node that has no supply does without

    path = Path(name) if name.endswith((".yaml", ".yml")) else _FOLDER / f"{name}.yaml"
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ProfileError(
            f"the profile '{name}' cannot be read: name one of {', '.join(shipped_profiles())}, or "
            "the path of a YAML file"
        ) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ProfileError(
            f"the profile '{name}' is not valid YAML: {error}".split("\n")[0]
        ) from error
    return _profile(content, name)


def _profile(content: Any, name: str) -> SupplyProfile:
    if not isinstance(content, dict):
        raise ProfileError(f"the profile '{name}' is not a table of names and lines")
    kinds = {field.name: str(field.type) for field in fields(SupplyProfile)}
    values: dict[str, Any] = {}
    for key, value in content.items():
        if key not in kinds:
            raise ProfileError(
                f"the profile '{name}' has '{key}', which is none of {', '.join(kinds)}"
            )
        if kinds[key].startswith("tuple"):
            values[key] = tuple(map(str, value if isinstance(value, list) else [value]))
        elif kinds[key] == "str":
            values[key] = str(value)
        elif isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ProfileError(f"'{key}' of the profile '{name}' must be a number [s]")
        else:
            values[key] = float(value)
    if "tested" not in values:
        raise ProfileError(f"the profile '{name}' does not say what it was tested on ('tested')")
    return SupplyProfile(**values)


_FOLDER = Path(__file__).parent / "profiles"

_MOST_ERRORS = 50
"""More than a queue of errors holds: one that never ends is no queue."""

_NOT_A_NUMBER = 9.9e37
"""What is as large stands for infinity or for no number at all (SCPI-99, volume 1, 7.2.1)."""


class SupplyError(ValueError):
    """The instrument answers, but not what it should; the message is a sentence."""


class ScpiSupply:
    """One instrument; every method raises LinkLostError where it does not answer.

    ``connect`` makes a link to it, in which each answer comes within ``timeout`` [s]. ``voltage``
    [V] is the most that it may put on the coil, ``watchdog`` [s] after how long without a line it
    shall switch off by itself, where it can.
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
        """Whether the output has been switched on, and not been heard to be off since."""

    @property
    def watchdog(self) -> float:
        """Seconds after which the instrument switches off by itself; NaN where it does not."""
        return self._delay if self._profile.watchdog else math.nan

    def open(self) -> str:
        """Connect, switch the output off and set the instrument up; returns what it calls itself.

        Raises SupplyError where it does not understand that.
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
        """Switch the output on, at no current; raises SupplyError where the instrument objects."""
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
        """Take the current away and switch the output off, and see that this was heard."""
        self._given = ""
        self.give(0.0)
        self._write(self._profile.output_off)
        # An answer says that the lines before it have come. What is complained of may be older.
        if self.errors():
            self._write(self._profile.output_off)
            self._require_no_errors("switching the output off")
        self.switched_on = False

    def give(self, current: float) -> None:
        """Set the current [A], unless it is set already."""
        line = self._profile.set_current.format(current=current)
        if line != self._given:
            self._write(line)
            self._given = line

    def measured(self) -> float:
        """The current [A] that the instrument measures; raises SupplyError where that is none."""
        answer = self._query(self._profile.read_current)
        try:
            value = float(answer)
        except ValueError:
            value = math.nan
        if not abs(value) < _NOT_A_NUMBER:
            raise SupplyError(
                f"the supply answers '{answer[:80]}' to {self._profile.read_current}, which is "
                "not a current: does the profile fit it?"
            )
        return value

    def next_error(self) -> str:
        """The oldest in the instrument's queue of errors; empty where there is none."""
        answer = self._query(self._profile.read_error)
        return "" if answer.startswith(self._profile.no_error) else answer

    def errors(self) -> list[str]:
        """All that waits in the instrument's queue of errors."""
        found: list[str] = []
        while len(found) < _MOST_ERRORS:
            error = self.next_error()
            if not error:
                return found
            found.append(error)
        raise SupplyError(
            f"the supply's queue of errors does not end: {found[-1][:80]} again and again to "
            f"{self._profile.read_error}; does the profile fit it?"
        )

    def rescue(self) -> None:
        """Switch the output off over a new link, however little time the old one was given."""
        self.patience.end = math.inf
        with suppress(LinkLostError):  # of the old one, which is given up
            self.close()
        self._link = self._connect(self.patience)
        self.switch_off()

    def close(self) -> None:
        """Let the instrument go, as it is."""
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

    def _query(self, line: str) -> str:
        return self._linked().query(line)

    def _linked(self) -> ScpiLink:
        if self._link is None:
            raise LinkLostError("there is no link to the supply")
        return self._link


_SETTLING = 1.0
"""Seconds that a coil and a supply may take to reach a new current, and between two looks into the
instrument's queue of errors."""


class SupplyDriver:
    """A supply under command; times are seconds of one steady clock.

    ``given`` and ``measured`` are currents [A]; the supply ``deviates`` where they differ by more
    than the ``tolerance`` [A] for too long. What the supply raises passes through: whoever drives
    it then has to see that it is off.
    """

    def __init__(self, supply: ScpiSupply, commander: CurrentCommander, tolerance: float) -> None:
        self.supply = supply
        self._commander = commander
        self._tolerance = tolerance
        self._agreed = math.inf
        self._asked = -math.inf
        self.given, self.measured = 0.0, math.nan
        self.deviates = False
        self.complaints = 0
        self.last_complaint = ""
        self.wait = commander.wait

    def start(self, now: float) -> None:
        """Switch on, at no current."""
        self._agreed = now
        self.supply.switch_on()
        self._commander.start(now)

    def obey(self, now: float) -> None:
        """Set the current that is to be given now."""
        self.given = self._commander.step(now)
        self.supply.give(self.given)

    def read(self, now: float) -> float:
        """The measured current [A]."""
        self.measured = self.supply.measured()
        if abs(self.measured - self.given) <= self._tolerance:
            self._agreed = now
        self.deviates = now - self._agreed > _SETTLING
        return self.measured

    def check(self, now: float) -> None:
        """Read one of the instrument's complaints, now and then, and while there are more."""
        if now - self._asked < _SETTLING:
            return
        complaint = self.supply.next_error()
        if complaint:
            self.complaints += 1
            self.last_complaint = complaint
        else:
            self._asked = now


_STOP = 3.0
"""Seconds that a supply has to switch off and say so; the process has ten to end."""

_LAST_ANSWER = 0.5 * _STOP
"""Seconds that an instrument has to answer over its present link once it is to switch off."""

_RESCUE = 0.5
"""Seconds between two attempts to switch off a supply that does not answer."""


class SupplyThread:
    """Drives a supply that is on; where that fails, or it is stopped, it switches it off.

    Where an instrument does not answer, it is told again and again over a new link to switch off,
    until it has confirmed that, or :meth:`end` is called. ``failure`` says in a sentence why the
    supply is driven no more; given at the start, the supply is only switched off. ``publish`` is
    given each measured current [A] with its time [ns] on the clock ``clock_ns``; ``say`` is given
    what has gone wrong.
    """

    def __init__(
        self,
        driver: SupplyDriver,
        *,
        period: float,
        clock_ns: Callable[[], int],
        publish: Callable[[int, float], None],
        say: Callable[[str], object],
        failure: str = "",
    ) -> None:
        self.driver = driver
        self.failure = failure
        self._supply = driver.supply
        self._period = period
        self._clock_ns = clock_ns
        self._publish = publish
        self._say = say
        self._stopping = False
        self._deadline = math.inf
        self._wake = threading.Event()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="supply", daemon=True)
        self._thread.start()

    @property
    def finished(self) -> bool:
        """Whether it has come to its end: the output is off, or it was told to end."""
        return not self._thread.is_alive()

    def hurry(self) -> None:
        """There is something new to obey."""
        self._wake.set()

    def stop(self) -> bool:
        """Switch off; returns whether the output was heard to be off within some seconds.

        They count from the first call. Where it was not, the thread goes on trying.
        """
        now = time.monotonic()
        if not self._stopping:
            self._supply.patience.end = now + _LAST_ANSWER
            self._deadline = now + _STOP
            self._stopping = True
            self._wake.set()
        self._thread.join(max(self._deadline - now, 0.0))
        if not self.finished and not self.failure:
            self.failure = "the supply does not answer"
        return self.finished and not self._supply.switched_on

    def end(self) -> None:
        """Try no more to switch off."""
        self._ended.set()
        self._supply.patience.end = 0.0
        self._thread.join(1.0)

    def _run(self) -> None:
        try:
            if not self.failure:
                self._follow()
        except Exception as error:  # whatever it is: the current must not stay on
            self.failure = (
                str(error)
                if isinstance(error, (LinkLostError, SupplyError))
                else f"driving the supply failed: {error}"
            )
            self._say(f"{self.failure}: trying to switch the output off")
        while self._supply.switched_on and not self._ended.is_set():
            try:
                self._supply.rescue()
            except Exception:  # whatever it is, as above
                self._ended.wait(_RESCUE)

    def _follow(self) -> None:
        due = time.monotonic()
        while not self._stopping:
            self._wake.clear()
            now = time.monotonic()
            self.driver.obey(now)
            if now >= due:
                asked_ns = self._clock_ns()
                measured = self.driver.read(now)
                self._publish((asked_ns + self._clock_ns()) // 2, measured)
                # An answer may have taken long.
                self.driver.obey(time.monotonic())
                self.driver.check(now)
                due = max(due + self._period, time.monotonic())
            now = time.monotonic()
            self._wake.wait(max(min(due - now, self.driver.wait(now)), 0.0))
        self.driver.given = 0.0
        self._supply.switch_off()
