"""Worker processes: results, order, cancellation, death, hanging, and no orphans."""

import operator
import os
import pathlib
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
import worker_tasks as tasks
from waiting import is_gone, until

from mr_damper_ros.processes.worker import Done, Failed, Outcome, Progress, Worker, WorkerPool


@pytest.fixture
def pool() -> Iterator[WorkerPool]:
    """One process, shared by several workers."""
    made = WorkerPool("worker_tasks")
    yield made
    made.close()


@pytest.fixture
def worker(pool: WorkerPool) -> Worker:
    return Worker(pool)


def ending(worker: Worker, seen: list[Outcome] | None = None) -> Outcome:
    """Outcome of the running task; its progress is appended to ``seen``."""
    outcomes: list[Outcome] = [] if seen is None else seen

    def ended() -> bool:
        outcomes.extend(worker.poll())
        return not worker.busy

    until(ended, "the end of the task")
    return outcomes[-1]


def assert_it_works(worker: Worker) -> None:
    number = worker.submit(tasks.call, operator.add, 1, 1)
    assert ending(worker) == Done(number, 2)


def test_tasks_return_their_results_one_at_a_time(worker: Worker) -> None:
    number = worker.submit(tasks.call, operator.add, 2, 3)
    with pytest.raises(RuntimeError, match="busy"):
        worker.submit(tasks.call, operator.add, 2, 3)
    assert ending(worker) == Done(number, 5)
    second = worker.submit(tasks.call, os.getpid)
    assert second != number
    assert ending(worker) == Done(second, worker.pid)
    assert worker.pool.replaced == 0


def test_progress_comes_in_order(worker: Worker) -> None:
    number = worker.submit(tasks.count, 5)
    seen: list[Outcome] = []
    assert ending(worker, seen) == Done(number, "counted")
    assert seen[:-1] == [Progress(number, step) for step in range(5)]


def test_a_cancelled_task_returns_what_it_has(worker: Worker) -> None:
    worker.submit(tasks.count, 10**6)
    until(worker.poll, "the first progress")
    pid = worker.pid
    worker.cancel()
    outcome = ending(worker)
    assert isinstance(outcome, Done)
    assert outcome.result.startswith("stopped")
    assert worker.pid == pid
    assert_it_works(worker)


def test_an_exception_is_a_failure_and_the_worker_goes_on(worker: Worker) -> None:
    number = worker.submit(tasks.call, operator.truediv, 1, 0)
    assert ending(worker) == Failed(number, "ZeroDivisionError: division by zero")
    number = worker.submit(tasks.call, pathlib.Path("/dev/full").write_text, "1")
    full = "No space left on device: free space there (df -h lists all disks and the shared memory "
    assert ending(worker) == Failed(number, f"{full}/dev/shm)")
    worker.submit(tasks.unpicklable)
    assert isinstance(ending(worker), Failed)
    assert_it_works(worker)
    assert worker.pool.replaced == 0


def test_a_task_beyond_its_budget_is_asked_to_stop(worker: Worker) -> None:
    number = worker.submit(tasks.wait, budget=0.2)
    assert ending(worker) == Done(number, "waited")
    assert worker.pool.replaced == 0


@pytest.mark.parametrize("task", [(tasks.call, time.sleep, 3600.0), (tasks.deaf,)])
def test_a_hanging_worker_is_replaced(
    worker: Worker, task: tuple[Callable[..., object], ...]
) -> None:
    pid = worker.pid
    worker.submit(*task, budget=0.2)
    assert ending(worker) == Failed(1, "the task exceeded its 0.2 s and did not stop when asked to")
    assert is_gone(pid or 0)
    assert_it_works(worker)
    assert worker.pool.replaced == 1
    assert "given up" in worker.take_notices()[0]
    assert worker.take_notices() == []


def test_a_stopped_worker_does_not_block_the_node(worker: Worker) -> None:
    assert_it_works(worker)
    os.kill(worker.pid or 0, signal.SIGSTOP)
    worker.submit(tasks.call, len, b"x" * 10**7, budget=0.2)  # more than a socket's buffer
    assert isinstance(ending(worker), Failed)
    worker.submit(tasks.call, len, b"x" * 10**7)
    assert ending(worker) == Done(3, 10**7)


@pytest.mark.parametrize(
    ("number", "notice"), [(signal.SIGSTOP, "the worker process hangs"), (signal.SIGKILL, "died")]
)
def test_a_worker_that_dies_or_is_stopped_without_a_task_is_replaced(
    worker: Worker, number: signal.Signals, notice: str
) -> None:
    assert_it_works(worker)
    pid = worker.pid or 0
    os.kill(pid, number)
    until(lambda: worker.poll() or worker.pool.replaced, "a new worker")
    assert is_gone(pid)
    assert notice in worker.take_notices()[0]
    assert_it_works(worker)


