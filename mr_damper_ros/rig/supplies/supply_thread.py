"""The thread in which a supply is driven, until its output is off again."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

from mr_damper_ros.rig.supplies.scpi_link import LinkLostError
from mr_damper_ros.rig.supplies.scpi_supply import ScpiSupply, SupplyError
from mr_damper_ros.rig.supplies.supply_driver import SupplyDriver

_LAST_ANSWER = 1.5
"""Seconds that an instrument has to answer over its present link once it is to switch off."""

_STOP = 3.0
"""Seconds that a supply has to switch off and say so; the process has ten to end."""

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
