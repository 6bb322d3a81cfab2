"""The supply node with an instrument behind a real socket: output on, and all ways to off."""

import signal
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import State, Transition
from mr_damper_msgs.msg import CurrentCommand, SupplyCurrent
from rosgraph_msgs.msg import Clock
from support import Listener, assert_one_sentence

from mr_damper_ros.emulation.instrument import EmulatedInstrument
from mr_damper_ros.emulation.instrument_faults import INSTRUMENT_FAULTS
from mr_damper_ros.emulation.instrument_server import InstrumentServer
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import header

NEARLY = 0.02
"""[A]: a coil after four time constants, and the resolution of a reading."""

COMMAND = "supply/current_command"


@pytest.fixture
def server() -> Iterator[InstrumentServer]:
    """Requested before ``start``, because a node that ends needs a running server."""
    serving = InstrumentServer(EmulatedInstrument())
    yield serving
    serving.close()


class Commander:
    """Commands a current ten times per time-out while the test spins."""

    def __init__(self, listener: Listener, name: str = "") -> None:
        self._node = listener.node
        self._name = name
        self._publisher = listener.node.create_publisher(
            CurrentCommand, COMMAND, quality.stream(10)
        )
        listener.until(self._publisher.get_subscription_count, "the supply's subscription")
        self.publish = self._publisher.publish
        self.current: float | None = None
        self.age = 0.0
        self._timer = listener.node.create_timer(0.03, self._send)

    def _send(self) -> None:
        if self.current is not None:
            self.send(self.current, self.age)

    def send(self, current: float, age: float = 0.0) -> None:
        now_ns = self._node.get_clock().now().nanoseconds
        self._publisher.publish(
            CurrentCommand(
                header=header(now_ns - round(1e9 * age), "damper"),
                current=current,
                commander=self._name,
            )
        )


@pytest.fixture
def supply(server: InstrumentServer, start: Any) -> Any:
    return start_supply(server, start)


def start_supply(server: InstrumentServer, start: Any, **parameters: object) -> Any:
    given: dict[str, object] = {"profile": "emulated", "command_timeout": 0.3, "watchdog": 0.5}
    return start("supply", address=server.address, rate=50.0, **{**given, **parameters})


def gives(server: InstrumentServer, current: float) -> Callable[[], bool]:
    return lambda: abs(server.instrument.current() - current) < NEARLY


def off(server: InstrumentServer) -> Callable[[], bool]:
    return lambda: server.instrument.is_off and server.instrument.current() < NEARLY


def test_it_gives_what_is_commanded_and_publishes_what_is_measured(
    supply: Any, server: InstrumentServer, listener: Listener
) -> None:
    measured = listener.listen(SupplyCurrent, "supply/current")
    commander = Commander(listener)
    commander.current = 1.2
    listener.until(gives(server, 1.2), "the current")
    listener.until(
        lambda: any(abs(message.current - 1.2) < NEARLY for message in measured),
        "a reading of the current",
    )
    found = listener.wait_for_finding("supply: current", "the current is commanded")
    assert found.level == DiagnosticStatus.OK
    commander.current = float("nan")
    listener.wait_for_finding("supply: current", "not finite")
    commander.current = None  # it is frozen
    listener.until(gives(server, 0.0), "no current after the time-out")
    listener.wait_for_finding("supply: current", "the commands have stopped")
    commander.current = 0.8
    listener.until(gives(server, 0.8), "the current of new commands")
    assert supply.stop(signal.SIGTERM) == 0
    listener.until(off(server), "no current")


def test_two_without_names_are_an_error(supply: Any, listener: Listener) -> None:
    Commander(listener).current = 0.5
    with Listener() as other:
        Commander(other).current = 0.5
        listener.until(lambda: other.spin_once(0.01) or True, "a turn")
        found = listener.wait_for_finding("supply: current", "stop all but one, or give each")
    assert found.level == DiagnosticStatus.ERROR


def test_the_second_commander_is_refused_and_told_until_the_first_is_silent(
    supply: Any, server: InstrumentServer, listener: Listener
) -> None:
    first, second = Commander(listener, "/first"), Commander(listener, "/second")
    first.current = 0.5
    listener.until(gives(server, 0.5), "the current")
    second.current = 1.5
    found = listener.wait_for_finding("supply: current", "/first commands at present, so /second")
    assert found.level == DiagnosticStatus.WARN
    assert "/second is refused until /first has been silent for 0.3 s" in supply.log
    assert not [line for line in server.lines if line == "CURR 1.5000"]
    first.current = None
    listener.until(gives(server, 1.5), "the current of the second commander")
    assert listener.change("supply", Transition.TRANSITION_DEACTIVATE)
    listener.until(off(server), "no current")


