"""The page server for clients: files, data, rejected requests, and slow viewers."""

import http.client
import json
import re
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from urllib.parse import urlsplit

import numpy as np
import pytest
import running_damper

from mr_damper_ros.live import page_server
from mr_damper_ros.live.live_record import LiveRecord
from mr_damper_ros.live.page_server import FILES, PAGE, PageServer

PATIENCE = 30.0


@pytest.fixture(scope="module")
def record() -> LiveRecord:
    made = LiveRecord()
    for number in range(100):
        running_damper.add_signals(
            made, 0.01 * number, 1e-3, 0.1, 0.5, 300.0, 290.0, valid=number % 2 == 0
        )
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


def test_the_page_is_served_with_its_data_alone(server: PageServer) -> None:
    page = ask(server, "/")[1].decode()
    asked_for = set(re.findall(r'(?:src|href)="(?!data:)([^"#]+)"', page))
    assert asked_for <= set(FILES)
    own = [name for name, _ in FILES.values() if not name.startswith("vendor/")]
    for name in own:
        text = (PAGE / name).read_text(encoding="utf-8")
        assert not re.search(r"https?://(?!www\.w3\.org/)", text), name
    assert "default-src 'self'" in ask(server, "/")[0].headers["Content-Security-Policy"]
    answer, body = ask(server, "/tables/signals?after=97")
    all_rows = np.frombuffer(body).reshape(-1, len(answer.headers["X-Columns"].split(",")))
    assert len(all_rows) >= 100, "the generation was not given: all rows"
    generation = answer.headers["X-Generation"]
    answer, body = ask(server, f"/tables/signals?after=97&generation={generation}")
    rows = np.frombuffer(body).reshape(-1, all_rows.shape[1])
    assert rows[:2, 0].tolist() == [98.0, 99.0]
    assert ask(server, "/tables/parameters")[0].status == 204
    told = json.loads(ask(server, "/status?windows=0")[1])
    assert told["title"] == "/left"
    assert told["commands"] == []
    assert told["tables"]["signals"]["generation"] >= 1
    with closing(connection(server)) as asked:
        for _ in range(20):
            asked.request("GET", "/status")
            assert asked.getresponse().read()


@pytest.mark.parametrize("path", ["/etc/passwd", "/../live_record.py", "/vendor/", "/page.js/.."])
def test_nothing_else_is_served(server: PageServer, path: str) -> None:
    assert ask(server, path)[0].status == 404


NAME = socket.gethostname()


@pytest.mark.parametrize(
    "host",
    [
        *("localhost", "LocalHost:8770", "127.0.0.1", "[::1]:8770", NAME.upper()),
        *(f"{NAME.partition('.')[0]}.local.", "rig.example:80"),
    ],
)
def test_names_of_this_computer_and_allowed_ones_are_served(record: LiveRecord, host: str) -> None:
    with closing(PageServer(record, "127.0.0.1", 0, allowed_hosts=["Rig.Example"])) as server:
        assert ask(server, "/status", headers={"Host": host})[0].status == 200


@pytest.mark.parametrize("address", ["127.0.0.1", "0.0.0.0"])
@pytest.mark.parametrize("path", ["/", "/status", "/tables/signals"])
def test_another_name_is_refused_whatever_is_asked(
    record: LiveRecord, address: str, path: str
) -> None:
    with closing(PageServer(record, address, 0)) as server:
        answer, body = ask(server, path, headers={"Host": "elsewhere.example"})
    assert answer.status == 403
    assert b"elsewhere.example" in body
    assert b"allowed_hosts" in body


class Answer:
    """Answer of a server that then closes the connection; status 0 if there is none."""

    def __init__(self, said: bytes) -> None:
        self.said = said
        self.status = int(said.split()[1]) if said.startswith(b"HTTP/1.1 ") else 0
        self.body = said.partition(b"\r\n\r\n")[2].decode("utf-8", "replace")


def raw(address: tuple[str, int], head: bytes, body: bytes = b"") -> Answer:
    """Send a raw request and nothing after it."""
    with socket.create_connection(address, timeout=PATIENCE) as sent:
        with suppress(ConnectionError):
            sent.sendall(head + b"\r\n" + body)
            sent.shutdown(socket.SHUT_WR)
        said = b""
        with suppress(ConnectionError):
            while part := sent.recv(1 << 16):
                said += part
    return Answer(said)


