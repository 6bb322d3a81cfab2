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


@pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="there is no IPv6 here")
@pytest.mark.parametrize("client", ["127.0.0.1", "::1"])
def test_all_addresses_of_both_kinds_are_served(record: LiveRecord, client: str) -> None:
    with closing(PageServer(record, "::", 0)) as server:
        port = urlsplit(server.address).port
        with closing(http.client.HTTPConnection(client, port, timeout=PATIENCE)) as asked:
            asked.request("GET", "/status")
            assert asked.getresponse().status == 200


def raw(server: PageServer, request: bytes) -> tuple[int, str]:
    """Status and body of the answer to a raw request; status 0 if there is none."""
    with socket.create_connection(place_of(server), timeout=PATIENCE) as sent:
        sent.sendall(request)
        answer = http.client.HTTPResponse(sent)
        try:
            answer.begin()
        except ConnectionError:
            return 0, ""
        assert answer.will_close, "further bytes may belong to the malformed request"
        return answer.status, answer.read().decode()


LOCALHOST = b" HTTP/1.1\r\nHost: localhost\r\n"

MALFORMED = {
    "no host": b"GET / HTTP/1.1\r\n",
    "two hosts": b"GET /" + LOCALHOST + b"Host: localhost\r\n",
    "open bracket": b"GET / HTTP/1.1\r\nHost: [\r\n",
    "words for rows": b"GET /tables/signals?after=ten" + LOCALHOST,
    "raised length": b"POST /command" + LOCALHOST + "Content-Length: ²\r\n".encode("latin-1"),
    "two lengths": b"GET /" + LOCALHOST + b"Content-Length: 0\r\nContent-Length: 1\r\n",
    "length and chunks": b"POST /command"
    + LOCALHOST
    + b"Content-Length: 5\r\nTransfer-Encoding: chunked\r\n",
    "long target": b"GET /" + 9000 * b"a" + LOCALHOST,
    "long field": b"GET /" + LOCALHOST + b"X: " + 9000 * b"a" + b"\r\n",
    "version": b"GET / HTTP/one\r\nHost: localhost\r\n",
    "one word": b"GET\r\nHost: localhost\r\n",
    "not HTTP": b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n",
}


@pytest.mark.parametrize("name", MALFORMED)
def test_what_is_malformed_is_refused_in_a_sentence(
    server: PageServer, capfd: pytest.CaptureFixture[str], name: str
) -> None:
    status, sentence = raw(server, MALFORMED[name] + b"\r\n")
    assert status == 400
    assert len(sentence.splitlines()) == 1
    assert capfd.readouterr().err == ""


def test_a_malformed_target_ends_the_connection(
    server: PageServer, capfd: pytest.CaptureFixture[str]
) -> None:
    status, _ = raw(server, b"GET http://[" + LOCALHOST + b"\r\n")
    assert status in (0, 400), "aiohttp 3.9 cannot answer it"
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
        (b"x" * 1001, {}, 413),
        (b"reset", {"Origin": "http://elsewhere.example"}, 403),
        (b"reset", {"Origin": "http://["}, 403),
        (b"reset", {"Origin": "null"}, 403),
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


@pytest.mark.parametrize("encoding", ["utf-8", "unknown", "hex"])
@pytest.mark.parametrize("path", ["/command", "/seen"])
def test_a_body_that_is_no_text_is_refused_in_a_sentence(
    commanded: PageServer, capfd: pytest.CaptureFixture[str], path: str, encoding: str
) -> None:
    headers = {**own(commanded), "Content-Type": f"text/plain; charset={encoding}"}
    answer, body = ask(commanded, path, "POST", b"\xff", headers)
    assert answer.status == 400
    assert len(body.decode().splitlines()) == 1
    assert capfd.readouterr().err == ""


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


def connected(server: PageServer, address: str) -> http.client.HTTPConnection:
    """A connection from an address of this computer that has been answered."""
    asked = http.client.HTTPConnection(*place_of(server), PATIENCE, (address, 0))
    asked.request("GET", "/status")
    assert asked.getresponse().read()
    return asked


