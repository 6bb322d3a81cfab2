"""One BLAS thread during computations, and in workers for their whole life."""

import os
import threading
from collections.abc import Iterator

import pool_tasks
import pytest

from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.processes.process_pool import ProcessPool
from mr_damper_ros.processes.worker import Done, InlineWorker

threadpoolctl = pytest.importorskip("threadpoolctl")

PATIENCE = 60.0
"""Seconds after which a wait fails."""


@pytest.fixture(autouse=True)
def several() -> Iterator[None]:
    """A process with two threads, such as that of a user."""
    with threadpoolctl.ThreadpoolController().limit(limits=2):
        if not pool_tasks.threads():
            pytest.skip("the BLAS of this computer has no threads")
        yield


def test_a_block_has_one_thread_and_the_rest_all() -> None:
    with one_thread():
        assert pool_tasks.threads() == 1
    assert pool_tasks.threads() == 2


def test_after_an_error_the_process_has_its_threads_again() -> None:
    @one_thread()
    def failing() -> None:
        raise ValueError("so it is")

    with pytest.raises(ValueError, match="so it is"):
        failing()
    assert pool_tasks.threads() == 2


def test_of_several_that_compute_the_last_gives_the_threads_back() -> None:
    begun, may_end = threading.Event(), threading.Event()

    @one_thread()
    def other() -> None:
        begun.set()
        may_end.wait(PATIENCE)

    thread = threading.Thread(target=other)
    with one_thread():
        thread.start()
        assert begun.wait(PATIENCE)
    assert pool_tasks.threads() == 1
    may_end.set()
    thread.join()
    assert pool_tasks.threads() == 2


def test_the_jobs_of_an_engine_have_one_thread() -> None:
    worker = InlineWorker(lambda _: 0.0)
    number = worker.submit(pool_tasks.threads, None)
    assert worker.poll() == [Done(number, 1)]
    assert pool_tasks.threads() == 2


def test_processes_of_pools_have_one_thread_and_the_environment_is_the_callers() -> None:
    before = dict(os.environ)
    with ProcessPool(2) as pool:
        assert pool.map(pool_tasks.threads, [1, 2]) == [1, 1]
    assert dict(os.environ) == before
