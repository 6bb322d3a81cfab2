"""Files are written completely or not at all; items wait for the disk in order."""

import re
import resource
import threading
from pathlib import Path
from typing import NoReturn

import pytest
from waiting import SetClock

from mr_damper_ros.processes.files import BackgroundWriter, Outbox, write_text


def test_a_file_is_written_with_its_folders(tmp_path: Path) -> None:
    write_text(tmp_path / "new" / "folder" / "page.html", "wärmer")
    assert (tmp_path / "new" / "folder" / "page.html").read_text("utf-8") == "wärmer"


def test_a_full_disk_is_an_error_of_the_file(tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(OSError, match=re.escape(str(tmp_path / "page.html"))):
            write_text(tmp_path / "page.html", 2000 * "a")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_write_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "page.html"
    write_text(path, "before")

    def interrupted(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_text(path, "after")
    assert path.read_text("utf-8") == "before"
    assert list(tmp_path.iterdir()) == [path]


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
