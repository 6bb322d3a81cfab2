"""Supplies: effects of commands, also on an instrument behind a real socket."""

import math
import os
import select
import threading
import time
import tty
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

import pytest
from waiting import SetClock, until

from mr_damper_ros.emulation.instrument import EmulatedInstrument
from mr_damper_ros.emulation.instrument_faults import INSTRUMENT_FAULTS
from mr_damper_ros.emulation.instrument_server import InstrumentServer
from mr_damper_ros.rig.commander import CommandSettings, CurrentCommander, Origin, named
from mr_damper_ros.rig.supplies.scpi_link import (
    DirectTransport,
    LinkLostError,
    Patience,
    ScpiLink,
    connect,
)
from mr_damper_ros.rig.supplies.supply import (
    ScpiSupply,
    SupplyDrive,
    SupplyError,
    SupplyProfile,
    read_profile,
    reports_error,
)

SECOND = 10**9
NEARLY = 0.02
"""[A]: a coil after four time constants."""

TIMEOUT = 0.5
"""Timeout [s] of the links in these tests; each missing answer costs one."""

with_visa = pytest.mark.skipif(find_spec("pyvisa_py") is None, reason="PyVISA-py is missing")


# --- commands -----------------------------------------------------------------------------------


def commander(**settings: float) -> CurrentCommander:
    made = CurrentCommander(CommandSettings(**settings))
    made.start(0.0)
    return made


def test_a_command_holds_for_its_time_and_then_the_current_is_zero_at_once() -> None:
    tried = commander(command_timeout=0.5, slew_rate=1.0)
    assert tried.command(1.0, 0, 0.0, now=10.0) == ""
    tried.start(9.0)
    assert tried.step(10.0) == 1.0
    assert tried.step(10.499) == 1.0
    assert tried.step(10.5) == 0.0
    assert tried.origin(10.5) is Origin.TIMED_OUT
    # The time begins with the stamp of the command, not with its arrival.
    assert tried.command(1.0, 1, 0.3, now=20.0) == ""
    assert [tried.origin(now) is Origin.TIMED_OUT for now in (20.19, 20.21)] == [False, True]


