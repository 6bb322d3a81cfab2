"""The source `stream`: data from senders, and every fault that can occur."""

import itertools
import math
import os
import random
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from streamed import START, Streamed, source_of
from waiting import until

from mr_damper_ros.data_check.findings import Kind
from mr_damper_ros.rig.blocks import BlockMaker, Measured
from mr_damper_ros.rig.sources.device_source import (
    CountedRows,
    DeviceReader,
    HostClock,
    Portions,
    Row,
    StampedRows,
)
from mr_damper_ros.rig.sources.stream_source import (
    CHECKS,
    LineDecoder,
    RecordDecoder,
    SimulatedSender,
    parse_row_format,
)

TIMED = "time:us,displacement:mm,force:-1*N"
MILLISECOND = 1_000_000


def lines(first: int, count: int) -> bytes:
    """Samples at 1 kHz: the displacement counts micrometres, the force newtons."""
    return b"".join(
        b"%d, %.3f, %d\n" % (1000 * k, 1e-3 * k, -k) for k in range(first, first + count)
    )


@pytest.fixture
def stream() -> Iterator[Callable[..., Streamed]]:
    made: list[Streamed] = []

    def start(address: str, columns: str = TIMED) -> Streamed:
        made.append(Streamed("stream", address=address, columns=columns))
        return made[-1]

    yield start
    for each in made:
        each.source.close()


def up_to(running: Streamed, force: float) -> Callable[[], bool]:
    return lambda: bool(running.blocks) and running.blocks[-1].force[-1] >= force


class Sender:
    """A server that passes each connection to the next of ``acts``, in a separate thread."""

    def __init__(self, *acts: Callable[[socket.socket], None]) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp:127.0.0.1:{self._server.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve, args=(acts,), daemon=True)
        self._thread.start()

    def _serve(self, acts: tuple[Callable[[socket.socket], None], ...]) -> None:
        for act in acts:
            connection, _ = self._server.accept()
            with closing(connection):
                try:
                    act(connection)
                except OSError:
                    return

    def close(self) -> None:
        self._server.close()


@pytest.fixture
def serve() -> Iterator[Callable[..., str]]:
    senders: list[Sender] = []

    def start(*acts: Callable[[socket.socket], None]) -> str:
        senders.append(Sender(*acts))
        return senders[-1].address

    yield start
    for sender in senders:
        sender.close()


def sends(*parts: bytes) -> Callable[[socket.socket], None]:
    """Send these and stay connected until the peer disconnects."""

    def act(connection: socket.socket) -> None:
        for part in parts:
            connection.sendall(part)
        connection.recv(1)

    return act


# -- real links --------------------------------------------------------------------------------


def test_datagrams_are_lines_of_one_sender(stream: Callable[..., Streamed]) -> None:
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    running = stream(f"udp:127.0.0.1:{port}")
    with (
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sender,
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as other,
    ):
        numbers = itertools.count(0, 5)

        def sent() -> bool:
            for k in itertools.islice(numbers, 2):
                sender.sendto(lines(k, 5).rstrip(), ("127.0.0.1", port))
                other.sendto(lines(10**6 + k, 5), ("127.0.0.1", port))
            return len(running.blocks) >= 20

        running.until(sent)
    # Samples of the other connection would be a million further on.
    assert np.ptp(running.joined("force")) < 10_000


def test_lines_come_over_a_serial_line_that_is_joined_in_the_middle_of_one_and_unplugged(
    stream: Callable[..., Streamed],
) -> None:
    pytest.importorskip("serial")
    master, slave = os.openpty()
    name = os.ttyname(slave)
    running = stream(f"serial:{name}")
    running.until(lambda: running.source.state().values["connections"] > 0)
    # The end of "1007, 1, 2"; as a line of its own it would be another sample.
    os.write(master, b"7, 1, 2\n")
    parts = iter(range(0, 1000, 50))

    def written() -> bool:
        if (first := next(parts, None)) is not None:
            os.write(master, lines(first, 50))
        return up_to(running, 980.0)()

    running.until(written)
    assert (np.diff(running.joined("force")) == 1.0).all()
    os.close(slave)
    os.close(master)
    running.until(lambda: name in running.fault)


