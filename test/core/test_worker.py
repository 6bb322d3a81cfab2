"""The worker process: results, progress, cancellation, death, hanging, and never an orphan."""

from __future__ import annotations

import operator
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from mr_damper_ros.processes.worker import Done, Failed, Outcome, Progress, Worker, WorkerPool

TASKS = """
import os, pathlib, signal, sys, time

def call(function, *args):
    return function(*args[:-1])  # the last is the control

def count(limit, control):
    for step in range(limit):
        if not control.report(step):
            return f"stopped at {step}"
        time.sleep(0.01)
    return "counted"

def wait(control):
    while not control.should_stop():
        time.sleep(0.01)
    return "waited"

def deaf(control):
    while True:
        control.report(0)
        time.sleep(0.01)

def die_once(path, control):
    marker = pathlib.Path(path)
    if not marker.exists():
        marker.write_text("died")
        os.kill(os.getpid(), signal.SIGKILL)
    return "second try"

def die_once_with(item, path, control):
    return die_once(path, control)

def hang_once(path, control):
    marker = pathlib.Path(path)
    if not marker.exists():
        marker.write_text("hung")
        os.kill(os.getpid(), signal.SIGSTOP)
    return "second try"

def die(control):
    os.kill(os.getpid(), signal.SIGKILL)

def unpicklable(control):
    return lambda: None

def modules(control):
    return sorted(sys.modules)
"""