def test_a_command_stamped_ahead_within_the_tolerance_keeps_no_other_out() -> None:
    tried = commander(stamp_tolerance=0.4)
    assert tried.command(1.0, 10 * SECOND + 4 * SECOND // 10, -0.4, now=10.0) == ""
    assert tried.command(0.3, 10 * SECOND + 1, 0.0, now=10.0) == ""
    assert tried.step(10.0) == 0.3


@pytest.mark.parametrize(
    ("current", "age", "part"),
    [
        (math.nan, 0.0, "not finite"),
        (math.inf, 0.0, "not finite"),
        (1.0, 0.6, "0.6 s behind, more than command_timeout, 0.5 s: the clocks differ"),
        (1.0, -0.45, "0.45 s ahead, more than the tolerance of 0.05 s: the clocks differ"),
        (1.0, math.nan, "command_timeout"),
    ],
)
def test_a_command_that_cannot_be_meant_is_refused(current: float, age: float, part: str) -> None:
    tried = commander(command_timeout=0.5)
    assert tried.command(0.5, 0, 0.0, now=0.0) == ""
    assert part in tried.command(current, 1, age, now=0.1)
    assert tried.step(0.1) == 0.5
    assert tried.refused == 1


def test_a_command_that_was_overtaken_is_refused_while_the_newer_one_holds() -> None:
    tried = commander(command_timeout=0.5)
    assert tried.command(1.0, 2 * SECOND, 0.0, now=0.0) == ""
    assert "older than the last one" in tried.command(0.3, SECOND, 0.1, now=0.1)
    # After a timeout, an earlier stamp means that the clock was set.
    assert tried.command(0.3, SECOND, 0.1, now=0.6) == ""


def test_one_commander_holds_the_supply_until_it_has_been_silent_for_its_time_out() -> None:
    tried = commander(command_timeout=0.5)
    assert tried.command(1.0, 0, 0.0, now=0.0, commander="/a") == ""
    for name, told in (("/b", "/b is refused"), ("", "the commander without a name is refused")):
        objection = tried.command(0.1, 1, 0.0, now=0.49, commander=name)
        assert f"/a commands at present, so {told} until /a has been silent for 0.5 s" in objection
    assert tried.step(0.49) == 1.0
    assert tried.command(0.5, 1, 0.0, now=0.5, commander="/b") == ""
    assert tried.step(0.5) == 0.5
    assert "/b commands at present" in tried.command(1.0, 2, 0.0, now=0.6, commander="/a")


def test_a_current_set_by_hand_is_not_held() -> None:
    tried = commander()
    tried.command(1.0, 0, 0.0, now=0.0, commander="/a")
    tried.set_by_hand(0.5)
    assert tried.command(0.1, 1, 0.0, now=0.1, commander="/b") == ""


def test_the_name_of_a_commander_cannot_break_a_log() -> None:
    assert named("x\n[ERROR] y" + "z" * 1000).startswith("x [ERROR] yzz")
    assert len(named("x" * 1000)) <= 100


def test_commands_are_cut_to_the_limits_and_counted() -> None:
    tried = commander(largest_current=2.0, smallest_current=-0.5)
    for given, expected in ((5.0, 2.0), (-5.0, -0.5), (1.0, 1.0)):
        assert tried.command(given, 0, 0.0, now=0.0) == ""
        assert tried.step(0.0) == expected
    assert tried.cut == 2


def test_the_current_changes_no_faster_than_the_slew_rate() -> None:
    tried = commander(slew_rate=2.0, command_timeout=10.0)
    tried.command(1.0, 0, 0.0, now=0.0)
    assert [tried.step(t) for t in (0.1, 0.2, 0.5, 0.6)] == pytest.approx([0.2, 0.4, 1.0, 1.0])
    tried.command(0.0, 1, 0.0, now=0.6)
    assert tried.step(0.85) == pytest.approx(0.5)


def test_what_is_set_by_hand_lasts_until_a_command_and_comes_back_only_by_hand() -> None:
    tried = CurrentCommander(CommandSettings(command_timeout=0.5), by_hand=0.7)
    assert tried.step(1e6) == 0.7
    tried.command(1.0, 0, 0.0, now=1e6)
    assert tried.step(1e6) == 1.0
    assert tried.step(1e6 + 1.0) == 0.0
    tried.set_by_hand(0.4)
    assert tried.step(2e6) == 0.4
    assert tried.origin(2e6) is Origin.HAND


def test_it_says_when_the_current_will_change_by_itself() -> None:
    tried = commander(slew_rate=1.0, command_timeout=2.0)
    assert tried.wait(0.0) == math.inf
    tried.command(1.0, 0, 0.0, now=0.0)
    assert 0.0 < tried.wait(0.0) < 0.1, "it ramps"
    tried.step(1.0)
    assert tried.wait(1.0) == pytest.approx(1.0), "the time-out"
    assert tried.wait(3.0) == math.inf


# --- the emulated instrument --------------------------------------------------------------------


@pytest.fixture
def clock() -> SetClock:
    return SetClock()


@pytest.fixture
def instrument(clock: SetClock) -> EmulatedInstrument:
    return EmulatedInstrument(time_constant=0.05, clock=clock)


def test_it_complains_in_a_queue_that_overflows(instrument: EmulatedInstrument) -> None:
    instrument.process("CURR 99")
    instrument.process("CURR a lot")
    for _ in range(20):
        instrument.process("NONSENSE 1")
    errors = []
    while not (error := instrument.process("SYST:ERR?") or "").startswith("+0"):
        errors.append(error[:4])
    assert errors == ["-222", "-104", *["-113"] * 7, "-350"]


# --- profiles -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("[1, 2]", "not a table"),
        ("tested: no\nset_curent: X", "entry 'set_curent': use"),
        ("set_current: X", "does not say with which instruments"),
        ("tested: no\nset_current: CURR {amps}", "of the profile is invalid"),
        ("tested: no\nset_current: CURR {", "of the profile is invalid"),
        ("tested: no\nwatchdog_step: quick", "must be a number from 0.001 to 3600 "),
        ("tested: no\nwatchdog_step: 0", "must be a number from 0.001 to 3600 "),
        ("tested: no\npause: 2", "must be a number from 0 to 1 "),
        ("a: [", "is not valid YAML"),
    ],
)
def test_a_profile_that_cannot_be_used_is_refused(tmp_path: Path, text: str, part: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=part):
        read_profile(str(path))


def test_a_profile_that_is_not_there_is_answered_with_those_that_are() -> None:
    with pytest.raises(ValueError, match="emulated, keysight_n7900, scpi"):
        read_profile("mine")