def test_a_link_that_is_cut_is_made_again_and_leaves_a_gap(
    serve: Callable[..., str], stream: Callable[..., Streamed]
) -> None:
    def cut(connection: socket.socket) -> None:
        connection.sendall(lines(0, 1000) + b"1000000, 1.0")

    address = serve(cut, sends(lines(3000, 1000)))
    running = stream(address)
    running.until(up_to(running, 3980))
    force = running.joined("force")
    np.testing.assert_allclose(running.joined("displacement"), 1e-6 * force, atol=1e-12)
    # The stamps give the length of the gap; samples waiting for others may be lost with it.
    assert ((np.diff(force) == 1.0) | (np.diff(force) > 1900.0)).all()
    assert len(set((force - running.numbers()).tolist())) == 1
    assert running.blocks[0].period == pytest.approx(1e-3, rel=1e-9)
    assert running.source.settings.address == address


def test_who_is_not_there_is_told_and_waited_for(stream: Callable[..., Streamed]) -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        port = server.getsockname()[1]
    running = stream(f"tcp:127.0.0.1:{port}")
    running.until(lambda: "Connection refused" in running.fault)
    with closing(socket.create_server(("127.0.0.1", port))) as server:
        connection, _ = server.accept()
        with closing(connection):
            connection.sendall(lines(0, 1000))
            running.until(lambda: running.samples > 0)


def test_an_address_that_is_taken_is_told(stream: Callable[..., Streamed]) -> None:
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as taken:
        taken.bind(("127.0.0.1", 0))
        running = stream(f"udp:127.0.0.1:{taken.getsockname()[1]}")
        running.until(lambda: "Address already in use" in running.fault)


@pytest.mark.parametrize(
    "options",
    [
        {"columns": "time:us,displacement:mm,-,force:-2*kN,current:mA"},
        {
            "columns": "count:16,displacement:mm,force:N,temperature:degC",
            "layout": "<HffxB",
            "mark": "AA55",
            "check": "crc16",
            "rate": 500.0,
        },
    ],
)
def test_the_simulated_sender_keeps_to_any_format(options: dict[str, Any]) -> None:
    form = parse_row_format(options["columns"])
    layout, mark, check = (options.get(name, "") for name in ("layout", "mark", "check"))
    rate = options.get("rate", math.nan)
    sender = SimulatedSender(form, rate, layout, bytes.fromhex(mark), check or "none")
    decoder: LineDecoder | RecordDecoder = (
        RecordDecoder(form, layout, bytes.fromhex(mark), check) if layout else LineDecoder(form)
    )
    decoder.begin(whole=True)
    rows = decoder.feed(b"".join(sender.row(k) for k in range(2000)))
    assert len(rows) == 2000
    assert all(row is not None for row in rows)
    quarter = rows[125 if layout else 250]
    assert quarter.measured.displacement == pytest.approx(0.005, abs=1e-7)
    assert rows[0].measured.force == pytest.approx(1000.0 * math.tanh(3.0), rel=1e-6)


def test_a_stream_may_be_simulated(stream: Callable[..., Streamed]) -> None:
    running = stream("simulated")
    running.until(lambda: len(running.blocks) >= 3)
    assert running.blocks[0].period == pytest.approx(1e-3, rel=1e-6)


# -- received data -----------------------------------------------------------------------------


def test_a_sender_of_garbage_is_told_and_given_nothing(
    serve: Callable[..., str], stream: Callable[..., Streamed]
) -> None:
    running = stream(serve(sends(random.Random(1).randbytes(100_000), b"\n")))
    running.until(lambda: "cannot be read as" in running.fault)
    assert running.blocks == []