def test_one_address_has_its_share_of_connections_and_leaves_room_for_others(
    server: PageServer,
) -> None:
    with ExitStack() as stack:
        for _ in range(page_server.CONNECTIONS_EACH):
            stack.enter_context(closing(connected(server, "127.0.0.1")))
        with pytest.raises(ConnectionError):
            connected(server, "127.0.0.1")
        stack.enter_context(closing(connected(server, "127.0.0.2")))
    assert eventually_served(server), "places that were left are not taken again"


def test_all_addresses_together_have_a_limit(server: PageServer) -> None:
    with ExitStack() as stack:
        for number in range(page_server.CONNECTIONS):
            address = f"127.0.0.{2 + number // page_server.CONNECTIONS_EACH}"
            stack.enter_context(closing(connected(server, address)))
        with pytest.raises(ConnectionError):
            connected(server, "127.0.0.1")
    assert eventually_served(server), "places that were left are not taken again"


@pytest.mark.parametrize("sent", [b"", 100 * (b"GET /uplot.js" + LOCALHOST + b"\r\n")])
def test_clients_that_ask_or_read_nothing_are_given_up(
    record: LiveRecord, monkeypatch: pytest.MonkeyPatch, sent: bytes
) -> None:
    monkeypatch.setattr(page_server, "_IDLE", 0.3)
    with closing(PageServer(record, "127.0.0.1", 0)) as server, ExitStack() as stack:
        for _ in range(page_server.CONNECTIONS_EACH):
            stuck = stack.enter_context(socket.socket())
            stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            stuck.connect(place_of(server))
            stuck.sendall(sent)
        assert eventually_served(server)


FLOODS = {
    "requests": (b"", b"GET /tables/parameters" + LOCALHOST + b"\r\n"),
    "fields": (b"GET /" + LOCALHOST, b"X: y\r\n"),
    "body": (b"POST /command" + LOCALHOST + b"Content-Length: 1000000000\r\n\r\n", b"x"),
    "chunks": (
        b"POST /command" + LOCALHOST + b"Transfer-Encoding: chunked\r\n\r\n",
        b"3e8\r\n" + 1000 * b"x" + b"\r\n",
    ),
    "after an upgrade": (
        b"GET /status" + LOCALHOST + b"Connection: Upgrade\r\nUpgrade: websocket\r\n\r\n",
        b"x",
    ),
}


@pytest.mark.parametrize("name", FLOODS)
def test_a_flood_ends_its_connection_alone(
    server: PageServer, capfd: pytest.CaptureFixture[str], name: str
) -> None:
    begin, piece = FLOODS[name]
    with closing(connected(server, "127.0.0.1")) as other:
        with socket.create_connection(place_of(server), timeout=PATIENCE) as flooding:
            flooding.sendall(begin)
            with pytest.raises(ConnectionError):
                repeat(flooding, (4096 // len(piece) + 1) * piece, 0.01)
        other.request("GET", "/status")
        assert other.getresponse().status == 200
    assert capfd.readouterr().err == ""


def test_a_long_connection_is_continued_by_another(server: PageServer) -> None:
    with closing(connection(server)) as asked:
        count, ended = 0, False
        while not ended and count < 3000:
            asked.request("GET", "/tables/parameters")
            answer = asked.getresponse()
            assert (answer.status, answer.read()) == (204, b"")
            count, ended = count + 1, answer.will_close
        assert 50 < count < 3000
        asked.request("GET", "/status")  # this opens another connection
        assert asked.getresponse().status == 200


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
            repeat(slow, b"x", 0.1)


def repeat(connected: socket.socket, piece: bytes, seconds: float) -> None:
    """Send a piece again and again; raises ConnectionError once the server has closed."""
    pause = threading.Event()
    for _ in range(300):
        pause.wait(seconds)
        connected.sendall(piece)


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
