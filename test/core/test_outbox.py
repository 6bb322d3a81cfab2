"""Items waiting for the disk are written in order, and the newest is kept."""

import threading

from waiting import SetClock

from mr_damper_ros.processes.files import BackgroundWriter, Outbox


def filled(clock: SetClock) -> Outbox[str]:
    outbox: Outbox[str] = Outbox(1.0, clock)
    for number, item in enumerate("abc"):
        outbox.add(item, number)
    return outbox


def test_an_item_waits_until_its_state_is_written() -> None:
    outbox = filled(SetClock())
    assert outbox.take(written=0) == ["a"]
    assert outbox.take(written=0) == []
    assert outbox.take(written=2) == ["b", "c"]
    assert outbox.late == 0


def test_an_item_does_not_overtake_the_one_before_it() -> None:
    outbox = filled(SetClock())
    outbox.add("needs no state", 0)
    assert outbox.take(written=1) == ["a", "b"]
    assert outbox.take_all() == ["c", "needs no state"]
    assert outbox.take(written=9) == []


def test_a_disk_that_takes_too_long_holds_nothing_up() -> None:
    clock = SetClock()
    outbox = filled(clock)
    clock.now += 0.9
    outbox.add("d", 3)
    clock.now += 0.2
    assert outbox.take(written=0) == ["a", "b", "c"]
    assert outbox.late == 2
    clock.now += 1.0
    assert outbox.take(written=0) == ["d"]
    assert outbox.late == 3


# -- the keeper writes the newest item, and callers never wait for the disk ------------------------

PATIENCE = 30.0


class Disk:
    """A disk that writes only when released."""

    def __init__(self) -> None:
        self.written: list[str] = []
        self.busy = threading.Event()
        self.free = threading.Event()

    def write(self, item: str) -> None:
        self.busy.set()
        assert self.free.wait(PATIENCE)
        if item == "too big":
            raise OSError("the disk is full")
        self.written.append(item)


def test_items_that_come_meanwhile_replace_one_another() -> None:
    disk = Disk()
    keeper = BackgroundWriter(disk.write)
    keeper.keep("first")
    assert disk.busy.wait(PATIENCE)
    for item in ("second", "third"):
        keeper.keep(item)
    assert (keeper.given, keeper.done) == (3, 0)
    assert not keeper.wait(0.0)
    disk.free.set()
    assert keeper.wait(PATIENCE)
    assert disk.written == ["first", "third"]
    assert (keeper.done, keeper.fault) == (3, "")


def test_a_fault_is_told_until_it_is_over() -> None:
    disk = Disk()
    disk.free.set()
    keeper = BackgroundWriter(disk.write)
    keeper.keep("too big")
    assert keeper.wait(PATIENCE)
    assert keeper.fault == "the disk is full"
    keeper.keep("small")
    assert keeper.wait(PATIENCE)
    assert keeper.fault == ""