@pytest.fixture
def tasks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A module of tasks that the worker can import too."""
    (tmp_path / "worker_tasks.py").write_text(TASKS)
    monkeypatch.syspath_prepend(str(tmp_path))
    sys.modules.pop("worker_tasks", None)
    import worker_tasks

    return worker_tasks


@pytest.fixture
def make_worker(tasks: Any) -> Iterator[Callable[[], Worker]]:
    pools = []

    def make() -> Worker:
        pools.append(WorkerPool("worker_tasks"))
        return pools[-1].worker()

    yield make
    for pool in pools:
        pool.close()


def wait_until(condition: Callable[[], Any], what: str, limit: float = 30.0) -> Any:
    deadline = time.monotonic() + limit
    while time.monotonic() < deadline:
        value = condition()
        if value:
            return value
        time.sleep(0.005)
    raise AssertionError(f"not within {limit} s: {what}")


def ending(worker: Worker, seen: list[Outcome] | None = None) -> Outcome:
    """The outcome with which the running task ends; its progress is appended to ``seen``."""
    outcomes: list[Outcome] = [] if seen is None else seen

    def poll() -> bool:
        outcomes.extend(worker.poll())
        return not worker.busy

    wait_until(poll, "the end of the task")
    return outcomes[-1]


def is_gone(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return True
    return state == "Z"


def test_a_task_returns_its_result(make_worker: Callable[[], Worker], tasks: Any) -> None:
    worker = make_worker()
    number = worker.submit(tasks.call, operator.add, 2, 3)
    assert ending(worker) == Done(number, 5)
    second = worker.submit(tasks.call, os.getpid)
    assert second != number
    assert ending(worker) == Done(second, worker.pid)
    assert worker.replaced == 0


def test_one_task_at_a_time(make_worker: Callable[[], Worker], tasks: Any) -> None:
    worker = make_worker()
    worker.submit(tasks.call, time.sleep, 0.0)
    with pytest.raises(RuntimeError, match="busy"):
        worker.submit(tasks.call, time.sleep, 0.0)
    ending(worker)


def test_progress_comes_in_order(make_worker: Callable[[], Worker], tasks: Any) -> None:
    worker = make_worker()
    number = worker.submit(tasks.count, 5)
    seen: list[Outcome] = []
    assert ending(worker, seen) == Done(number, "counted")
    assert seen[:-1] == [Progress(number, step) for step in range(5)]


def test_a_cancelled_task_returns_what_it_has(
    make_worker: Callable[[], Worker], tasks: Any
) -> None:
    worker = make_worker()
    worker.submit(tasks.count, 10**6)
    wait_until(worker.poll, "the first progress")
    pid = worker.pid
    worker.cancel()
    outcome = ending(worker)
    assert isinstance(outcome, Done)
    assert outcome.result.startswith("stopped")
    assert worker.pid == pid
    number = worker.submit(tasks.call, operator.add, 1, 1)
    assert ending(worker) == Done(number, 2)


def test_an_exception_is_a_failure_and_the_worker_goes_on(
    make_worker: Callable[[], Worker], tasks: Any
) -> None:
    worker = make_worker()
    number = worker.submit(tasks.call, operator.truediv, 1, 0)
    assert ending(worker) == Failed(number, "ZeroDivisionError: division by zero")
    number = worker.submit(tasks.unpicklable)
    outcome = ending(worker)
    assert isinstance(outcome, Failed)
    number = worker.submit(tasks.call, operator.add, 1, 1)
    assert ending(worker) == Done(number, 2)
    assert worker.replaced == 0


def test_a_task_beyond_its_budget_is_asked_to_stop(
    make_worker: Callable[[], Worker], tasks: Any
) -> None:
    worker = make_worker()
    number = worker.submit(tasks.wait, budget=0.2)
    assert ending(worker) == Done(number, "waited")
    assert worker.replaced == 0


@pytest.mark.parametrize("name", ["sleep", "deaf"])
def test_a_hanging_worker_is_replaced(
    make_worker: Callable[[], Worker], tasks: Any, name: str
) -> None:
    worker = make_worker()
    pid = worker.pid
    if name == "sleep":
        worker.submit(tasks.call, time.sleep, 3600.0, budget=0.2)
    else:
        worker.submit(tasks.deaf, budget=0.2)
    assert ending(worker) == Failed(1, "the task exceeded its 0.2 s and did not stop when asked to")
    assert is_gone(pid or 0)
    number = worker.submit(tasks.call, operator.add, 1, 1)
    assert ending(worker) == Done(number, 2)
    assert worker.replaced == 1
    assert "given up" in worker.take_notices()[0]
    assert worker.take_notices() == []


def test_a_stopped_worker_does_not_block_the_node(
    make_worker: Callable[[], Worker], tasks: Any
) -> None:
    worker = make_worker()
    worker.submit(tasks.call, operator.add, 1, 1)
    ending(worker)
    os.kill(worker.pid or 0, signal.SIGSTOP)
    worker.submit(tasks.call, len, b"x" * 10**7, budget=0.2)  # more than a socket's buffer
    assert isinstance(ending(worker), Failed)
    worker.submit(tasks.call, len, b"x" * 10**7)
    assert ending(worker) == Done(3, 10**7)


def test_a_worker_that_is_stopped_without_a_task_is_replaced(
    make_worker: Callable[[], Worker], tasks: Any
) -> None:
    worker = make_worker()
    worker.submit(tasks.call, operator.add, 1, 1)
    ending(worker)
    pid = worker.pid or 0
    os.kill(pid, signal.SIGSTOP)
    wait_until(lambda: worker.poll() or worker.replaced, "a new worker")
    assert is_gone(pid)
    assert worker.take_notices() == ["the worker process hangs: the worker is replaced"]


def test_the_task_of_a_worker_that_hangs_starts_again(
    make_worker: Callable[[], Worker], tasks: Any, tmp_path: Path
) -> None:
    worker = make_worker()
    # No budget is exceeded: it is the silence that tells.
    number = worker.submit(tasks.hang_once, str(tmp_path / "marker"))
    assert ending(worker) == Done(number, "second try")
    assert worker.replaced == 1
    assert "hangs" in worker.take_notices()[0]


def test_a_node_that_was_held_up_itself_blames_nobody(
    make_worker: Callable[[], Worker], tasks: Any
) -> None:
    worker = make_worker()
    worker.submit(tasks.call, operator.add, 1, 1)
    ending(worker)
    pid = worker.pid or 0
    os.kill(pid, signal.SIGSTOP)
    time.sleep(2.0)
    worker.poll()
    os.kill(pid, signal.SIGCONT)
    number = worker.submit(tasks.call, operator.add, 1, 1)
    assert ending(worker) == Done(number, 2)
    assert worker.replaced == 0


def test_the_task_of_a_killed_worker_starts_again(
    make_worker: Callable[[], Worker], tasks: Any, tmp_path: Path
) -> None:
    worker = make_worker()
    number = worker.submit(tasks.die_once, str(tmp_path / "marker"))
    assert ending(worker) == Done(number, "second try")
    assert worker.replaced == 1
    assert "starts again" in worker.take_notices()[0]


def test_a_task_that_kills_the_worker_twice_has_failed(
    make_worker: Callable[[], Worker], tasks: Any
) -> None:
    worker = make_worker()
    number = worker.submit(tasks.die)
    assert ending(worker) == Failed(number, "the worker process died")
    assert worker.replaced == 2
    number = worker.submit(tasks.call, operator.add, 1, 1)
    assert ending(worker) == Done(number, 2)


def test_an_idle_worker_that_dies_is_replaced(
    make_worker: Callable[[], Worker], tasks: Any
) -> None:
    worker = make_worker()
    worker.submit(tasks.call, operator.add, 1, 1)
    ending(worker)
    pid = worker.pid
    os.kill(pid or 0, signal.SIGKILL)
    wait_until(lambda: worker.poll() or worker.pid not in (None, pid), "a new worker")
    number = worker.submit(tasks.call, operator.add, 1, 1)
    assert ending(worker) == Done(number, 2)


def test_the_worker_stays_light(make_worker: Callable[[], Worker], tasks: Any) -> None:
    worker = make_worker()
    worker.submit(tasks.modules)
    outcome = ending(worker)
    assert isinstance(outcome, Done)
    assert "rclpy" not in outcome.result
    assert "numpy" not in outcome.result  # only what a task needs


def test_a_closed_worker_leaves_no_process(tasks: Any) -> None:
    pool = WorkerPool("worker_tasks")
    worker = pool.worker()
    pid = worker.pid or 0
    worker.submit(tasks.call, time.sleep, 3600.0)
    pool.close()
    assert is_gone(pid)
    assert worker.poll() == []
    assert worker.pid is None


@pytest.mark.parametrize("task", ["time.sleep, 3600.0", "sum, range(10**15)"])
def test_the_worker_dies_with_a_killed_parent(tasks: Any, task: str) -> None:
    # A long sum holds the interpreter lock, so that no thread of the worker can react.
    script = (
        "import time, worker_tasks\n"
        "from mr_damper_ros.processes.worker import WorkerPool\n"
        "worker = WorkerPool('worker_tasks').worker()\n"
        f"worker.submit(worker_tasks.call, {task})\n"
        "deadline = time.monotonic() + 1.0\n"
        "while time.monotonic() < deadline: worker.poll(); time.sleep(0.01)\n"
        "print(worker.pid, flush=True)\n"
        "time.sleep(3600)\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path))}
    with subprocess.Popen(
        [sys.executable, "-c", script], env=environment, stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        assert not is_gone(pid)
        parent.kill()
    wait_until(lambda: is_gone(pid), "the end of the worker")
