"""An emulated supply that speaks SCPI."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable

_SWITCH = {"ON": "1", "OFF": "0"}

_DELAY, _WATCHDOG = "OUTP:PROT:WDOG:DEL", "OUTP:PROT:WDOG"


class EmulatedInstrument:
    """One output of up to 5 A on a coil of ``time_constant`` [s].

    ``clock`` returns seconds. Several threads may use the object.
    """

    def __init__(
        self, time_constant: float = 0.02, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._time_constant = time_constant
        self._clock = clock
        self._lock = threading.Lock()
        self._errors: deque[str] = deque()
        self._values = {"CURR": 0.0, "VOLT": 0.0, "VOLT:LIM": 0.0, _DELAY: 60.0}
        self._values |= {"OUTP": 0.0, _WATCHDOG: 0.0}
        self._ranges = {"CURR": (0.0, 5.0), _DELAY: (1e-3, 3600.0)}
        self._tripped = False
        self._coil = 0.0
        self._at = self._received_at = clock()

    def current(self) -> float:
        """The present current in the coil [A]."""
        with self._lock:
            self._advance(self._clock())
            return self._coil

    @property
    def is_off(self) -> bool:
        """Whether the output is off, by a command or by the watchdog."""
        with self._lock:
            self._advance(self._clock())
            return self._tripped or not self._values["OUTP"]

    def process(self, line: str) -> str | None:
        """Process a line; returns the answer, None if there is none."""
        with self._lock:
            now = self._clock()
            self._advance(now)
            self._received_at = now
            command, _, argument = line.strip().upper().partition(" ")
            answers = {
                "*IDN?": "mr_damper_ros,emulated instrument,0,0",
                "CURR?": f"{self._values['CURR']:.4f}",
                "OUTP?": f"{self._values['OUTP']:.0f}",
                "MEAS:CURR?": f"{self._coil:.4E}",
            }
            if command in answers:
                return answers[command]
            if command == "SYST:ERR?":
                return self._errors.popleft() if self._errors else '+0,"No error"'
            if command == "OUTP:PROT:CLE":
                self._tripped = False
            elif command == "*CLS":
                self._errors.clear()
            elif command in self._values:
                self._set(command, _SWITCH.get(argument, argument))
            elif command and (command, argument) != ("FUNC", "CURR"):
                self._complain('-113,"Undefined header"')
            return None

    def _set(self, command: str, argument: str) -> None:
        low, high = self._ranges.get(command, (-math.inf, math.inf))
        try:
            value = float(argument)
        except ValueError:
            self._complain('-104,"Data type error"')
            return
        if low <= value <= high:
            self._values[command] = value
        else:
            self._complain('-222,"Data out of range"')

    def _complain(self, error: str) -> None:
        if len(self._errors) >= 10:  # a full queue ends with an entry for lost errors
            self._errors[-1] = '-350,"Queue overflow"'
        else:
            self._errors.append(error)

    def _advance(self, now: float) -> None:
        """Advance the coil current to ``now``, and trip the watchdog at its due time."""
        due = self._received_at + self._values[_DELAY]
        if self._values["OUTP"] and self._values[_WATCHDOG] and not self._tripped and now > due:
            self._follow(due)
            self._tripped = True
        self._follow(now)

    def _follow(self, now: float) -> None:
        target = 0.0 if self._tripped or not self._values["OUTP"] else self._values["CURR"]
        elapsed, self._at = max(now - self._at, 0.0), max(now, self._at)
        self._coil = target + (self._coil - target) * math.exp(-elapsed / self._time_constant)