def test_a_watchdog_is_never_set_shorter_than_wanted_nor_to_a_part_of_its_step() -> None:
    profile = SupplyProfile(tested="no", watchdog_step=1.0)
    assert [profile.watchdog_delay(wanted) for wanted in (0.2, 1.0, 1.2)] == [1.0, 1.0, 2.0]


# --- a supply behind a socket -------------------------------------------------------------------


@pytest.fixture
def server(instrument: EmulatedInstrument) -> Iterator[InstrumentServer]:
    serving = InstrumentServer(instrument)
    yield serving
    serving.close()


def supply_at(address: str, profile: str = "emulated") -> ScpiSupply:
    return made_supply(partial(connect, address), profile)


def made_supply(connect: Callable[[Patience, str], ScpiLink], profile: str) -> ScpiSupply:
    return ScpiSupply(
        connect,
        read_profile(profile),
        voltage=12.0,
        watchdog=0.5,
        timeout=TIMEOUT,
        tolerance=0.05,
    )


def give(supply: ScpiSupply, current: float) -> None:
    """Set a current and wait for the instrument to receive it: lines are not acknowledged."""
    supply.give(current)
    assert supply.errors() == []


@pytest.fixture
def supply(server: InstrumentServer) -> Iterator[ScpiSupply]:
    made = supply_at(server.address)
    yield made
    made.close()


def test_it_is_off_and_without_current_until_it_is_switched_on(
    supply: ScpiSupply, server: InstrumentServer
) -> None:
    server.instrument.process("CURR 1.0")
    server.instrument.process("OUTP ON")
    assert "emulated" in supply.open()
    assert server.instrument.is_off
    supply.switch_on()
    assert not server.instrument.is_off
    assert supply.measured() == pytest.approx(0.0, abs=1e-3)


def answering(process: Callable[[str], str | None]) -> ScpiSupply:
    """A supply in this process."""
    return made_supply(
        lambda patience, identity: ScpiLink(DirectTransport(process), patience, identity), "scpi"
    )


@pytest.mark.parametrize("answer", ["nan", "9.91E+37", "-9.9E37", "OVERLOAD"])
def test_what_is_no_number_is_no_measured_current(answer: str) -> None:
    instrument = EmulatedInstrument()
    answers: dict[str, str] = {}
    supply = answering(lambda line: answers.get(line) or instrument.process(line))
    supply.open()
    answers["MEAS:CURR?"] = answer
    with pytest.raises(SupplyError, match="is not a current"):
        supply.measured()


@pytest.mark.parametrize(
    "answer",
    [
        *('0,"No error"', '+0,"No error"', "0  No Error", '00,"No error"', '0 ,"No error"', "0"),
        *("-0, ok", '"0,No error"', "0;none", "0\tNo Error", "No error", "NO_ERROR", "0.0, none"),
    ],
)
def test_the_number_0_or_the_words_mean_no_error(answer: str) -> None:
    assert not reports_error(answer)


@pytest.mark.parametrize(
    "answer",
    ['-113,"Undefined header"', "+5", "01 Bad", "0x1F,bad", "error", "10,No error code", "-100;0"],
)
def test_any_other_number_or_text_is_an_error(answer: str) -> None:
    assert reports_error(answer)


def test_the_watchdog_is_set_before_there_is_current_and_armed_again_without_current(
    supply: ScpiSupply, server: InstrumentServer, clock: SetClock
) -> None:
    supply.open()
    supply.switch_on()
    assert server.lines.index("OUTP:PROT:WDOG ON") < server.lines.index("OUTP ON")
    give(supply, 1.0)
    clock.now += 1.0
    assert server.instrument.is_off
    supply.switch_on()
    assert not server.instrument.is_off
    clock.now += 0.4
    assert supply.measured() == pytest.approx(0.0, abs=1e-3)


def test_a_profile_that_does_not_fit_is_told_at_once(
    server: InstrumentServer, tmp_path: Path
) -> None:
    path = tmp_path / "other.yaml"
    path.write_text("tested: no {…}\nsetup: ['SOUR:WHATEVER 1']", encoding="utf-8")
    with pytest.raises(SupplyError, match=r"reports an error after the set-up: -113"):
        supply_at(server.address, str(path)).open()
    path.write_text("tested: no\nrearm: ['SOUR:WHATEVER 1']", encoding="utf-8")
    supply = supply_at(server.address, str(path))
    supply.open()
    with pytest.raises(SupplyError, match="after switching the output on: -113"):
        supply.switch_on()
    assert supply.switched_on, "it must still be switched off"
    supply.close()


