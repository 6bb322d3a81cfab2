"""Time until the coil is without current after a failure of the node, the commander or the link.

An emulated instrument with a coil of 20 ms runs behind a real TCP socket. The node `supply` and a
commander that commands 1 A are separate processes. An instrument that never completes its answers
is used without a watchdog and with the default settings of the node; its slow answers begin at any
time from half a second before to half a second after the death of the commander.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from benchmarks.figure import Measured
from benchmarks.instrument_server import InstrumentServer
from benchmarks.nodes import Nodes
from mr_damper_ros.emulation.instrument import EmulatedInstrument
from mr_damper_ros.processes.programs import PATIENCE, Program

_CURRENT, _NONE = 1.0, 0.02
_WATCHDOG, _TIMEOUT, _LINK = 0.5, 0.3, 0.3

EVENTS = (
    *("node_killed", "node_frozen", "link_dead", "link_cut"),
    *("commander_killed", "commander_frozen"),
)

_DRIBBLE = 0.2
"""Time [s] between two bytes of an answer that never ends."""


class _Rig(Nodes):
    """Instrument, node and commander; programs that have died are started again."""

    def __init__(self, **parameters: object) -> None:
        super().__init__()
        self.server = InstrumentServer(EmulatedInstrument(time_constant=0.02))
        self._parameters = {"address": self.server.address, **parameters}
        self.start("supply", **self._parameters)
        self._command()

    def _command(self) -> Program:
        return self.start_helper("send-current", str(_CURRENT))

    def until(self, condition: Callable[[float], bool], what: str) -> float:
        """Time [s] until the current in the coil meets the condition."""
        began = time.monotonic()
        while not condition(self.server.instrument.current()):
            if time.monotonic() - began > PATIENCE:
                raise TimeoutError(f"in vain waited for {what}: {self.errors[:5]}")
            time.sleep(0.001)
        return time.monotonic() - began

    def trial(self, event: str) -> float:
        """Time [s] from the event to zero current."""
        place, _, kind = event.partition("_")
        victim = self.programs["supply" if place == "node" else "send-current"]
        number = signal.SIGKILL if kind == "killed" else signal.SIGSTOP
        fails: dict[str, Callable[[], object]] = {
            "link_cut": self.server.cut,
            "link_dead": lambda: setattr(self.server, "deaf", True),
        }
        self.until(lambda current: current > 0.95 * _CURRENT, "the current")
        time.sleep(0.2)
        fails.get(event, lambda: victim.send_signal(number))()
        passed = self.until(lambda current: current < _NONE, "no current")
        self._mend(event)
        return passed

    def dribble(self, lead: float) -> float:
        """Time [s] from the death of the commander to zero current.

        The slow answers begin ``lead`` [s] before the death.
        """
        begin = partial(setattr, self.server, "dribble", _DRIBBLE)
        begins = threading.Timer(max(-lead, 0.0), begin)
        self.until(lambda current: current > 0.95 * _CURRENT, "the current")
        begins.start()
        time.sleep(max(lead, 0.0))
        self.programs["send-current"].kill()
        passed = self.until(lambda current: current < _NONE, "no current")
        begins.join()
        self._mend("commander and node")
        return passed

    def _mend(self, event: str) -> None:
        self.server.deaf, self.server.dribble = False, 0.0
        if event == "commander_frozen":
            self.programs["send-current"].send_signal(signal.SIGCONT)
        elif event.startswith("commander"):
            self._command()
        if not event.startswith("commander_"):
            self.programs["supply"].kill()
            self.start("supply", **self._parameters)

    def close(self) -> None:
        """End all programs."""
        for program in self.programs.values():
            program.kill()
        super().close()
        self.server.close()


def figures(trials: int = 200) -> Measured:
    """Run a total of ``trials`` of all events in turn, and a tenth as many with slow answers."""
    times: dict[str, list[float]] = {f"supply_{event}_s": [] for event in EVENTS}
    given = {"rate": 20.0, "watchdog": _WATCHDOG, "command_timeout": _TIMEOUT}
    with _Rig(profile="emulated", link_timeout=_LINK, **given) as rig:
        for place in range(trials):
            event = EVENTS[place % len(EVENTS)]
            times[f"supply_{event}_s"].append(rig.trial(event))
    with _Rig() as rig:
        leads = np.linspace(-0.5, 0.5, max(trials // 10, 3)).tolist()
        times["dribble_off_s"] = [rig.dribble(lead) for lead in leads]
    return {key: (max(found), f"Of {len(found)}.") for key, found in times.items()}
