"""An emulated supply with a coil on it, which speaks SCPI.

What it measures follows from what it was told, by way of the coil's inductance; it complains in a
queue of errors, and has a watchdog.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable

from mr_damper_ros.rig.supplies.scpi_link import LinkLostError

_YES = {"ON": True, "1": True, "OFF": False, "0": False}


class EmulatedInstrument:
    """One output on a coil of ``time_constant`` [s], up to ``largest_current`` [A].

    ``clock`` gives seconds. It may be used by several threads.
    """

    def __init__(
        self,
        time_constant: float = 0.02,
        largest_current: float = 5.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._time_constant = time_constant
        self._largest = largest_current
        self._clock = clock
        self._lock = threading.Lock()
        self._errors: deque[str] = deque()
        self._set = 0.0
        self._on = False
        self._tripped = False
        self._watched, self._delay = False, 60.0
        self._coil = 0.0
        self._at = self._heard = clock()

    def current(self) -> float:
        """The current in the coil now [A]."""
        with self._lock:
            self._advance(self._clock())
            return self._coil

    @property
    def is_off(self) -> bool:
        """Whether the output is off, by a command or by the watchdog."""
        with self._lock:
            self._advance(self._clock())
            return not self._on or self._tripped

    def hear(self, line: str) -> str | None:
        """Take in a line; returns the answer, None where there is none."""
        with self._lock:
            now = self._clock()
            self._advance(now)
            self._heard = now
            return self._obey(line.strip().upper())

    def _obey(self, line: str) -> str | None:
        command, _, argument = line.partition(" ")
        if command.endswith("?"):
            return self._answer(command)
        if command in ("CURR", "VOLT", "VOLT:LIM", "OUTP:PROT:WDOG:DEL"):
            self._set_number(command, argument)
        elif command in ("OUTP", "OUTP:PROT:WDOG") and argument in _YES:
            if command == "OUTP":
                self._on = _YES[argument]
            else:
                self._watched = _YES[argument]
        elif command == "OUTP:PROT:CLE":
            self._tripped = False
        elif command == "*CLS":
            self._errors.clear()
        elif (command, argument) != ("FUNC", "CURR"):
            self._complain('-113,"Undefined header"')
        return None

    def _answer(self, command: str) -> str | None:
        if command == "SYST:ERR?":
            return self._errors.popleft() if self._errors else '+0,"No error"'
        answers = {
            "*IDN?": "mr_damper_ros,emulated instrument,0,0",
            "CURR?": f"{self._set:.4f}",
            "OUTP?": str(int(self._on)),
            "MEAS:CURR?": f"{self._coil:.4E}",
        }
        if command not in answers:
            self._complain('-113,"Undefined header"')
        return answers.get(command)

    def _set_number(self, command: str, argument: str) -> None:
        try:
            value = float(argument)
        except ValueError:
            self._complain('-104,"Data type error"')
            return
        if command == "CURR":
            if not 0.0 <= value <= self._largest:
                self._complain('-222,"Data out of range"')
                return
            self._set = value
        elif command == "OUTP:PROT:WDOG:DEL":
            if not 0.0 < value <= 3600.0:
                self._complain('-222,"Data out of range"')
                return
            self._delay = value

    def _complain(self, error: str) -> None:
        if len(self._errors) >= 10:  # the last place says that there were more
            self._errors[-1] = '-350,"Queue overflow"'
        else:
            self._errors.append(error)

    def _advance(self, now: float) -> None:
        """Let the coil follow up to now, and the watchdog bite where it was due."""
        due = self._heard + self._delay
        if self._on and self._watched and not self._tripped and now > due:
            self._follow(due)
            self._tripped = True
        self._follow(now)

    def _follow(self, now: float) -> None:
        wanted = self._set if self._on and not self._tripped else 0.0
        elapsed, self._at = max(now - self._at, 0.0), max(now, self._at)
        self._coil = wanted + (self._coil - wanted) * math.exp(-elapsed / self._time_constant)


class EmulatedLink:
    """A link to an emulated instrument in this process."""

    def __init__(self, instrument: EmulatedInstrument) -> None:
        self._instrument = instrument

    def write(self, line: str) -> None:
        """Send a line that is not answered."""
        self._instrument.hear(line)

    def query(self, line: str) -> str:
        """Send a line and return the answer to it."""
        answer = self._instrument.hear(line)
        if answer is None:
            raise LinkLostError(f"the emulated instrument does not answer {line}")
        return answer

    def close(self) -> None:
        """Let the instrument go."""