def test_stamps_of_another_clock_are_named(supply: Any, listener: Listener) -> None:
    commander = Commander(listener)
    for age, part in ((0.5, "s behind, more than"), (-0.5, "s ahead, more than")):
        # Repeated, because the supply may not have discovered the commander yet.
        commander.age, commander.current = age, 1.0
        listener.wait_for_finding("supply: current", part)
    commander.age, commander.current = 0.15, 0.2
    listener.wait_for_finding("supply: current", "so they end early: the clocks differ")


def test_the_age_of_a_command_is_by_simulated_time(
    server: InstrumentServer, start: Any, listener: Listener
) -> None:
    start_supply(server, start, use_sim_time=True)
    commander = Commander(listener)
    clock = listener.node.create_publisher(Clock, "/clock", 10)
    simulated = Clock()
    simulated.clock.sec = 100

    def stamped(offset: float) -> CurrentCommand:
        stamp = header(round(1e9 * (simulated.clock.sec + offset)), "damper")
        return CurrentCommand(header=stamp, current=0.5)

    def send() -> None:
        clock.publish(simulated)
        commander.publish(stamped(0.0))

    timer = listener.node.create_timer(0.03, send)
    listener.until(gives(server, 0.5), "the current")
    listener.node.destroy_timer(timer)
    for offset, part in ((-0.4, "s behind, more than"), (1.7e9, "set use_sim_time in both nodes")):
        commander.publish(stamped(offset))
        listener.wait_for_finding("supply: current", part)


def test_a_current_set_by_hand_is_limited_and_counts_after_a_time_out(
    server: InstrumentServer, start: Any, listener: Listener
) -> None:
    start_supply(server, start, current=0.5)
    Commander(listener).send(1.2)
    listener.until(gives(server, 1.2), "the commanded current")
    listener.until(gives(server, 0.0), "no current after the time-out")
    answer = listener.set_parameter("supply", "current", 2.5)
    assert not answer.successful
    assert "current is 2.5 A: it must lie within" in answer.reason
    assert gives(server, 0.0)()
    assert listener.set_parameter("supply", "current", 0.5).successful
    listener.until(gives(server, 0.5), "the current set by hand")


