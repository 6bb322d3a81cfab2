"""Modules that the nodes import: none is heavy or unused, and BLAS uses one thread."""

import os
import threading
from collections.abc import Iterator

import pool_tasks
import pytest
from fresh_python import alone
from threadpoolctl import ThreadpoolController

from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.processes.process_pool import ProcessPool
from mr_damper_ros.processes.worker import Done, InlineWorker


@pytest.mark.parametrize(
    "modules",
    [
        "mr_damper_ros.tracking.predictor",
        "mr_damper_ros.tracking.tracker, mr_damper_ros.tracking.tracker_state",
        "mr_damper_ros.tracking.identifier, mr_damper_ros.processes.worker",
        "mr_damper_ros.io.bag_reader, mr_damper_ros.io.bag_writer, mr_damper_ros.io.records",
        "mr_damper_ros.rig.sources",
    ],
)
def test_a_node_starts_without_scipy(modules: str) -> None:
    assert "scipy" not in loaded_by(modules)


def test_what_a_source_alone_needs_is_loaded_when_it_is_opened() -> None:
    loaded = loaded_by("mr_damper_ros.rig.sources")
    assert not loaded & {"rosbags", "csv", "serial", "mr_damper_ros.io.records"}


@pytest.mark.parametrize("name", ["check_rig", "watch"])
def test_a_tool_that_needs_ros_says_so_where_it_is_missing(name: str) -> None:
    said = alone(
        "import sys; from contextlib import redirect_stderr; sys.modules['rclpy'] = None; "
        f"sys.argv = [{name!r}]; from mr_damper_ros.entry_points import tool\n"
        f"with redirect_stderr(sys.stdout): code = tool({name!r})\n"
        "print(code)"
    )
    sentence, code = said.splitlines()
    assert "needs ROS 2" in sentence
    assert code == "2"


def loaded_by(modules: str) -> set[str]:
    """All modules in a fresh interpreter after these imports."""
    return set(alone(f"import {modules}; print(*sys.modules)").split())


# -- one BLAS thread during computations, and in workers for their whole life ----------------------

PATIENCE = 60.0
"""Seconds after which a wait fails."""


@pytest.fixture(autouse=True)
def several() -> Iterator[None]:
    """A process with two threads, such as that of a user."""
    with ThreadpoolController().limit(limits=2):
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
