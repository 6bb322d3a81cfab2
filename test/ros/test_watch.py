"""The programs that show a running system in a terminal, and the one that starts an example."""

import http.client
import json
import re
import signal
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from support import PATIENCE, assert_one_sentence, installed_programs
from waiting import until

from mr_damper_ros.processes.programs import Program


def test_watch_prints_how_the_system_stands(start: Any) -> None:
    start("identifier")
    start("model").wait_for_log("waiting for")
    program = Program([str(installed_programs() / "watch"), "--once"])
    assert program.wait() == 0, program.log
    assert "no signals yet: the node model is running" in program.output
    assert re.search(r"^set in use +\S+ \(sigmoid, literature\)", program.output, re.MULTILINE)
    assert re.search(r"^! model: input", program.output, re.MULTILINE)
    program.close()


def test_a_wrong_period_is_one_sentence() -> None:
    program = Program([str(installed_programs() / "watch"), "--period", "0"])
    assert program.wait() == 2
    assert_one_sentence(program.errors)
    program.close()


@pytest.mark.parametrize(
    ("number", "code"),
    [(signal.SIGINT, 0), (signal.SIGTERM, 143), (signal.SIGHUP, -1), (signal.SIGKILL, -9)],
)
def test_a_rig_is_shown_until_it_is_stopped(number: signal.Signals, code: int) -> None:
    program = Program([str(installed_programs() / "demo"), "--live", "--port", "0"])
    found = until(lambda: re.search(r"the page is at (\S+);", program.output), "the page")
    until(lambda: signals_at(found[1]), "signals on the page")
    nodes = program.children
    assert len(nodes) == 4
    assert program.stop(number) == code
    until(lambda: not any(map(runs, nodes)), "the end of the nodes")
    program.close()


def runs(pid: int) -> bool:
    """Whether a process runs; one that has ended may wait for its parent to notice."""
    try:
        return ") Z " not in Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
    except FileNotFoundError:
        return False


def signals_at(address: str) -> int:
    """Signals that a page has received."""
    connection = http.client.HTTPConnection(urlsplit(address).netloc, timeout=PATIENCE)
    try:
        connection.request("GET", "/status")
        told: dict[str, Any] = json.loads(connection.getresponse().read())
        return int(told["tables"]["signals"]["next"])
    finally:
        connection.close()
