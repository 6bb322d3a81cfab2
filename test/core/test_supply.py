"""Supplies: effects of commands, also on an instrument behind a real socket."""

import math
import os
import select
import threading
import time
import tty
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
from waiting import SetClock, until

from benchmarks.instrument_server import InstrumentServer
from mr_damper_ros.emulation.instrument import EmulatedInstrument
from mr_damper_ros.rig.commander import CommandSettings, CurrentCommander, Origin
from mr_damper_ros.rig.supplies.scpi_link import (
    DirectLink,
    LinkLostError,
    Patience,
    connect,
)
from mr_damper_ros.rig.supplies.supply import (
    ScpiSupply,
    SupplyDrive,
    SupplyError,
    SupplyProfile,
    read_profile,
)

SECOND = 10**9
TIMEOUT = 0.2
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
        (1.0, 0.6, "0.6 s old"),
        (1.0, -0.45, "0.45 s ahead, more than the tolerance of 0.05 s"),
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
        ("tested: no\nwatchdog_step: quick", "must be a positive number"),
        ("tested: no\nwatchdog_step: 0", "must be a positive number"),
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
    return ScpiSupply(
        lambda patience: connect(address, patience),
        read_profile(profile),
        voltage=12.0,
        watchdog=0.5,
        timeout=TIMEOUT,
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


@pytest.mark.parametrize("answer", ["", "nan", "9.91E+37", "-9.9E37"])
def test_what_is_no_number_is_no_measured_current(answer: str) -> None:
    instrument = EmulatedInstrument()
    link = DirectLink(lambda line: answer if line == "MEAS:CURR?" else instrument.process(line))
    profile = read_profile("emulated")
    supply = ScpiSupply(lambda _: link, profile, voltage=12.0, watchdog=0.5, timeout=TIMEOUT)
    supply.open()
    with pytest.raises(SupplyError, match="is not a current"):
        supply.measured()


def test_the_watchdog_is_set_before_there_is_current_and_armed_again_without_current(
    supply: ScpiSupply, server: InstrumentServer, clock: SetClock
) -> None:
    supply.open()
    supply.switch_on()
    assert server.lines.index("OUTP:PROT:WDOG ON") < server.lines.index("OUTP ON")
    give(supply, 1.0)
    clock.now += 0.51
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
    assert server.instrument.is_off
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
    supply.rescue()
    assert server.instrument.is_off
    assert not supply.switched_on


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


def in_thread(server: InstrumentServer, said: list[str], current: float = 1.0) -> SupplyDrive:
    """A supply without a watchdog, driven by hand."""
    supply = supply_at(server.address, "scpi")
    supply.open()
    drive = SupplyDrive(
        supply,
        CurrentCommander(CommandSettings(), current),
        tolerance=0.05,
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
    live.dribble = 0.2 * TIMEOUT
    until(lambda: live.instrument.is_off, "no output")
    assert "has not answered within" in said[0]
    assert not thread.finished, "it was not heard to be off"
    live.dribble = 0.0
    until(lambda: thread.finished, "the end of the thread")


def test_stopping_a_supply_that_answers_is_confirmed(live: InstrumentServer) -> None:
    thread = in_thread(live, [])
    gives_current(live)
    assert thread.stop()
    assert live.instrument.is_off
    assert thread.failure == ""


def test_stopping_a_supply_that_dribbles_ends_and_says_what_could_not_be_done(
    live: InstrumentServer,
) -> None:
    thread = in_thread(live, [])
    gives_current(live)
    live.dribble = 0.2 * TIMEOUT
    assert not thread.stop()
    begin = time.monotonic()
    assert not thread.stop()
    assert time.monotonic() - begin < 1.0, "the second call waits again"
    assert "has not answered within" in thread.failure
    assert live.instrument.is_off
    thread.end()
    assert thread.finished
