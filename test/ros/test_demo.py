"""The demonstration: three processes, a table and figures."""

import re
import signal
from pathlib import Path

from support import assert_one_sentence, installed_programs
from waiting import until

from mr_damper_ros.processes.programs import Program


def demo(*arguments: str) -> Program:
    return Program([str(installed_programs() / "demo"), *arguments])


def test_it_identifies_a_bag_and_draws_the_figures(tmp_path: Path) -> None:
    program = demo("--rate", "4", "--output", str(tmp_path))
    assert program.wait() == 0, program.log
    assert "accepted" in program.output
    assert re.search(r"live page during this run: http://127\.0\.0\.1:\d+/", program.output)
    assert "NRMSE of the force predicted during the run" in program.output
    assert {path.suffix for path in tmp_path.iterdir()} == {".png"}
    program.close()


def test_a_bag_that_is_not_there_is_one_sentence() -> None:
    program = demo("--bag", "/nowhere")
    assert program.wait() == 2
    assert_one_sentence(program.log)
    program.close()


def test_an_interrupt_ends_it_and_its_nodes(tmp_path: Path) -> None:
    program = demo("--output", str(tmp_path))
    until(lambda: len(program.children) == 4, "all nodes")
    nodes = program.children
    assert program.stop(signal.SIGINT) == 130
    assert not any(Path(f"/proc/{pid}").exists() for pid in nodes)
    program.close()