def test_lines_that_end_by_carriage_returns_only_are_named(
    serve: Callable[..., str], stream: Callable[..., Streamed]
) -> None:
    running = stream(serve(sends(lines(0, 1000).replace(b"\n", b"\r"))))
    running.until(lambda: "without a line feed, but with carriage returns" in running.fault)
    assert running.blocks == []


def test_carriage_returns_before_line_feeds_are_no_fault(
    serve: Callable[..., str], stream: Callable[..., Streamed]
) -> None:
    rows = lines(0, 1000).replace(b"\n", b"\r\n")
    running = stream(serve(sends(rows[:5000], rows[5000:])))
    running.until(up_to(running, 980.0))
    assert running.fault == ""


def test_a_rate_far_from_the_stated_one_is_named_before_it_is_measured() -> None:
    rows = CountedRows(500.0)
    for k in range(100):
        rows.add(None, 1_000_000 * k)
    assert rows.being_checked
    assert rows.finding(math.nan, math.nan) is None
    assert rows.finding(505.0, math.nan) is None
    found = rows.finding(1000.0, math.nan)
    assert found is not None
    assert found.kind is Kind.WRONG_RATE


def test_garbage_between_lines_costs_no_more_than_what_it_hits(
    serve: Callable[..., str], stream: Callable[..., Streamed]
) -> None:
    rng = random.Random(2)
    parts = []
    for k in range(0, 2000, 100):
        parts += [lines(k, 100), rng.randbytes(30).replace(b"\n", b"") + b"\n", b"nan,nan,nan\n"]
    running = stream(serve(sends(*parts)))
    running.until(up_to(running, 1980))
    assert (np.diff(running.joined("force")) == 1.0).all()


def test_a_line_without_end_takes_no_room() -> None:
    decoder = LineDecoder(parse_row_format(TIMED))
    decoder.begin(whole=True)
    rows = [row for _ in range(1000) for row in decoder.feed(b"1" * 4096)]
    assert rows == [None]
    assert decoder.feed(b"\n0,1,2\n") == [Row(Measured(1e-3, -2.0), None, 0.0)]


def test_a_sender_that_floods_is_held_up_and_nothing_grows() -> None:
    brought = []

    def flood() -> Portions[bytes]:
        yield None
        while True:
            brought.append(1)
            yield b"0,1,2\n"

    reader = DeviceReader(flood, "a flood")
    until(lambda: len(brought) == 257, "256 that wait, and one in hand")
    time.sleep(0.2)
    assert len(brought) == 257
    assert len(reader.take()) == 256
    reader.close()


def test_a_driver_that_fails_in_a_way_of_its_own_is_told_and_tried_again() -> None:
    tried = []

    def connect() -> Any:
        tried.append(1)
        raise KeyError("Dev1")

    reader: DeviceReader[bytes] = DeviceReader(connect, "the device")
    until(lambda: len(tried) >= 2, "another try")
    assert reader.fault == "no connection to the device: KeyError: 'Dev1'"
    reader.close()


def test_the_clock_of_this_computer_may_be_set_and_stamps_follow_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = {"steady": 100, "wall": 10**18}
    clocks = SimpleNamespace(monotonic_ns=lambda: now["steady"], time_ns=lambda: now["wall"])
    monkeypatch.setattr("mr_damper_ros.rig.sources.device_source.time", clocks)
    clock = HostClock(START)
    assert 100 + clock.ahead_ns == START
    now = {"steady": 10**9 + 100, "wall": 10**18 + 10**9 + 500_000}
    assert not clock.was_set(), "half a millisecond is no step"
    now["wall"] += 3600 * 10**9
    assert clock.was_set()
    assert 10**9 + 100 + clock.ahead_ns == pytest.approx(START + 3601 * 10**9, abs=10**6)
    assert not clock.was_set()


