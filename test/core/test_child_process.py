"""Child processes and programs: their output, their end, and separate ROS domains."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pool_tasks
import pytest
from fresh_python import said

from mr_damper_ros.processes.programs import Program, ProgramError, RosDomain, node_arguments
from mr_damper_ros.processes.worker import child_command

PATIENCE = 30.0


def output(function: Callable[..., object], *arguments: str) -> str:
    return said(*child_command(function, *arguments))


def test_a_function_is_called_with_its_arguments() -> None:
    assert output(pool_tasks.told, "a b", "", "-c") == "['a b', '', '-c']\n"


def test_nothing_is_imported_from_the_folder_where_it_was_called(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "ctypes.py").write_text("raise SystemExit(1)", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    assert output(pool_tasks.told) == "[]\n"


_UNGUARDED = """
import sys
sys.path[:] = {paths!r}
print("read", flush=True)
import pool_tasks
from mr_damper_ros.processes.process_pool import ProcessPool
with ProcessPool(2) as pool:
    print(*pool.map(pool_tasks.failing, [4, 3]))
"""


def test_processes_of_a_pool_do_not_read_the_program(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(_UNGUARDED.format(paths=sys.path), encoding="utf-8")
    command = [sys.executable, str(program)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=True)
    assert done.stdout == "read\n4 3\n"


def test_an_interrupt_of_the_terminal_is_not_heeded() -> None:
    command = child_command(pool_tasks.answering)
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout.readline() == b"ready\n"
        child.send_signal(signal.SIGINT)
        child.stdin.write(b"go on\n")
        child.stdin.close()
        assert child.stdout.read() == b"go on\n"


def test_one_whose_parent_has_died_before_ends_at_once() -> None:
    command = child_command(pool_tasks.told)
    nobody = [str(os.getpid() + 1) if part == str(os.getpid()) else part for part in command]
    done = subprocess.run(nobody, capture_output=True, timeout=PATIENCE, check=False)
    assert (done.returncode, done.stdout) == (-signal.SIGKILL, b"")


# -- programs as processes: output, end by signal or force, separate domains -----------------------

TALKS = "import sys; print('out'); sys.stdout.flush(); print('err', file=sys.stderr)"
WAITS = "import sys, time; print('ready', file=sys.stderr); sys.stderr.flush(); time.sleep(600)"
DEAF = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); " + WAITS
SHORT = 0.2
"""Seconds to wait for an event that never occurs."""


@pytest.fixture
def waiting() -> Iterator[Program]:
    program = Program([sys.executable, "-c", WAITS])
    program.wait_for_log("ready")
    yield program
    program.close()


def test_output_and_errors_are_kept_apart_and_together() -> None:
    program = Program([sys.executable, "-c", TALKS])
    assert program.wait() == 0
    assert (program.output, program.errors) == ("out\n", "err\n")
    assert program.last_words == "out / err"
    program.close()


def test_one_that_is_asked_to_stop_ends_by_an_interrupt(waiting: Program) -> None:
    assert waiting.running
    assert waiting.stop() == -signal.SIGINT
    assert "KeyboardInterrupt" in waiting.errors
    assert not waiting.running


def test_one_that_is_asked_to_stop_ends_also_in_a_background_job() -> None:
    """A shell without job control lets its background jobs ignore SIGINT."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        program = Program([sys.executable, "-c", WAITS])
    finally:
        signal.signal(signal.SIGINT, before)
    with closing(program):
        program.wait_for_log("ready")
        program.stop(patience=PATIENCE)
        assert "KeyboardInterrupt" in program.errors


def test_one_that_does_not_end_is_killed() -> None:
    program = Program([sys.executable, "-c", DEAF])
    program.wait_for_log("ready")
    assert program.stop(patience=SHORT) == -signal.SIGKILL
    program.close()


def test_waiting_for_what_never_comes_ends_with_the_log(waiting: Program) -> None:
    with pytest.raises(ProgramError, match="never logged 'more': ready"):
        waiting.wait_for_log("more", SHORT)
    with pytest.raises(ProgramError, match=r"did not end within 0\.2 s"):
        waiting.wait(SHORT)


def test_arguments_of_a_node() -> None:
    arguments = node_arguments({"loop": True, "a__b": 0.5, "path": "x y"}, {"__ns": "/left"})
    assert arguments == [
        *("--ros-args", "-r", "__ns:=/left"),
        *("-p", "loop:=true", "-p", "a.b:=0.5", "-p", "path:=x y"),
    ]


def test_after_a_domain_the_environment_is_what_it_was() -> None:
    before = dict(os.environ)
    with RosDomain() as domain, domain.entered():
        assert domain.environment.items() <= os.environ.items()
    assert dict(os.environ) == before


def test_two_domains_differ_until_one_is_closed() -> None:
    with RosDomain() as one, RosDomain() as other:
        assert one.number != other.number
        assert one.environment["ROS_DOMAIN_ID"] == str(one.number)
        freed = min(one.number, other.number)
    with RosDomain() as again:
        assert again.number <= freed


def test_a_program_that_is_not_there_is_an_error() -> None:
    with pytest.raises(FileNotFoundError):
        Program(["/nowhere/program"])


def test_an_interrupt_while_a_program_starts_leaves_no_process(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    started: list[int] = []
    start = subprocess.Popen._execute_child

    def interrupted(process: subprocess.Popen[bytes], *arguments: object) -> None:
        start(process, *arguments)
        started.append(process.pid)
        raise KeyboardInterrupt

    monkeypatch.setattr(subprocess.Popen, "_execute_child", interrupted)
    with pytest.raises(KeyboardInterrupt):
        Program([sys.executable, "-c", WAITS])
    with pytest.raises(ProcessLookupError):
        os.kill(started[0], 0)
