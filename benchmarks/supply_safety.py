"""Time until the coil is without current after a failure of the node, the commander or the link.

An emulated instrument with a coil of 20 ms runs behind a real TCP socket. The node `supply` and a
commander that commands 1 A are separate processes. The watchdog of the instrument is set to 0.5 s,
and commands hold for 0.3 s. The benchmark measures the time from the event until the current in the
coil is below 0.02 A. A further test uses an instrument that sends its answers byte by byte and
never completes them, without a watchdog and with the default settings of the node. The slow answers
begin at any time from half a second before to half a second after the death of the commander.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
from ament_index_python.packages import get_package_prefix

from benchmarks.figure import Measured
from benchmarks.helper_programs import start_helper
from benchmarks.instrument_server import InstrumentServer
from mr_damper_ros.processes.programs import PATIENCE, Program, RosDomain, node_arguments
from mr_damper_ros.rig.supplies.scpi_link import EmulatedInstrument

_CURRENT, _NONE = 1.0, 0.02
_WATCHDOG, _TIMEOUT, _LINK = 0.5, 0.3, 0.3

_COIL = 0.1
"""Time [s] from switching off the coil to zero current: four time constants, and as much again for
a busy computer."""

LIMITS = {
    "node_killed": _WATCHDOG + _COIL,
    "node_frozen": _WATCHDOG + _COIL,
    "link_dead": _WATCHDOG + _COIL,
    "link_cut": _LINK + _COIL,
    "commander_killed": _TIMEOUT + _COIL,
    "commander_frozen": _TIMEOUT + _COIL,
}
"""Documented time limit [s] for each event."""


_DRIBBLE = 0.2
"""Time [s] between two bytes of an answer that never ends."""


class _Rig:
    """Instrument, node and commander; programs that have died are started again."""

    def __init__(self, **parameters: object) -> None:
        self._parameters = parameters
        self._domain = RosDomain()
        self._environment = self._domain.environment
        self.server = InstrumentServer(EmulatedInstrument(time_constant=0.02))
        self._path = Path(get_package_prefix("mr_damper_ros")) / "lib" / "mr_damper_ros" / "supply"
        self.node = self._start_node()
        self.commander = self._start_commander()

    def _start_node(self) -> Program:
        given = {"address": self.server.address, **self._parameters}
        return Program([str(self._path), *node_arguments(given)], self._environment)

    def _start_commander(self) -> Program:
        return start_helper("send-current", str(_CURRENT), environment=self._environment)

    def until(self, condition: Callable[[float], bool], what: str) -> float:
        """Time [s] until the current in the coil meets the condition."""
        began = time.monotonic()
        while not condition(self.server.instrument.current()):
            if time.monotonic() - began > PATIENCE:
                raise TimeoutError(f"in vain waited for {what}: {self.node.errors[-500:]}")
            time.sleep(0.001)
        return time.monotonic() - began

    def trial(self, event: str) -> float:
        """Time [s] from the event to zero current."""
        self.until(lambda current: current > 0.95 * _CURRENT, "the current")
        time.sleep(0.2)
        if event == "link_cut":
            self.server.cut()
        elif event == "link_dead":
            self.server.deaf = True
        else:
            victim = self.node if event.startswith("node") else self.commander
            kill = event.endswith("killed")
            os.kill(victim.pid, signal.SIGKILL if kill else signal.SIGSTOP)
        passed = self.until(lambda current: current < _NONE, "no current")
        self._mend(event)
        return passed

    def dribble(self, lead: float) -> float:
        """Time [s] from the death of the commander to zero current.

        The slow answers begin ``lead`` [s] before the death.
        """
        self.until(lambda current: current > 0.95 * _CURRENT, "the current")
        begins = threading.Timer(max(-lead, 0.0), lambda: setattr(self.server, "dribble", _DRIBBLE))
        begins.start()
        time.sleep(max(lead, 0.0))
        os.kill(self.commander.pid, signal.SIGKILL)
        passed = self.until(lambda current: current < _NONE, "no current")
        begins.join()
        self._mend("dribble")
        self.commander.close()
        self.commander = self._start_commander()
        return passed

    def _mend(self, event: str) -> None:
        self.server.deaf, self.server.dribble = False, 0.0
        if event.startswith("commander"):
            if event.endswith("killed"):
                self.commander.close()
                self.commander = self._start_commander()
            else:
                os.kill(self.commander.pid, signal.SIGCONT)
            return
        if self.node.running:
            os.kill(self.node.pid, signal.SIGKILL)
        self.node.close()
        self.node = self._start_node()

    def close(self) -> None:
        """End all programs."""
        for program in (self.node, self.commander):
            if program.running:
                os.kill(program.pid, signal.SIGKILL)
            program.close()
        self.server.close()
        self._domain.close()


def figures(trials: int = 200) -> Measured:
    """Run a total of ``trials`` of all events in turn, and a tenth as many with slow answers."""
    times: dict[str, list[float]] = {event: [] for event in LIMITS}
    given = {"rate": 20.0, "watchdog": _WATCHDOG, "command_timeout": _TIMEOUT}
    with closing(_Rig(profile="emulated", link_timeout=_LINK, **given)) as rig:
        for place in range(trials):
            event = list(LIMITS)[place % len(LIMITS)]
            times[event].append(rig.trial(event))
    with closing(_Rig()) as rig:
        leads = np.linspace(-0.5, 0.5, max(trials // 10, 3)).tolist()
        dribbling = [rig.dribble(lead) for lead in leads]
    within = sum(t <= LIMITS[event] for event, found in times.items() for t in found)
    return {
        "supply_off_in_time": (within / trials, f"Of {trials}."),
        **{f"supply_{event}_s": max(found) for event, found in times.items()},
        "dribble_off_s": (max(dribbling), f"Of {len(dribbling)}."),
    }