# -- formats -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "force"),
    [
        (b"0,1.5,-7\r\n", 7.0),
        (b"0; 1.5 ;-7\n", 7.0),
        (b"0\t1.5\t-7\n", 7.0),
        (b"  0 1.5   -7e0\n", 7.0),
        (b"0,1.5\n", None),
        (b"0,,1.5,-7\n", None),
        (b"0,1.5,-7,8\n", None),
        (b"0,1.5,nan\n", None),
        (b"0,1e400,-7\n", None),
        (b"0,1.5,1e300\n", None),
        (b"-5,1.5,-7\n", None),
        (b"0,1.5,\xff\n", None),
    ],
)
def test_a_line_is_read_or_refused(line: bytes, force: float | None) -> None:
    decoder = LineDecoder(parse_row_format(TIMED))
    decoder.begin(whole=True)
    (row,) = decoder.feed(line)
    assert (row and row.measured.force) == force


@pytest.mark.parametrize(
    ("cell", "number"), [(b"12.000000", 12), (b" 120. ", 120), (b"12.5", None)]
)
def test_a_count_may_be_written_with_a_point(cell: bytes, number: int | None) -> None:
    row = parse_row_format("count:64,displacement:mm,force:N").row([cell, b"2", b"500"])
    assert (None if row is None else row.number) == number


LAYOUT = "<HffxB"
RECORDS = "count:16,displacement:mm,force:N,-"


def record(k: int, check: str = "crc16", mark: bytes = b"\xaa\x55") -> bytes:
    data = mark + struct.pack(LAYOUT, k % 2**16, float(k), -2.0 * k, 9)
    return data + CHECKS[check](data)


def records(check: str = "crc16") -> RecordDecoder:
    decoder = RecordDecoder(parse_row_format(RECORDS), LAYOUT, b"\xaa\x55", check)
    decoder.begin(whole=False)
    return decoder


def numbers(rows: list[Row | None]) -> list[int | None]:
    return [row.number for row in rows if row is not None]


@pytest.mark.parametrize("check", list(CHECKS))
def test_records_are_found_wherever_one_begins_to_listen(check: str) -> None:
    data = b"".join(record(k, check) for k in range(20))
    for begin in range(1, 12):
        decoder = records(check)
        rows = [row for at in range(begin, len(data), 7) for row in decoder.feed(data[at : at + 7])]
        assert numbers(rows) == list(range(1, 20))


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 999), st.binary(max_size=20)), max_size=5))
def test_no_record_is_made_of_garbage_in_between(hits: list[tuple[int, bytes]]) -> None:
    data = b"".join(record(k) for k in range(100))
    for at, noise in hits:
        data = data[:at] + noise + data[at + 3 :]
    rows = [row for row in records().feed(data) if row is not None]
    assert [row.measured.force for row in rows] == [-2.0 * (row.number or 0) for row in rows]
    # A hit damages two records at most, and hides two more that begin in what looks like a mark.
    assert len(rows) >= 100 - 4 * len(hits)


# -- stamps ------------------------------------------------------------------------------------


def stamped(rows: StampedRows, times: Iterator[float] | list[float]) -> list[int]:
    """Numbers of the samples from rows with these times [s], which arrive at once."""
    return [
        number
        for k, at in enumerate(times)
        for number, _, _ in rows.timed(Row(Measured(0.0, float(k)), None, at), k * MILLISECOND)
    ]


def test_a_counter_of_microseconds_may_begin_at_0_again() -> None:
    rows = StampedRows(1e-6)
    begin = 2**32 - 500_000
    found = stamped(rows, [((begin + 1000 * k) % 2**32) * 1e-6 for k in range(1000)])
    assert found[-1] - found[0] == len(found) - 1
    assert len(found) > 950
    assert rows.counts["wrong stamps"] == 0


