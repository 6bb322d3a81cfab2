"""Drives a supply by commands in a thread of its own, until its output is off again."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from mr_damper_ros.rig.commander import CurrentCommander
from mr_damper_ros.rig.supplies.scpi_link import LinkLostError
from mr_damper_ros.rig.supplies.supply import ScpiSupply, SupplyError

_SETTLING = 1.0
"""Seconds that a coil and a supply may take to reach a new current, and between two looks into the
instrument's queue of errors."""


@dataclass
class SupplyState:
    """What is known of a supply that is driven: currents [A], and what it has complained of."""

    given: float = 0.0
    measured: float = math.nan
    deviates: bool = False
    complaints: int = 0
    last_complaint: str = ""


class SupplyDriver:
    """A supply under command; times are seconds of one steady clock.

    ``tolerance`` [A] is by how much the measured current may be off. What the supply raises passes
    through: whoever drives it then has to see that it is off.
    """

    def __init__(self, supply: ScpiSupply, commander: CurrentCommander, tolerance: float) -> None:
        self._supply = supply
        self._commander = commander
        self._tolerance = tolerance
        self._agreed = math.inf
        self._asked = -math.inf
        self.state = SupplyState()

    def start(self, now: float) -> None:
        """Switch on, at no current."""
        self.state = SupplyState()
        self._agreed = now
        self._supply.switch_on()
        self._commander.start(now)

    def obey(self, now: float) -> None:
        """Set the current that is to be given now."""
        given = self._commander.step(now)
        self._supply.give(given)
        self.state.given = given

    def wait(self, now: float) -> float:
        """Seconds until there is something to obey again."""
        return self._commander.wait(now)

    def read(self, now: float) -> float:
        """The measured current [A]."""
        measured = self._supply.measured()
        self.state.measured = measured
        if abs(measured - self.state.given) <= self._tolerance:
            self._agreed = now
        self.state.deviates = now - self._agreed > _SETTLING
        return measured

    def check(self, now: float) -> None:
        """Read one of the instrument's complaints, now and then, and while there are more."""
        if now - self._asked < _SETTLING:
            return
        complaint = self._supply.next_error()
        if complaint:
            self.state.complaints += 1
            self.state.last_complaint = complaint
        else:
            self._asked = now

    def stop(self) -> None:
        """Switch off."""
        self.state.given = 0.0
        self._supply.switch_off()


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
        supply: ScpiSupply,
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
        self._supply = supply
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
        self.driver.stop()