def test_the_output_is_on_only_while_the_node_is_active(
    server: InstrumentServer, start: Any, listener: Listener
) -> None:
    node = start_supply(server, start, autostart=False, current=0.5)
    listener.until(lambda: listener.state("supply") == State.PRIMARY_STATE_UNCONFIGURED, "the node")
    assert listener.change("supply", Transition.TRANSITION_CONFIGURE)
    assert server.instrument.is_off
    assert listener.change("supply", Transition.TRANSITION_ACTIVATE)
    listener.until(gives(server, 0.5), "the current")
    assert not listener.change("supply", Transition.TRANSITION_CONFIGURE)
    assert not listener.change("supply", 77)
    assert "transition number 77 is not possible in the state active" in node.log
    assert gives(server, 0.5)()
    assert listener.change("supply", Transition.TRANSITION_DEACTIVATE)
    assert server.instrument.is_off
    assert listener.change("supply", Transition.TRANSITION_ACTIVATE)
    listener.until(lambda: not server.instrument.is_off, "the output")
    assert listener.change("supply", Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert server.instrument.is_off


def test_a_current_of_before_comes_back_neither_with_activation_nor_with_configuration(
    server: InstrumentServer, start: Any, listener: Listener
) -> None:
    start_supply(server, start, current=0.5)
    listener.until(gives(server, 0.5), "the current")
    for transitions in (
        [Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE],
        [
            Transition.TRANSITION_DEACTIVATE,
            Transition.TRANSITION_CLEANUP,
            Transition.TRANSITION_CONFIGURE,
            Transition.TRANSITION_ACTIVATE,
        ],
    ):
        assert all(listener.change("supply", transition) for transition in transitions)
        del server.lines[:]
        listener.until(lambda: server.lines.count("MEAS:CURR?") > 10, "readings")
        assert not server.instrument.is_off
        assert gives(server, 0.0)()
        assert listener.set_parameter("supply", "current", 0.5).successful
        listener.until(gives(server, 0.5), "the current that is set again")


def test_after_a_cut_link_the_output_goes_off_over_a_new_one_and_stays_off(
    server: InstrumentServer, start: Any, listener: Listener
) -> None:
    start_supply(server, start, profile="scpi", current=0.7)  # it has no watchdog
    listener.until(gives(server, 0.7), "the current")
    server.cut()
    listener.until(off(server), "no current")
    listener.wait_for_finding("supply: supply", "it is measured to be off (0.0")
    assert listener.state("supply") == State.PRIMARY_STATE_INACTIVE
    assert listener.change("supply", Transition.TRANSITION_ACTIVATE)
    assert listener.set_parameter("supply", "current", 0.6).successful
    listener.until(gives(server, 0.6), "the current, once it is activated and set again")


@pytest.mark.parametrize("trouble", ["deaf", "silent"])
def test_an_instrument_that_is_not_reached_switches_off_by_itself_and_the_node_says_so(
    server: InstrumentServer, start: Any, listener: Listener, trouble: str
) -> None:
    node = start_supply(server, start, current=0.7, link_timeout=0.2)
    listener.until(gives(server, 0.7), "the current")
    server.fault = INSTRUMENT_FAULTS[trouble]
    listener.until(off(server), "no current")
    listener.wait_for_finding("supply: supply", "not measured: the coil may still carry 0.7 A")
    assert listener.state("supply") == State.PRIMARY_STATE_INACTIVE
    assert not listener.change("supply", Transition.TRANSITION_ACTIVATE), "it may still be on"
    assert node.ended_with(signal.SIGINT) == 1
    assert "the coil may still carry 0.7 A" in node.log.splitlines()[-1]


def test_a_supply_that_ignores_everything_is_said_and_gives_exit_code_1(
    server: InstrumentServer, start: Any, listener: Listener
) -> None:
    node = start_supply(server, start, profile="scpi", current=1.0)
    listener.until(gives(server, 1.0), "the current")
    server.fault = INSTRUMENT_FAULTS["ignores"]
    assert listener.change("supply", Transition.TRANSITION_DEACTIVATE)
    found = listener.wait_for_finding("supply: supply", "not confirmed: the coil may still carry 1")
    assert found.level == DiagnosticStatus.ERROR
    assert not listener.change("supply", Transition.TRANSITION_ACTIVATE), "it may still be on"
    assert node.ended_with(signal.SIGTERM) == 1
    assert "not confirmed: the coil may still carry 1.0 A" in node.log.splitlines()[-1]


def test_a_supply_that_cannot_be_switched_off_is_not_configured(
    server: InstrumentServer, start: Any
) -> None:
    server.instrument.process("CURR 2.0")
    server.instrument.process("OUTP ON")
    server.fault = INSTRUMENT_FAULTS["ignores"]
    node = start_supply(server, start, profile="scpi")
    assert node.wait() == 2
    assert_one_sentence(node.errors)
    assert "not confirmed: the coil may still carry 2.0 A" in node.errors


def test_a_supply_that_loses_lines_sent_fast_is_switched_off_at_the_start(
    server: InstrumentServer, start: Any, listener: Listener
) -> None:
    server.instrument.process("CURR 2.0")
    server.instrument.process("OUTP ON")
    server.fault = INSTRUMENT_FAULTS["loses"]
    node = start_supply(server, start, profile="scpi", autostart=False)
    assert listener.change("supply", Transition.TRANSITION_CONFIGURE)
    assert off(server)()
    assert listener.change("supply", Transition.TRANSITION_ACTIVATE)
    Commander(listener).current = 0.5
    listener.until(gives(server, 0.5), "the current")
    assert node.stop(signal.SIGINT) == 0
    assert off(server)()


def test_where_zero_is_refused_the_output_goes_off_when_the_commands_stop(
    server: InstrumentServer, start: Any, listener: Listener
) -> None:
    server.fault = INSTRUMENT_FAULTS["refuses_zero"]
    start_supply(server, start, profile="scpi")
    commander = Commander(listener)
    commander.current = 1.0
    listener.until(gives(server, 1.0), "the current")
    commander.current = None
    listener.until(off(server), "no current")
    listener.wait_for_finding(
        "supply: supply", "is set to zero current but gives 1.000 A; it is me"
    )
    assert listener.state("supply") == State.PRIMARY_STATE_INACTIVE


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_where_the_node_is_gone_or_frozen_the_watchdog_switches_off(
    server: InstrumentServer, start: Any, listener: Listener, number: signal.Signals
) -> None:
    node = start_supply(server, start, current=0.7)
    listener.until(gives(server, 0.7), "the current")
    node.send_signal(number)
    listener.until(off(server), "no current")
    if number == signal.SIGSTOP:
        node.send_signal(signal.SIGCONT)
        listener.wait_for_finding("supply: current", "instead of 0.700 A")