@pytest.mark.parametrize(
    ("number", "notice"), [(signal.SIGSTOP, "hangs"), (signal.SIGKILL, "starts again")]
)
def test_the_task_of_a_worker_that_dies_or_hangs_starts_again(
    worker: Worker, tmp_path: Path, number: signal.Signals, notice: str
) -> None:
    # No budget is exceeded: a hanging worker is detected by its silence.
    submitted = worker.submit(tasks.once, number, str(tmp_path / "marker"))
    assert ending(worker) == Done(submitted, "second try")
    assert worker.pool.replaced == 1
    assert notice in worker.take_notices()[0]


def test_a_node_that_was_held_up_itself_blames_nobody(worker: Worker) -> None:
    assert_it_works(worker)
    pid = worker.pid or 0
    os.kill(pid, signal.SIGSTOP)
    time.sleep(2.0)
    worker.poll()
    os.kill(pid, signal.SIGCONT)
    assert_it_works(worker)
    assert worker.pool.replaced == 0


def test_a_task_that_kills_the_worker_twice_has_failed(worker: Worker) -> None:
    number = worker.submit(tasks.die)
    assert ending(worker) == Failed(number, "the worker process died")
    assert worker.pool.replaced == 2
    assert_it_works(worker)


def test_the_worker_stays_light(worker: Worker) -> None:
    worker.submit(tasks.modules)
    outcome = ending(worker)
    assert isinstance(outcome, Done)
    assert "rclpy" not in outcome.result
    assert "numpy" not in outcome.result  # only the modules that a task needs


def test_a_closed_worker_leaves_no_process(pool: WorkerPool, worker: Worker) -> None:
    pid = worker.pid or 0
    worker.submit(tasks.call, time.sleep, 3600.0)
    pool.close()
    assert is_gone(pid)
    assert worker.poll() == []
    assert worker.pid is None


@pytest.mark.parametrize("task", ["time.sleep, 3600.0", "sum, range(10**15)"])
def test_the_worker_dies_with_a_killed_parent(task: str) -> None:
    # A long sum holds the interpreter lock, so that no thread of the worker can react.
    script = (
        "import time, worker_tasks\n"
        "from mr_damper_ros.processes.worker import Worker, WorkerPool\n"
        "worker = Worker(WorkerPool('worker_tasks'))\n"
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
        pid = int(parent.stdout.readline())
        assert not is_gone(pid)
        parent.kill()
    until(lambda: is_gone(pid), "the end of the worker")


# -- workers that share a process ----------------------------------------------------------------


def test_first_come_first_served(pool: WorkerPool) -> None:
    first, second, third = (Worker(pool) for _ in range(3))
    first.submit(tasks.wait)
    second.submit(tasks.wait)
    third.submit(tasks.call, operator.add, 1, 1)
    assert [user.waits for user in (first, second, third)] == [False, True, True]
    first.cancel()
    ending(first)
    assert [second.waits, third.waits] == [False, True]


def test_waiting_does_not_count_as_time_of_the_task(pool: WorkerPool) -> None:
    first, second = Worker(pool), Worker(pool)
    first.submit(tasks.wait, budget=0.5)
    number = second.submit(tasks.call, operator.add, 1, 1, budget=0.4)
    ending(first)
    assert ending(second) == Done(number, 2)


def test_a_task_cancelled_while_it_waits_ends_in_its_turn(pool: WorkerPool) -> None:
    first, second = Worker(pool), Worker(pool)
    numbers = [first.submit(tasks.wait), second.submit(tasks.wait)]
    second.cancel()
    first.cancel()
    assert [ending(first), ending(second)] == [Done(number, "waited") for number in numbers]


# -- modules that are not installed ----------------------------------------------------------------


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Path, WorkerPool]]:
    """The file of a module that processes load first, and their pool, in which one is ready."""
    monkeypatch.syspath_prepend(tmp_path)
    file = tmp_path / "loaded_first.py"
    file.write_text("", encoding="utf-8")
    pool = WorkerPool(file.stem)
    until(lambda: pool.supervise() or pool.ready, "a process")
    yield file, pool
    pool.close()


LACKING = "import not_installed"


def test_a_module_that_is_not_installed_is_the_error_of_the_parent(
    module: tuple[Path, WorkerPool],
) -> None:
    file, _ = module
    file.write_text(LACKING, encoding="utf-8")
    with closing(WorkerPool(file.stem)) as pool, pytest.raises(ModuleNotFoundError) as caught:
        until(lambda: pool.supervise(), "the error")
    assert caught.value.name == "not_installed"


def test_a_module_that_is_lost_later_does_not_end_the_parent(
    module: tuple[Path, WorkerPool],
) -> None:
    file, pool = module
    file.write_text(LACKING, encoding="utf-8")
    pid = Worker(pool).pid
    assert pid
    os.kill(pid, signal.SIGKILL)
    until(lambda: pool.supervise() or pool.replaced > 1, "a second replacement")
    assert pool.notices[-1] == "No module named 'not_installed': the worker is replaced"