def test_a_cut_connection_is_a_lost_link_and_the_output_goes_off_over_a_new_one(
    supply: ScpiSupply, server: InstrumentServer, clock: SetClock
) -> None:
    supply.open()
    supply.switch_on()
    give(supply, 1.0)
    clock.now += 0.4
    supply.measured()
    server.cut()
    with pytest.raises(LinkLostError):
        supply.measured()
    assert supply.switched_on
    assert not server.instrument.is_off
    off = supply.off_sequence()

    def sleep(duration: float) -> None:
        clock.now += duration

    while not off.decided:
        supply.attempt(off, sleep)
    assert server.instrument.is_off
    assert not supply.switched_on


def test_the_output_on_at_zero_is_refused_where_there_is_a_current(
    supply: ScpiSupply, server: InstrumentServer
) -> None:
    server.instrument = EmulatedInstrument()  # in real time
    supply.open()
    server.instrument.process("CURR 1.0")
    server.fault = INSTRUMENT_FAULTS["refuses_zero"]
    with pytest.raises(SupplyError, match="is set to zero current but gives"):
        supply.switch_on()


@pytest.mark.parametrize("address", ["", "a b", "host:99999", "host:port"])
def test_an_address_that_is_none_is_refused(address: str) -> None:
    with pytest.raises(ValueError, match="give host:port"):
        connect(address, Patience(TIMEOUT))


def test_nobody_at_the_address_is_a_lost_link(server: InstrumentServer) -> None:
    server.close()
    with pytest.raises(LinkLostError, match="refused"):
        connect(server.address, Patience(TIMEOUT))


class SerialInstrument:
    """A serial instrument; ``path`` is the other end of its line."""

    def __init__(self, instrument: EmulatedInstrument) -> None:
        self._instrument = instrument
        self.dribble = False
        self._here, self._there = os.openpty()
        tty.setraw(self._here)
        tty.setraw(self._there)
        self.path = os.ttyname(self._there)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        os.close(self._here)
        os.close(self._there)

    def _serve(self) -> None:
        heard = b""
        while not self._ended.is_set():
            if not select.select([self._here], [], [], 0.01)[0]:
                continue
            heard += os.read(self._here, 1000)
            *lines, heard = heard.split(b"\n")
            for line in lines:
                answer = self._instrument.process(line.decode("ascii"))
                while self.dribble and not self._ended.wait(0.2 * TIMEOUT):
                    os.write(self._here, b"1")
                if answer is not None:
                    os.write(self._here, answer.encode("ascii") + b"\n")


@pytest.fixture
def line(instrument: EmulatedInstrument) -> Iterator[SerialInstrument]:
    serving = SerialInstrument(instrument)
    yield serving
    serving.close()


@with_visa
def test_pyvisa_reaches_the_same_instrument_over_a_serial_line(
    line: SerialInstrument, clock: SetClock
) -> None:
    pytest.importorskip("serial")
    supply = supply_at(f"ASRL{line.path}::INSTR")
    supply.open()
    supply.switch_on()
    give(supply, 1.5)
    clock.now += 0.45
    assert supply.measured() == pytest.approx(1.5, abs=1e-3)
    line.dribble = True
    with pytest.raises(LinkLostError, match=line.path):
        supply.measured()
    supply.close()


# --- in a separate thread -----------------------------------------------------------------------


@pytest.fixture
def live() -> Iterator[InstrumentServer]:
    """An instrument in real time, as a thread needs it."""
    serving = InstrumentServer(EmulatedInstrument())
    yield serving
    serving.close()


def in_thread(
    server: InstrumentServer,
    said: list[str],
    hand: CurrentCommander | None = None,
    profile: str = "scpi",
) -> SupplyDrive:
    """A supply, by default without a watchdog, driven by hand."""
    supply = supply_at(server.address, profile)
    supply.open()
    drive = SupplyDrive(
        supply,
        hand or CurrentCommander(CommandSettings(), 1.0),
        period=0.02,
        clock_ns=time.time_ns,
        publish=lambda *_: None,
        log_error=said.append,
    )
    drive.start()
    return drive


def gives_current(server: InstrumentServer) -> None:
    until(lambda: server.instrument.current() > 0.9, "the current")


