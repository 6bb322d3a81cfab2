"""Start of a node's program: messages for missing parts, and a closed output."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from support import assert_one_sentence, installed_programs

SOME = ("bridge", "live")
"""Two nodes represent all, since the code is the same."""

PROGRAMS = {
    "campaign": ("campaign",),
    "identifier": ("identifier",),
    "identify": ("mr-damper", "identify"),
    "plan": ("mr-damper", "plan"),
}
"""A program and its command."""

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
from importlib.abc import MetaPathFinder

from mr_damper_ros import __main__, entry_points


class Interrupting(MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)


sys.meta_path.insert(0, Interrupting())
sys.exit({call})
"""
"""A program that is interrupted by Ctrl-C while it loads a module."""


@pytest.mark.parametrize(
    ("module", "call", "code", "said"),
    [
        ("rclpy", "entry_points.bridge()", 0, ""),
        (
            "mr_damper_ros.api.identification",
            "__main__.main(['identify'])",
            130,
            "\nmr-damper identify: stopped by Ctrl-C\n",
        ),
    ],
)
def test_a_program_that_is_interrupted_while_it_loads_ends_without_a_traceback(
    module: str, call: str, code: int, said: str
) -> None:
    program = INTERRUPTED.format(module=module, call=call)
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (code, said)


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


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_package_that_an_import_at_any_depth_lacks_is_one_sentence(
    program: str, tmp_path: Path
) -> None:
    """Only the worker of a node imports SciPy."""
    lacking = "raise ModuleNotFoundError(name='scipy')"
    (tmp_path / "scipy.py").write_text(lacking, encoding="utf-8")
    paths = f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    done = subprocess.run(
        [installed_programs() / PROGRAMS[program][0], *PROGRAMS[program][1:]],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    last = done.stderr.splitlines()[-1]
    name = " ".join(PROGRAMS[program])
    assert last.startswith(f"{name}: the Python package scipy is missing: ")
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


@pytest.mark.parametrize(("arguments", "code"), [(["--json", "result.json"], 141), (["--help"], 0)])
def test_a_command_that_could_not_write_all_its_output_fails(
    arguments: list[str], code: int, tmp_path: Path
) -> None:
    bag = Path(__file__).parents[2] / "bags" / "5.0mm_1Hz_1.5A"
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "wb") as closed:
        done = subprocess.run(
            [installed_programs() / "mr-damper", "identify", bag, *arguments],
            cwd=tmp_path,
            env={**os.environ, "PYTHONUNBUFFERED": ""},
            stdout=closed,
            stderr=subprocess.PIPE,
            timeout=60,
            check=False,
        )
    assert (done.returncode, done.stderr) == (code, b"")
    assert not list(tmp_path.iterdir())


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
