"""Child processes: they find what their parent finds, heed no Ctrl-C, and die with their parent."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pool_tasks
import pytest
from fresh_python import said

from mr_damper_ros.processes import child_process

PATIENCE = 30.0


def output(function: Callable[..., object], *arguments: str) -> str:
    return said(*child_process.command(function, *arguments))


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
    command = child_process.command(pool_tasks.answering)
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdin is not None
        assert child.stdout is not None
        assert child.stdout.readline() == b"ready\n"
        child.send_signal(signal.SIGINT)
        child.stdin.write(b"go on\n")
        child.stdin.close()
        assert child.stdout.read() == b"go on\n"


def test_one_whose_parent_has_died_before_ends_at_once() -> None:
    command = child_process.command(pool_tasks.told)
    nobody = [str(os.getpid() + 1) if part == str(os.getpid()) else part for part in command]
    done = subprocess.run(nobody, capture_output=True, timeout=PATIENCE, check=False)
    assert (done.returncode, done.stdout) == (1, b"")