def test_a_wrong_stamp_costs_one_sample() -> None:
    rows = StampedRows(1e-6)
    times = [1e-3 * k for k in range(1000)]
    times[500] = 4e3
    found = stamped(rows, times)
    assert sorted(set(range(found[0], found[-1])) - set(found)) == [500]
    assert rows.counts["wrong stamps"] == 1


def test_a_wrong_unit_of_the_time_is_told() -> None:
    rows = StampedRows(1e-3)
    found = stamped(rows, [1.0 * k for k in range(40)])
    assert found == []
    assert rows.finding(math.nan, math.nan).kind is Kind.WRONG_TIME_UNIT


@given(st.sets(st.integers(0, 60), min_size=1), st.integers(1, 12))
def test_blocks_hold_what_came_and_none_has_a_gap(taken: set[int], size: int) -> None:
    maker = BlockMaker(size)
    for k in sorted(taken):
        maker.add(k, START + k, 1e-9, Measured(float(k), 2.0 * k))
    maker.cut()
    blocks = maker.take()
    held = [b.sequence + k for b in blocks for k in range(b.sample_count)]
    assert held == sorted(taken)
    assert max(block.sample_count for block in blocks) <= size
    for block in blocks:
        assert block.displacement[0] == block.sequence == block.start_ns - START
        assert math.isnan(block.current[0])


# -- invalid options ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "part"),
    [
        ({}, "stream.address is empty"),
        ({"address": "tcp:a:1"}, "stream.columns is empty"),
        ({"address": "tcp:a", "columns": TIMED}, "the address 'tcp:a' cannot be used"),
        ({"address": "tcp:a:70000", "columns": TIMED}, "cannot be used"),
        ({"address": "udp::5", "columns": TIMED}, "cannot be used"),
        ({"columns": "displacement:mm,force:N"}, "give stream.rate"),
        ({"columns": TIMED, "rate": 1000.0}, "omit one of them"),
        ({"columns": "displacement:mm,force:N", "rate": 0.5}, "must be from 1 to 100000 Hz"),
        ({"columns": "velocity:m/s,time:s,force:N"}, "a velocity does not suffice"),
        ({"columns": "count,time:s,displacement:mm,force:N"}, "only one is needed"),
        ({"columns": "count,count,displacement:mm,force:N"}, "contain count twice"),
        ({"columns": "count:12,displacement:mm,force:N"}, "a count of 12 bits"),
        ({"columns": "displacement=x:mm,force=y:N", "rate": 1e3}, "by a header"),
        ({"columns": "time:datetime,displacement:mm,force:N"}, "cannot hold dates"),
        ({"columns": "time:s,displacement:mm,force:lb"}, "'lb' is not a known unit"),
        ({"columns": TIMED, "mark": "AA"}, "stream.layout is empty"),
        ({"columns": TIMED, "layout": "fff"}, "begin with <"),
        ({"columns": TIMED, "layout": "<ff"}, "holds 2 numbers"),
        ({"columns": TIMED, "layout": "<fff", "mark": "xy"}, "is not hexadecimal"),
        ({"columns": RECORDS, "layout": "<IffB", "rate": 1e3}, "write count:32"),
        ({"columns": RECORDS, "layout": "<dffB", "rate": 1e3}, "is no integer"),
        (
            {"columns": TIMED, "layout": "<fff", "address": "serial:/dev/ttyACM0"},
            "need stream.mark or stream.check",
        ),
    ],
)
def test_what_does_not_go_together_is_said(options: dict[str, Any], part: str) -> None:
    if options and "columns" in options:
        options = {"address": "tcp:a:1", **options}
    assert part in source_of("stream", **options).settings.objection()


def test_a_sender_that_was_started_again_begins_anew() -> None:
    rows = StampedRows(1e-6)
    found = stamped(rows, [100.0 + 1e-3 * k for k in range(1000)] + [1e-3 * k for k in range(1000)])
    assert len(found) > 1900
    assert (np.diff(found) > 0).all()
