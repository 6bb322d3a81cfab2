"""Workers that many share: turns, budgets, deaths, cancelled tasks, and who hears of what."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from mr_damper_ros.processes.worker import Done, Outcome, Progress, Worker, WorkerPool

PATIENCE = 30.0
"""Deadline [s] of everything that is waited for; generous, for a loaded machine."""

TASKS = """
import os, time

def say(value, control):
    control.report(value)
    return value, os.getpid()

def wait(control):
    while not control.should_stop():
        time.sleep(0.01)
    return "waited"
"""


@pytest.fixture
def tasks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A module of tasks that the workers can import too."""
    (tmp_path / "pool_trial_tasks.py").write_text(TASKS)
    monkeypatch.syspath_prepend(str(tmp_path))
    sys.modules.pop("pool_trial_tasks", None)
    import pool_trial_tasks

    return pool_trial_tasks


@pytest.fixture
def make_pool(tasks: Any) -> Iterator[Callable[[int], WorkerPool]]:
    """Make pools that are closed after the test."""
    pools: list[WorkerPool] = []

    def make(count: int) -> WorkerPool:
        pools.append(WorkerPool("pool_trial_tasks", count))
        return pools[-1]

    yield make
    for pool in pools:
        pool.close()


def endings(workers: list[Worker]) -> list[Outcome]:
    """Poll all of them until each task has ended; the last outcome of each."""
    found: dict[int, Outcome] = {}
    deadline = time.monotonic() + PATIENCE
    while len(found) < len(workers):
        assert time.monotonic() < deadline
        for place, worker in enumerate(workers):
            for outcome in worker.poll():
                if not isinstance(outcome, Progress):
                    found[place] = outcome
        time.sleep(0.005)
    return [found[place] for place in range(len(workers))]


def test_first_come_first_served(make_pool: Callable[[int], WorkerPool], tasks: Any) -> None:
    pool = make_pool(1)
    first, second, third = (pool.worker() for _ in range(3))
    first.submit(tasks.wait)
    second.submit(tasks.wait)
    third.submit(tasks.say, 3)
    assert not first.waits
    assert second.waits
    assert third.waits
    first.cancel()
    endings([first])
    assert not second.waits
    assert third.waits


def test_waiting_does_not_count_as_time_of_the_task(
    make_pool: Callable[[int], WorkerPool], tasks: Any
) -> None:
    pool = make_pool(1)
    first, second = pool.worker(), pool.worker()
    first.submit(tasks.wait, budget=0.5)
    second.submit(tasks.say, 2, budget=0.4)
    ended = endings([first, second])
    assert isinstance(ended[1], Done)


def test_a_task_cancelled_while_it_waits_ends_in_its_turn(
    make_pool: Callable[[int], WorkerPool], tasks: Any
) -> None:
    pool = make_pool(1)
    first, second = pool.worker(), pool.worker()
    first.submit(tasks.wait)
    second.submit(tasks.wait)
    second.cancel()
    first.cancel()
    assert endings([first, second]) == [Done(1, "waited"), Done(1, "waited")]


def test_a_killed_process_is_replaced_and_its_task_done_again(
    make_pool: Callable[[int], WorkerPool], tasks: Any
) -> None:
    pool = make_pool(1)
    user = pool.worker()
    user.submit(tasks.say, 1)
    endings([user])
    user.submit(tasks.wait)
    assert user.pid is not None
    os.kill(user.pid, signal.SIGKILL)
    deadline = time.monotonic() + PATIENCE
    while pool.replaced == 0:
        assert time.monotonic() < deadline
        assert user.poll() == []
        time.sleep(0.005)
    user.cancel()
    assert endings([user]) == [Done(2, "waited")]
    assert any("starts again" in notice for notice in user.take_notices())


def test_an_idle_process_that_dies_is_replaced(
    make_pool: Callable[[int], WorkerPool], tasks: Any
) -> None:
    pool = make_pool(1)
    user, other = pool.worker(), pool.worker()
    user.submit(tasks.say, 1)
    (ended,) = endings([user])
    assert isinstance(ended, Done)
    os.kill(ended.result[1], signal.SIGKILL)
    deadline = time.monotonic() + PATIENCE
    while pool.replaced == 0:
        assert time.monotonic() < deadline
        other.poll()
        time.sleep(0.005)
    other.submit(tasks.say, 2)
    assert isinstance(endings([other])[0], Done)


def test_one_task_at_a_time_for_each(make_pool: Callable[[int], WorkerPool], tasks: Any) -> None:
    user = make_pool(1).worker()
    user.submit(tasks.say, 1)
    with pytest.raises(RuntimeError, match="busy"):
        user.submit(tasks.say, 2)
