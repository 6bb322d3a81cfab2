"""The programs that show a running system in a terminal, and the one that starts an example."""

import http.client
import json
import re
import signal
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from PIL import Image
from support import PATIENCE, assert_one_sentence, installed_programs
from waiting import until

from mr_damper_ros.processes.programs import Program

PICTURE = Path(__file__).parents[2] / "doc" / "demo.png"

AS_SHOWN = 0.05
"""Largest difference [%] between the NRMSE of the demonstration and that in the picture."""


def nrmse_in(picture: Path) -> float:
    """NRMSE [%] in the heading of a figure."""
    with Image.open(picture) as image:
        found = re.search(r"NRMSE (\S+)%", image.info["Title"])
    assert found
    return float(found[1])


def tool(name: str, *arguments: str) -> Program:
    return Program([str(installed_programs() / "mr-damper"), name, *arguments])


def test_watch_prints_how_the_system_stands(start: Any) -> None:
    start("identifier")
    start("model").wait_for_log("waiting for")
    program = tool("watch", "--once")
    assert program.wait() == 0, program.log
    assert "no signals yet: the node model is running" in program.output
    assert re.search(r"^set in use +\S+ \(sigmoid, literature\)", program.output, re.MULTILINE)
    assert re.search(r"^! model: input", program.output, re.MULTILINE)
    program.close()


def test_a_wrong_period_is_one_sentence() -> None:
    program = tool("watch", "--period", "0")
    assert program.wait() == 2
    assert_one_sentence(program.errors)
    program.close()


@pytest.mark.parametrize(
    ("number", "code"),
    [(signal.SIGINT, 0), (signal.SIGTERM, 143), (signal.SIGHUP, -1), (signal.SIGKILL, -9)],
)
def test_a_rig_is_shown_until_it_is_stopped(number: signal.Signals, code: int) -> None:
    if signal.getsignal(number) is signal.SIG_IGN:
        pytest.skip("programs inherit that this signal is ignored, as under nohup")
    program = tool("demo", "--live", "--port", "0")
    found = until(lambda: re.search(r"the page is at (\S+);", program.output), "the page")
    until(lambda: signals_at(found[1]), "signals on the page")
    nodes = program.children
    assert len(nodes) == 4
    assert program.stop(number) == code
    until(lambda: not any(map(runs, nodes)), "the end of the nodes")
    program.close()


def test_it_identifies_a_bag_and_draws_the_picture_of_the_readme(tmp_path: Path) -> None:
    program = tool("demo", "--output", str(tmp_path))
    assert program.wait() == 0, program.log
    assert "accepted" in program.output
    assert re.search(r"live page during this run: http://127\.0\.0\.1:\d+/", program.output)
    assert "NRMSE of the force predicted during the run" in program.output
    (drawn,) = tmp_path.iterdir()
    assert abs(nrmse_in(drawn) - nrmse_in(PICTURE)) <= AS_SHOWN
    program.close()


def test_a_bag_that_is_not_there_is_one_sentence() -> None:
    program = tool("demo", "--bag", "/nowhere")
    assert program.wait() == 2
    assert_one_sentence(program.log)
    program.close()


def test_an_interrupt_ends_it_and_its_nodes(tmp_path: Path) -> None:
    program = tool("demo", "--output", str(tmp_path))
    until(lambda: len(program.children) == 4, "all nodes")
    nodes = program.children
    assert program.stop(signal.SIGINT) == 130
    assert not any(Path(f"/proc/{pid}").exists() for pid in nodes)
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
