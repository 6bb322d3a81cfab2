"""The keeper writes the newest item, and nobody waits for the disk."""

from __future__ import annotations

import threading

from mr_damper_ros.processes.deferred import BackgroundWriter

PATIENCE = 30.0


class Disk:
    """A disk that writes when it is let."""

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
    keeper.close(PATIENCE)


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
    keeper.close(PATIENCE)


def test_what_waits_is_written_before_the_end() -> None:
    disk = Disk()
    keeper = BackgroundWriter(disk.write)
    keeper.keep("first")
    assert disk.busy.wait(PATIENCE)
    keeper.keep("last")
    disk.free.set()
    keeper.close(PATIENCE)
    assert disk.written == ["first", "last"]
