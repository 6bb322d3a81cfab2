"""Tasks in several processes: the same results in the same order, progress, stop, errors."""

from collections.abc import Iterator
from typing import Any

import pool_tasks
import pytest

from mr_damper_ros.processes.process_pool import ProcessPool
from mr_damper_ros.processes.worker import Done

COUNTS = (1, 2)


@pytest.fixture(scope="module", params=COUNTS)
def processes(request: pytest.FixtureRequest) -> Iterator[ProcessPool]:
    with ProcessPool(request.param) as several:
        yield several


def test_results_come_in_the_order_of_the_tasks(processes: ProcessPool) -> None:
    seeds = [5, 3, 8, 1, 9, 2, 7]
    expected = [pool_tasks.sum_of_seed(seed, lambda news: True) for seed in seeds]
    assert processes.map(pool_tasks.sum_of_seed, seeds) == expected


def test_what_tasks_tell_is_heard_with_their_index(processes: ProcessPool) -> None:
    heard: list[tuple[int, Any]] = []

    def listen(index: int, news: Any) -> bool:
        heard.append((index, news))
        return True

    processes.map(pool_tasks.sum_of_seed, [11, 12, 13, 14], listen)
    assert sorted(heard) == [(0, 11), (1, 12), (2, 13), (3, 14)]


def test_an_error_of_a_task_is_raised(processes: ProcessPool) -> None:
    with pytest.raises(ValueError, match="two is not allowed"):
        processes.map(pool_tasks.failing, [1, 2, 3])


def test_an_error_ends_the_other_tasks_but_not_the_pool() -> None:
    with ProcessPool(2) as several:
        with pytest.raises(ValueError, match="not for long"):
            several.map(pool_tasks.patient, [60.0, -1.0, 60.0, 60.0])
        assert several.map(pool_tasks.patient, [0.0, 0.0]) == ["done", "done"]


@pytest.mark.parametrize("count", COUNTS)
def test_a_stop_ends_those_that_run_and_begins_no_other(count: int) -> None:
    with ProcessPool(count) as several:
        results = several.map(pool_tasks.patient, [60.0] * 8, lambda index, news: False)
    begun = [result for result in results if result is not None]
    assert 1 <= len(begun) < 8
    assert set(begun) == {"stopped"}


def test_a_task_that_kills_every_process_fails_alone() -> None:
    with ProcessPool(2) as several:
        outcomes = {each.task: each for each in several.outcomes(pool_tasks.deadly, [1, 2, 3])}
    assert outcomes[0] == Done(0, 1)
    assert outcomes[2] == Done(2, 3)
    assert "died at every attempt" in outcomes[1].reason


def test_a_task_that_cannot_be_pickled_fails_alone() -> None:
    with ProcessPool(2) as several:
        outcomes = {
            each.task: each for each in several.outcomes(pool_tasks.sum_of_seed, [lambda: 1, 5])
        }
    assert "cannot be pickled" in outcomes[0].reason
    assert isinstance(outcomes[1], Done)
