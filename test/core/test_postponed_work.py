"""Work that waits a moment, and is done once."""

from __future__ import annotations

import math

import pytest

from mr_damper_ros.processes import deferred as postponed_work
from mr_damper_ros.processes.deferred import PostponedWork


class SteppedClock:
    """A clock that is set."""

    def __init__(self) -> None:
        self.now = 10.0

    def perf_counter(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SteppedClock:
    clock = SteppedClock()
    monkeypatch.setattr(postponed_work, "time", clock)
    return clock


def test_it_waits_until_its_time_has_come(clock: SteppedClock) -> None:
    done: list[str] = []
    rest = PostponedWork()
    rest.postpone(lambda: done.append("rest"))
    left = rest.finish_in_time()
    assert left > 0.0
    assert done == []
    clock.now += left
    assert math.isinf(rest.finish_in_time())
    assert done == ["rest"]


def test_it_is_done_once(clock: SteppedClock) -> None:
    done: list[str] = []
    rest = PostponedWork()
    rest.postpone(lambda: done.append("rest"))
    rest.finish()
    rest.finish()
    clock.now += 1.0
    assert math.isinf(rest.finish_in_time())
    assert done == ["rest"]
