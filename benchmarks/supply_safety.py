"""Time until the coil is without current after a failure of the node, the commander or the link.

An emulated instrument with a coil of 20 ms runs behind a real TCP socket. The node `supply` and a
commander that commands 1 A are separate processes. An instrument that never completes its answers
is used without a watchdog and with the default settings of the node; its slow answers begin at any
time from half a second before to half a second after the death of the commander.

Each instrument with a fault is switched off in three ways, with the default settings of the node.
"""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable
from contextlib import closing

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from mr_damper_msgs.msg import CurrentCommand

from benchmarks.figure import Measured
from benchmarks.nodes import Nodes
from mr_damper_ros.emulation.instrument import EmulatedInstrument
from mr_damper_ros.emulation.instrument_faults import INSTRUMENT_FAULTS, InstrumentFault
from mr_damper_ros.emulation.instrument_server import InstrumentServer
from mr_damper_ros.nodes.command_topic import COMMAND_TOPIC
from mr_damper_ros.nodes.messages import header
from mr_damper_ros.processes.programs import PATIENCE, Program

_CURRENT, _NONE = 1.0, 0.02
_WATCHDOG, _TIMEOUT, _LINK = 0.5, 0.3, 0.3

EVENTS = (
    *("node_killed", "node_frozen", "link_dead", "link_cut"),
    *("commander_killed", "commander_frozen"),
)

_SOUND, _DRIBBLE = INSTRUMENT_FAULTS["none"], INSTRUMENT_FAULTS["dribble"]

MISBEHAVING = tuple(name for name in INSTRUMENT_FAULTS if name not in ("none", "deaf"))

ENDS = ("deactivated", "commander_killed", "node_terminated")
"""Ways in which an instrument with a fault must be switched off."""


def _server(fault: InstrumentFault = _SOUND) -> InstrumentServer:
    return InstrumentServer(EmulatedInstrument(time_constant=0.02), fault)


class _Rig(Nodes):
    """Instrument, node and commander; programs that have died are started again."""

    def __init__(self, **parameters: object) -> None:
        super().__init__()
        self.server = _server()
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
            "link_dead": lambda: self._break(INSTRUMENT_FAULTS["deaf"]),
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
        begins = threading.Timer(max(-lead, 0.0), self._break, [_DRIBBLE])
        self.until(lambda current: current > 0.95 * _CURRENT, "the current")
        begins.start()
        time.sleep(max(lead, 0.0))
        self.programs["send-current"].kill()
        passed = self.until(lambda current: current < _NONE, "no current")
        begins.join()
        self._mend("commander and node")
        return passed

    def off(self, fault: InstrumentFault, end: str) -> tuple[float, float, str]:
        """Time [s] to zero current or to the report that it is not, and what was wrong.

        The first time is NaN for an instrument that obeys nothing, the second one for an
        instrument whose zero is measured.
        """
        self.end("supply")
        self.server.close()
        self.server = _server(fault if fault.usable else _SOUND)
        profile = "emulated" if fault.watchdog else "scpi"
        node = self.start("supply", address=self.server.address, profile=profile)
        if "send-current" not in self.programs or not self.programs["send-current"].running:
            self._command()
        client = self.observer.node.create_client(ChangeState, "supply/change_state")
        self.observer.until(client.service_is_ready, "the node")
        self.until(lambda current: current > 0.95 * _CURRENT, "the current")
        time.sleep(0.2)
        said = len(node.errors)
        began = time.monotonic()
        self._break(fault)
        if end == "deactivated":
            transition = Transition(id=Transition.TRANSITION_DEACTIVATE)
            asked = client.call_async(ChangeState.Request(transition=transition))
            self.observer.spin_once(0.01)
        elif end == "commander_killed":
            self.programs["send-current"].kill()
        else:
            node.send_signal(signal.SIGTERM)
        gone = told = math.nan
        if fault.obeys:
            gone = self.until(lambda current: current < _NONE, "no current")
        word = "" if fault.obeys and fault.measures else "not "
        word += "measured: the coil may" if not fault.measures else "confirmed: the coil may"
        if word.startswith("not "):
            while word not in node.errors[said:]:
                self.observer.spin_once(0.01)
                if time.monotonic() - began > PATIENCE:
                    return gone, math.inf, f"not said: {node.last_words}"
            told = time.monotonic() - began
        if end == "deactivated":
            self.observer.until(asked.done, "an answer")
        if node.running:
            node.send_signal(signal.SIGTERM)
        code = node.wait()
        self.observer.node.destroy_client(client)
        lines = node.errors[said:].splitlines() or [""]
        wrong = ""
        if code != int(word.startswith("not ")):
            wrong = f"exit code {code}: {lines[-1]}"
        elif code and word not in lines[-1]:
            wrong = f"last line: {lines[-1]}"
        elif not code and any(each in node.errors for each in ("not confirmed", "not measured")):
            wrong = f"warned: {lines[-1]}"
        return gone, told, wrong

    def _break(self, fault: InstrumentFault) -> None:
        self.server.fault = fault
        if fault.cut_after:
            self.server.cut()

    def _mend(self, event: str) -> None:
        self.server.fault = _SOUND
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


