"""The page as a client gets it: its files, its data, what it refuses, and viewers that are slow."""

from __future__ import annotations

import http.client
import json
import re
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing
from urllib.parse import urlsplit

import numpy as np
import pytest

from mr_damper_ros.live import page_server
from mr_damper_ros.live.live_record import LiveRecord
from mr_damper_ros.live.page_server import FILES, PAGE, PageServer

PATIENCE = 30.0


@pytest.fixture(scope="module")
def record() -> LiveRecord:
    made = LiveRecord()
    for number in range(100):
        made.add_signals(0.01 * number, 1e-3, 0.1, 0.5, 300.0, 290.0, valid=number % 2 == 0)
    return made


@pytest.fixture(scope="module")
def server(record: LiveRecord) -> Iterator[PageServer]:
    with closing(PageServer(record, "127.0.0.1", 0, title="/left")) as made:
        yield made


def connection(server: PageServer) -> http.client.HTTPConnection:
    parts = urlsplit(server.address)
    return http.client.HTTPConnection(parts.hostname or "", parts.port, timeout=PATIENCE)


def ask(
    server: PageServer,
    path: str,
    method: str = "GET",
    body: bytes | None = None,
    headers: dict[str, str] | None = None,
) -> tuple[http.client.HTTPResponse, bytes]:
    with closing(connection(server)) as asked:
        asked.request(method, path, body, headers or {})
        answer = asked.getresponse()
        return answer, answer.read()


@pytest.mark.parametrize("path", FILES)
def test_every_file_of_the_page_is_served(server: PageServer, path: str) -> None:
    answer, body = ask(server, path)
    assert answer.status == 200
    assert answer.headers["Content-Type"] == FILES[path][1]
    assert body == (PAGE / FILES[path][0]).read_bytes()


def test_the_page_needs_nothing_from_elsewhere(server: PageServer) -> None:
    page = ask(server, "/")[1].decode()
    asked_for = set(re.findall(r'(?:src|href)="(?!data:)([^"#]+)"', page))
    assert asked_for <= set(FILES)
    own = [name for name, _ in FILES.values() if not name.startswith("vendor/")]
    for name in own:
        text = (PAGE / name).read_text(encoding="utf-8")
        assert not re.search(r"https?://(?!www\.w3\.org/)", text), name
    assert "default-src 'self'" in ask(server, "/")[0].headers["Content-Security-Policy"]


def test_rows_are_numbers_with_their_names(server: PageServer) -> None:
    answer, body = ask(server, "/tables/signals?after=97")
    all_rows = np.frombuffer(body).reshape(-1, len(answer.headers["X-Columns"].split(",")))
    assert len(all_rows) >= 100, "the generation was not given: all rows"
    generation = answer.headers["X-Generation"]
    answer, body = ask(server, f"/tables/signals?after=97&generation={generation}")
    rows = np.frombuffer(body).reshape(-1, all_rows.shape[1])
    assert rows[:2, 0].tolist() == [98.0, 99.0]


def test_a_table_that_is_not_there_is_empty(server: PageServer) -> None:
    assert ask(server, "/tables/parameters")[0].status == 204


def test_the_status_says_what_is_shown(server: PageServer) -> None:
    told = json.loads(ask(server, "/status?windows=nonsense")[1])
    assert told["title"] == "/left"
    assert told["commands"] == []
    assert told["tables"]["signals"]["generation"] >= 1


@pytest.mark.parametrize("path", ["/etc/passwd", "/../live_record.py", "/vendor/", "/page.js/.."])
def test_nothing_else_is_served(server: PageServer, path: str) -> None:
    assert ask(server, path)[0].status == 404


def test_one_connection_serves_many_requests(server: PageServer) -> None:
    with closing(connection(server)) as asked:
        for _ in range(20):
            asked.request("GET", "/status")
            assert asked.getresponse().read()


def test_another_name_for_this_computer_is_refused(server: PageServer) -> None:
    answer, body = ask(server, "/status", headers={"Host": "elsewhere.example"})
    assert answer.status == 403
    assert b"localhost" in body


