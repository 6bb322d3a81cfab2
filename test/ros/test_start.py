"""Start of a node's program: messages for missing parts, and a closed output."""

import os
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from support import assert_one_sentence, installed_programs

NODES = ("bridge", "controller", "identifier", "live", "model", "replay")
SOME = ("bridge", "live")
"""Two programs represent all, since the code is the same."""

TOOLS = ("demo", "identify", "import_record", "validate")

WITHOUT = """
import sys

sys.modules[{missing!r}] = None
from mr_damper_ros.entry_points import {node}

sys.exit({node}())
"""
"""A program in which a module cannot be imported."""

INTERRUPTED = """
import os
import signal
import sys

signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
os.kill(os.getpid(), signal.SIGINT)
from mr_damper_ros.entry_points import tool

sys.exit(tool("identify"))
"""
"""A tool that is interrupted by Ctrl-C during its imports."""


def test_a_tool_that_is_interrupted_while_it_loads_says_so_and_no_more() -> None:
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 130
    assert done.stderr == "\nidentify: stopped by Ctrl-C\n"


@pytest.mark.parametrize("program", NODES + TOOLS)
def test_signals_are_held_back_from_the_first_moment(program: str) -> None:
    first_line = (installed_programs() / program).read_text(encoding="utf-8").splitlines()[0]
    assert first_line == f"#!/usr/bin/env -S --block-signal=INT,TERM {sys.executable}"


@pytest.mark.parametrize("program", NODES + TOOLS)
def test_a_process_that_a_program_starts_does_not_run_it_again(program: str) -> None:
    # multiprocessing imports the program in this way in a new process.
    runpy.run_path(str(installed_programs() / program), run_name="__mp_main__")


@pytest.mark.parametrize("node", SOME)
@pytest.mark.parametrize(
    ("missing", "cure"), [("mr_damper_msgs", "colcon build"), ("rclpy", "setup.bash")]
)
def test_a_missing_package_is_one_sentence_with_the_cure(
    node: str, missing: str, cure: str
) -> None:
    program = WITHOUT.format(missing=missing, node=node)
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 2
    assert_one_sentence(done.stderr)
    assert cure in done.stderr


@pytest.mark.parametrize("program", ["campaign", "identifier", "identify", "plan_run"])
def test_a_package_that_an_import_at_any_depth_lacks_is_one_sentence(
    program: str, tmp_path: Path
) -> None:
    """Only the worker of a node imports SciPy."""
    lacking = "raise ModuleNotFoundError(name='scipy')"
    (tmp_path / "scipy.py").write_text(lacking, encoding="utf-8")
    paths = f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    done = subprocess.run(
        [installed_programs() / program],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"{program}: the Python package scipy is missing: ")
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("node", SOME)
def test_a_reader_that_has_enough_is_no_error(node: str) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "wb") as closed:
        done = subprocess.run(
            [installed_programs() / node, "--help"],
            stdout=closed,
            stderr=subprocess.PIPE,
            timeout=60,
            check=False,
        )
    assert (done.returncode, done.stderr) == (0, b"")


def test_identifier_and_model_say_what_they_wait_for(start: Any, tmp_path: Path) -> None:
    identifier = start("identifier", remap={"__ns": "/left"}, state_dir=tmp_path)
    model = start("model")
    identifier.wait_for_log(
        "waiting for /left/mts/samples and /left/supply/current; state is stored"
    )
    assert str(tmp_path) in identifier.errors
    model.wait_for_log("waiting for /mts/samples, /supply/current and /damper/parameters")


@pytest.mark.parametrize("environment", [{}, {"HOME": "/proc"}, {"ROS_LOG_DIR": "/proc/nowhere"}])
def test_no_place_for_the_log_is_one_sentence(environment: dict[str, str]) -> None:
    names = ("HOME", "ROS_HOME", "ROS_LOG_DIR")
    without = {key: value for key, value in os.environ.items() if key not in names}
    done = subprocess.run(
        [installed_programs() / "model"],
        env={**without, **environment},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert "set ROS_LOG_DIR to a folder in which the log can be written" in done.stderr
    assert_one_sentence(done.stderr)
