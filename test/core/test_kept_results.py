"""Results stored as they finish: none is lost or computed twice."""

import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pool_tasks
import pytest

from mr_damper_ros.processes.process_pool import (
    WorkersError,
    Workforce,
    file_stem,
    finish,
    store_document,
    stored_document,
)

PATIENCE = 60.0
"""Seconds after which a wait fails."""


class Work:
    """Tasks that write a journal line when they begin, and whose results are stored."""

    def __init__(self, folder: Path, names: list[str], seconds: float = 0.0) -> None:
        self.journal = folder / "journal"
        self.files = {name: folder / "results" / f"{file_stem(name)}.json" for name in names}
        self.tasks = {name: (str(self.journal), name, seconds) for name in names}
        self.told: list[str] = []
        self.lost: list[str] = []

    def do(
        self,
        workers: int | Workforce,
        function: Callable[..., dict[str, Any]] = pool_tasks.journalled,
    ) -> None:
        left = [task for name, task in self.tasks.items() if name not in self.kept]
        for (_, name, _), document in finish(function, left, workers):
            (self.lost if document is None else self.told).append(name)
            if document is not None:
                store_document(self.files[name], "as it is", document)

    @property
    def begun(self) -> Counter[str]:
        return Counter(self.journal.read_text().split() if self.journal.exists() else [])

    @property
    def kept(self) -> set[str]:
        return {n for n, file in self.files.items() if stored_document(file, "as it is")}


def in_threads() -> Workforce:
    return Workforce(ThreadPoolExecutor(2))


def work(folder: Path, count: int = 6, seconds: float = 0.0) -> Work:
    return Work(folder, [f"task{number}" for number in range(count)], seconds)


@pytest.mark.parametrize("workers", [in_threads, lambda: 1, lambda: 2], ids=["any", "1", "2"])
def test_every_task_is_done_told_and_kept_once(
    tmp_path: Path, workers: Callable[[], int | Workforce]
) -> None:
    some = work(tmp_path)
    some.do(workers())
    assert some.begun == Counter(some.tasks.keys())
    assert some.kept == some.tasks.keys()
    assert sorted(some.told) == sorted(some.tasks)


@pytest.mark.parametrize("text", ["", '{"fingerprint": "as it is"', "[]", '"text"'])
def test_a_damaged_file_is_no_result(tmp_path: Path, text: str) -> None:
    some = work(tmp_path, 1)
    some.do(in_threads())
    some.files["task0"].write_text(text)
    assert some.kept == set()


def test_who_kills_every_process_is_given_up_alone(tmp_path: Path) -> None:
    some = Work(tmp_path, ["task0", "deadly1", "task2"])
    some.do(2, pool_tasks.deadly)
    assert some.lost == ["deadly1"]
    assert some.kept == {"task0", "task2"}


def test_workers_that_can_do_nothing_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(WorkersError, match="RuntimeError: not here"):
        work(tmp_path).do(in_threads(), pool_tasks.unwilling)


def test_who_stops_early_ends_the_processes(tmp_path: Path) -> None:
    some = work(tmp_path, 6, seconds=0.2)
    for _ in finish(pool_tasks.journalled, [*some.tasks.values()], 2):
        break
    begun = some.begun
    time.sleep(0.5)
    assert some.begun == begun
    assert len(begun) < len(some.tasks)


PROGRAM = """
import sys
sys.path[:] = {path!r}
from pathlib import Path
from mr_damper_ros.processes.process_pool import file_stem, finish, store_document
import pool_tasks

if __name__ == "__main__":
    tasks = [({journal!r}, f"task{{number}}", 0.1) for number in range({count})]
    for (_, name, _), document in finish(pool_tasks.journalled, tasks, 2):
        store_document(Path({results!r}) / (file_stem(name) + ".json"), "as it is", document)
"""


def test_after_kill_9_of_the_program_the_rest_is_done_and_no_more(tmp_path: Path) -> None:
    count = 12
    script = tmp_path / "program.py"
    places = {"journal": str(tmp_path / "journal"), "results": str(tmp_path / "results")}
    script.write_text(PROGRAM.format(path=sys.path, count=count, **places))
    some = work(tmp_path, count)
    killed = subprocess.Popen([sys.executable, str(script)])
    until = time.monotonic() + PATIENCE
    while len(some.kept) < 3 and time.monotonic() < until:
        time.sleep(0.01)
    killed.send_signal(signal.SIGKILL)
    killed.wait(PATIENCE)
    kept, begun = some.kept, some.begun
    assert 3 <= len(kept) < count
    some.do(in_threads())
    assert some.kept == some.tasks.keys()
    assert {name for name in kept if some.begun[name] != begun[name]} == set()


def test_files_of_similar_names_differ() -> None:
    names = ["a/b", "a_b", "a b", "ä", "x" * 300, "x" * 301, "", "."]
    stems = {file_stem(name) for name in names}
    assert len(stems) == len(names)
    assert all(len(stem) < 100 and "/" not in stem for stem in stems)