def test_a_supply_that_dribbles_is_switched_off_over_a_new_link(live: InstrumentServer) -> None:
    said: list[str] = []
    thread = in_thread(live, said)
    gives_current(live)
    live.fault = replace(INSTRUMENT_FAULTS["dribble"], dribble=0.2 * TIMEOUT)
    until(lambda: live.instrument.is_off, "no output")
    assert "has not answered within" in said[0]
    assert not thread.finished, "it was not measured to be off"
    live.fault = INSTRUMENT_FAULTS["none"]
    until(lambda: thread.finished, "the end of the thread")


def test_a_setpoint_of_zero_that_is_not_followed_switches_the_output_off(
    live: InstrumentServer,
) -> None:
    said: list[str] = []
    live.fault = INSTRUMENT_FAULTS["refuses_zero"]
    hand = CurrentCommander(CommandSettings(), 1.0)
    thread = in_thread(live, said, hand)
    gives_current(live)
    hand.set_by_hand(0.0)
    thread.wake()
    until(lambda: live.instrument.is_off, "no output")
    until(lambda: thread.finished, "the end of the thread")
    assert "is set to zero current but gives 1.000 A" in said[0]


def test_a_lost_setpoint_is_sent_again(live: InstrumentServer) -> None:
    thread = in_thread(live, [])
    gives_current(live)
    live.instrument.process("CURR 0.3")  # as if the line of the thread had been lost
    gives_current(live)
    assert thread.stop()


def test_a_setpoint_that_changes_is_sent_once(live: InstrumentServer) -> None:
    hand = CurrentCommander(CommandSettings(), 0.5)
    thread = in_thread(live, [], hand)
    until(lambda: live.instrument.current() > 0.4, "the current")
    first = len(live.lines)
    for step in range(20):
        hand.set_by_hand(1.5 if step % 2 else 0.5 + 0.01 * step)
        thread.wake()
        time.sleep(0.03)
    sent = [line for line in live.lines[first:] if line.startswith("CURR")]
    assert len(sent) > 10
    assert all(a != b for a, b in pairwise(sent))
    assert thread.stop()


FAULTS = {name: fault for name, fault in INSTRUMENT_FAULTS.items() if name != "none"}


@pytest.mark.parametrize("name", FAULTS)
def test_off_is_reported_if_and_only_if_no_current_is_measured(
    live: InstrumentServer, name: str
) -> None:
    fault = FAULTS[name]
    live.fault = fault if fault.usable else INSTRUMENT_FAULTS["none"]
    thread = in_thread(live, [], profile="emulated" if fault.watchdog else "scpi")
    until(lambda: thread.measured > 0.999, "the current")
    live.fault = fault
    if fault.cut_after:
        live.cut()
    off = thread.stop()
    assert off == (fault.obeys and fault.measures)
    assert (live.instrument.current() < NEARLY) == fault.obeys
    if not fault.measures:
        assert "commanded off, not measured: the coil may still carry 1.0 A" in thread.problem
    elif not fault.obeys:
        assert "not confirmed: the coil may still carry 1.0 A" in thread.problem
    thread.end()
    assert thread.finished


@pytest.mark.parametrize(
    "name",
    [name for name, fault in INSTRUMENT_FAULTS.items() if fault.usable and not fault.refused],
)
def test_a_setpoint_of_zero_that_is_followed_slowly_switches_nothing_off(
    live: InstrumentServer, name: str
) -> None:
    live.instrument = EmulatedInstrument(time_constant=0.2)
    live.fault = INSTRUMENT_FAULTS[name]
    hand = CurrentCommander(CommandSettings(), 1.0)
    thread = in_thread(live, [], hand)
    gives_current(live)
    hand.set_by_hand(0.0)
    thread.wake()
    until(lambda: live.instrument.current() < 0.1 * NEARLY, "no current")
    assert thread.failure == ""
    assert not live.instrument.is_off
    assert thread.stop()


def test_a_second_stop_does_not_wait_again(live: InstrumentServer) -> None:
    thread = in_thread(live, [])
    gives_current(live)
    live.fault = INSTRUMENT_FAULTS["ignores"]
    assert not thread.stop()
    begin = time.monotonic()
    assert not thread.stop()
    assert time.monotonic() - begin < 1.0
    thread.end()


def test_it_goes_on_until_the_supply_is_off(live: InstrumentServer) -> None:
    said: list[str] = []
    thread = in_thread(live, said)
    gives_current(live)
    live.fault = INSTRUMENT_FAULTS["ignores"]
    assert not thread.stop()
    assert len(said) == 1
    live.fault = INSTRUMENT_FAULTS["none"]
    until(lambda: thread.finished, "the end of the thread")
    assert "it is measured to be off" in thread.problem