MALFORMED = {
    "no host": (b"GET / HTTP/1.1\r\n", "one Host"),
    "two hosts": (b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: localhost\r\n", "one Host"),
    "open bracket": (b"GET / HTTP/1.1\r\nHost: [\r\n", "neither a name nor an address"),
    "target with host": (b"GET http://[ HTTP/1.1\r\nHost: localhost\r\n", "not begin with a slash"),
    "words for rows": (
        b"GET /tables/signals?after=ten HTTP/1.1\r\nHost: localhost\r\n",
        "after must be a whole number",
    ),
    "raised length": (
        "POST /command HTTP/1.1\r\nHost: localhost\r\nContent-Length: ²\r\n".encode("latin-1"),
        "Content-Length must be one whole number",
    ),
    "two lengths": (
        b"GET / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 0\r\nContent-Length: 1\r\n",
        "Content-Length must be one whole number",
    ),
    "long body": (
        b"POST /command HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1001\r\n",
        "at most 1000 bytes",
    ),
    "chunks": (
        b"POST /command HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n",
        "Transfer-Encoding",
    ),
    "origin": (
        b"POST /command HTTP/1.1\r\nHost: localhost\r\nOrigin: http://[\r\n",
        "neither a name nor an address",
    ),
    "version": (b"GET / HTTP/one\r\nHost: localhost\r\n", "version"),
    "one word": (b"GET\r\nHost: localhost\r\n", "syntax"),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_what_is_malformed_is_refused_in_a_sentence(
    server: PageServer, capfd: pytest.CaptureFixture[str], name: str
) -> None:
    head, sentence = MALFORMED[name]
    answer = raw(place_of(server), head)
    assert answer.status == 400
    assert sentence in answer.body
    assert len(answer.body.splitlines()) == 1
    assert capfd.readouterr().err == ""


def place_of(server: PageServer) -> tuple[str, int]:
    parts = urlsplit(server.address)
    return parts.hostname or "", parts.port or 0


def own(server: PageServer) -> dict[str, str]:
    """Headers that the page itself sends."""
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
    def take(name: str, arguments: object) -> bool:
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
            stuck.sendall(100 * request)  # five megabytes, none of which it reads
        running_damper.add_signals(record, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, valid=True)
        assert json.loads(ask(server, "/status")[1])["tables"]["signals"]["next"] == known + 1


def eventually_served(server: PageServer) -> bool:
    """Whether a further connection is accepted eventually."""
    pause = threading.Event()
    for _ in range(300):
        with suppress(ConnectionError):
            return ask(server, "/status")[0].status == 200
        pause.wait(0.1)
    return False


def test_one_address_has_its_share_of_connections_and_leaves_room_for_others(
    server: PageServer,
) -> None:
    with ExitStack() as stack:
        for _ in range(page_server.CONNECTIONS_EACH):
            asked = stack.enter_context(closing(connection(server)))
            asked.request("GET", "/status")
            assert asked.getresponse().read()
        with pytest.raises(ConnectionError):
            ask(server, "/status")
        other = http.client.HTTPConnection(*place_of(server), PATIENCE, ("127.0.0.2", 0))
        with closing(other):
            other.request("GET", "/status")
            assert other.getresponse().status == 200
    assert eventually_served(server), "places that were left are not taken again"


@pytest.mark.parametrize(
    "begun",
    [
        b"G",
        b"GET / HTTP/1.1\r\nHost: localhost\r\n",
        b"POST /command HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\n\r\nr",
    ],
)
def test_a_request_that_comes_byte_by_byte_is_given_up(
    server: PageServer, monkeypatch: pytest.MonkeyPatch, begun: bytes
) -> None:
    monkeypatch.setattr(page_server, "_REQUEST", 0.3)
    with socket.create_connection(place_of(server), timeout=PATIENCE) as slow:
        slow.sendall(begun)
        with pytest.raises(ConnectionError):
            dribble(slow)


def dribble(slow: socket.socket) -> None:
    """Send a byte ten times per second; raises ConnectionError once the server has closed."""
    pause = threading.Event()
    for _ in range(300):
        pause.wait(0.1)
        slow.sendall(b"x")


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
