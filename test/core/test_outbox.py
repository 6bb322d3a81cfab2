"""What waits for the disk goes out in order, and not too late."""

from __future__ import annotations

from mr_damper_ros.processes.deferred import Outbox


class Clock:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def filled(clock: Clock) -> Outbox[str]:
    outbox: Outbox[str] = Outbox(1.0, clock)
    for number, item in enumerate("abc"):
        outbox.add(item, number)
    return outbox


def test_an_item_waits_until_its_state_is_written() -> None:
    outbox = filled(Clock())
    assert outbox.take(written=0) == ["a"]
    assert outbox.take(written=0) == []
    assert outbox.take(written=2) == ["b", "c"]
    assert outbox.late == 0


def test_an_item_does_not_overtake_the_one_before_it() -> None:
    outbox = filled(Clock())
    outbox.add("needs no state", 0)
    assert outbox.take(written=1) == ["a", "b"]


def test_a_disk_that_takes_too_long_holds_nothing_up() -> None:
    clock = Clock()
    outbox = filled(clock)
    clock.now += 0.9
    outbox.add("d", 3)
    clock.now += 0.2
    assert outbox.take(written=0) == ["a", "b", "c"]
    assert outbox.late == 2
    clock.now += 1.0
    assert outbox.take(written=0) == ["d"]
    assert outbox.late == 3


def test_all_can_be_had_at_once() -> None:
    outbox = filled(Clock())
    assert outbox.take_all() == ["a", "b", "c"]
    assert outbox.take(written=9) == []