def figures(trials: int = 200, names: tuple[str, ...] = MISBEHAVING) -> Measured:
    """Run ``trials`` of all events in turn, a tenth as many with slow answers, and all faults."""
    times: dict[str, list[float]] = {f"supply_{event}_s": [] for event in EVENTS}
    given = {"rate": 20.0, "watchdog": _WATCHDOG, "command_timeout": _TIMEOUT}
    with _Rig(profile="emulated", link_timeout=_LINK, **given) as rig:
        for place in range(trials):
            event = EVENTS[place % len(EVENTS)]
            times[f"supply_{event}_s"].append(rig.trial(event))
    with _Rig() as rig:
        leads = np.linspace(-0.5, 0.5, max(trials // 10, 3)).tolist()
        times["dribble_off_s"] = [rig.dribble(lead) for lead in leads]
    found: Measured = {key: (max(each), f"Of {len(each)}.") for key, each in times.items()}
    return {**found, **off_figures(names), **commander_figures()}


def off_figures(names: tuple[str, ...] = MISBEHAVING) -> Measured:
    """Switch each instrument with a fault off in each way, with the default settings."""
    gone: dict[bool, list[float]] = {False: [], True: []}
    told, wrong = [], {}
    with _Rig() as rig:
        for name in names:
            fault = INSTRUMENT_FAULTS[name]
            for end in ENDS:
                passed, said, fails = rig.off(fault, end)
                gone[fault.watchdog].append(passed)
                told.append(said)
                if fails:
                    wrong[name] = f"{name}, {end}: {fails}"
    return {
        "off_measured_s": float(np.nanmax(gone[False])),
        "off_watchdog_s": float(np.nanmax(gone[True])),
        "off_told_s": float(np.nanmax(told)),
        "off_told_right": (len(names) - len(wrong), "; ".join(wrong.values())),
    }


def commander_figures(trials: int = 5) -> Measured:
    """Let a second commander command, then the first one fall silent; default settings."""
    told, followed, handed_over = zip(*(_two_commanders() for _ in range(trials)), strict=True)
    return {
        "second_commander_told_s": (max(told), f"Of {trials}."),
        "second_commander_followed": sum(followed),
        "hand_over_s": (max(handed_over), f"Of {trials}."),
    }


def _two_commanders() -> tuple[float, bool, float]:
    """Times [s] to the refusal and to the hand-over, and whether the second one was obeyed."""
    with Nodes() as nodes, closing(_server()) as server:
        nodes.start("supply", address=server.address, profile="scpi")
        pair = _Commanders(nodes)

        def gives(current: float) -> Callable[[], bool]:
            return lambda: abs(server.instrument.current() - current) < _NONE

        pair.command({"/first": 0.5}, gives(0.5))
        both = {"/first": 0.5, "/second": 1.5}
        told = pair.command(both, lambda: "/second is refused" in pair.message)
        followed = "CURR 1.5000" in server.lines
        return told, followed, pair.command({"/second": 1.5}, gives(1.5))


class _Commanders:
    """Commanders that publish in turn, and the last message of the node about its commands."""

    def __init__(self, nodes: Nodes) -> None:
        self.message = ""
        self._nodes = nodes
        node = nodes.observer.node
        self._publisher = node.create_publisher(CurrentCommand, COMMAND_TOPIC, 10)
        nodes.observer.listen(DiagnosticArray, "/diagnostics", take=self._take)
        nodes.observer.until(self._publisher.get_subscription_count, "the node")

    def _take(self, array: DiagnosticArray) -> None:
        for status in array.status:
            if status.name == "supply: current":
                self.message = status.message

    def command(self, currents: dict[str, float], condition: Callable[[], bool]) -> float:
        """Command these currents [A] by name, 20 times a second; returns the time [s] passed."""
        observer = self._nodes.observer
        began = due = time.monotonic()
        while not condition():
            now = time.monotonic()
            if now - began > PATIENCE:
                raise TimeoutError(f"the commands {currents} had no effect: {self.message}")
            if now >= due:
                due += 0.05
                stamp = header(observer.node.get_clock().now().nanoseconds, "damper")
                for name, current in currents.items():
                    message = CurrentCommand(header=stamp, current=current, commander=name)
                    self._publisher.publish(message)
            observer.spin_once(0.002)
        return time.monotonic() - began