def own(server: PageServer) -> dict[str, str]:
    """What the page itself sends along."""
    netloc = urlsplit(server.address).netloc
    return {"Origin": f"http://{netloc}", "Host": netloc}


def test_without_commands_the_page_is_read_only(server: PageServer) -> None:
    answer, body = ask(server, "/command", "POST", b"reset", own(server))
    assert answer.status == 403
    assert b"allow_commands" in body


@pytest.fixture
def taken() -> list[str]:
    return []


@pytest.fixture
def commanded(record: LiveRecord, taken: list[str]) -> Iterator[PageServer]:
    def take(name: str) -> bool:
        taken.append(name)
        return len(taken) <= 1

    with closing(PageServer(record, "127.0.0.1", 0, commands=("reset",), command=take)) as made:
        yield made


def test_a_command_reaches_the_node_as_long_as_there_is_room(
    commanded: PageServer, taken: list[str]
) -> None:
    codes = [
        ask(commanded, "/command", "POST", b"reset", own(commanded))[0].status for _ in range(2)
    ]
    assert codes == [202, 503]
    assert taken == ["reset", "reset"]


@pytest.mark.parametrize(
    ("body", "headers", "status"),
    [
        (b"format", {}, 400),
        (b"", {}, 400),
        (b"x" * 2000, {}, 400),
        (b"reset", {"Origin": "http://elsewhere.example"}, 403),
        (b"reset", {"Origin": ""}, 403),
        (b"reset", {"Host": "elsewhere.example", "Origin": "http://elsewhere.example"}, 403),
    ],
)
def test_a_command_from_elsewhere_or_unknown_is_refused(
    commanded: PageServer, taken: list[str], body: bytes, headers: dict[str, str], status: int
) -> None:
    answer, _ = ask(commanded, "/command", "POST", body, {**own(commanded), **headers})
    assert answer.status == status
    assert taken == []


def test_a_viewer_that_reads_nothing_holds_up_nobody(
    server: PageServer, record: LiveRecord
) -> None:
    parts = urlsplit(server.address)
    request = f"GET /uplot.js HTTP/1.1\r\nHost: {parts.netloc}\r\n\r\n".encode()
    known = json.loads(ask(server, "/status")[1])["tables"]["signals"]["next"]
    with ExitStack() as stack:
        for _ in range(3):
            stuck = stack.enter_context(socket.socket())
            stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            stuck.connect((parts.hostname, parts.port))
            stuck.sendall(100 * request)  # five megabytes, of which it takes none
        record.add_signals(1.0, 0.0, 0.0, 0.0, 1.0, 1.0, valid=True)
        assert json.loads(ask(server, "/status")[1])["tables"]["signals"]["next"] == known + 1


def test_connections_beyond_the_limit_are_closed_and_free_places_taken_again(
    server: PageServer,
) -> None:
    with ExitStack() as stack:
        for _ in range(page_server.CONNECTIONS):
            asked = stack.enter_context(closing(connection(server)))
            asked.request("GET", "/status")
            assert asked.getresponse().read()
        with pytest.raises(ConnectionError):
            ask(server, "/status")
    deadline = threading.Event()
    for _ in range(300):
        try:
            assert ask(server, "/status")[0].status == 200
            return
        except ConnectionError:
            deadline.wait(0.1)
    pytest.fail("places that were left are not taken again")


def test_a_port_that_is_taken_is_an_error(server: PageServer, record: LiveRecord) -> None:
    port = urlsplit(server.address).port or 0
    with pytest.raises(OSError, match="in use"):
        PageServer(record, "127.0.0.1", port)


def test_it_is_gone_once_it_is_closed(record: LiveRecord) -> None:
    made = PageServer(record, "127.0.0.1", 0)
    with closing(connection(made)) as kept:
        kept.request("GET", "/status")
        assert kept.getresponse().read()
        made.close()
        with pytest.raises(ConnectionError):
            ask(made, "/")
        kept.sock.settimeout(PATIENCE)
        assert kept.sock.recv(1) == b"", "an old connection is ended, too"
