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
    KeptTask,
    ResultFolder,
    WorkersError,
    Workforce,
    file_stem,
    finish,
)

PATIENCE = 60.0
"""Seconds after which a wait fails."""


class Work:
    """Tasks that write a journal line when they begin."""

    def __init__(self, folder: Path, names: list[str], seconds: float = 0.0) -> None:
        self.journal = folder / "journal"
        self.results = ResultFolder(folder / "results")
        self.tasks = [KeptTask(n, "as it is", (str(self.journal), n, seconds)) for n in names]
        self.told: list[str] = []
        self.lost: list[str] = []

    def do(
        self,
        workers: int | Workforce,
        function: Callable[..., dict[str, Any]] = pool_tasks.journalled,
        final: Callable[[dict[str, Any]], bool] = pool_tasks.always,
    ) -> None:
        finish(
            [task for task in self.tasks if self.results.kept(task) is None],
            function,
            workers,
            self.results,
            final=final,
            finished=lambda task, document: self.told.append(document["name"]),
            lost=lambda task: self.lost.append(task.name),
        )

    @property
    def begun(self) -> Counter[str]:
        return Counter(self.journal.read_text().split() if self.journal.exists() else [])

    @property
    def kept(self) -> set[str]:
        return {task.name for task in self.tasks if self.results.kept(task) is not None}


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
    names = {task.name for task in some.tasks}
    assert some.begun == Counter(names)
    assert some.kept == set(some.told) == names
    assert len(some.told) == len(names)


@pytest.mark.parametrize("text", ["", '{"fingerprint": "as it is"', "[]", '"text"'])
def test_a_damaged_file_is_no_result(tmp_path: Path, text: str) -> None:
    some = work(tmp_path, 1)
    some.do(in_threads())
    some.results.path("task0").write_text(text)
    assert some.kept == set()


def test_who_kills_every_process_is_given_up_alone(tmp_path: Path) -> None:
    some = Work(tmp_path, ["task0", "deadly1", "task2"])
    some.do(2, pool_tasks.deadly)
    assert some.lost == ["deadly1"]
    assert some.kept == {"task0", "task2"}


def test_workers_that_can_do_nothing_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(WorkersError, match="RuntimeError: not here"):
        work(tmp_path).do(in_threads(), pool_tasks.unwilling)


def test_an_interrupt_ends_the_processes_and_keeps_what_is_done(tmp_path: Path) -> None:
    some = work(tmp_path, 6, seconds=0.2)

    def interrupt(task: KeptTask, document: dict[str, Any]) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        finish(
            some.tasks,
            pool_tasks.journalled,
            2,
            some.results,
            final=pool_tasks.always,
            finished=interrupt,
            lost=lambda task: None,
        )
    assert 1 <= len(some.kept) < len(some.tasks)


PROGRAM = """
import sys
sys.path[:] = {path!r}
from pathlib import Path
from mr_damper_ros.processes.process_pool import KeptTask, ResultFolder, finish
import pool_tasks

if __name__ == "__main__":
    names = [f"task{{number}}" for number in range({count})]
    tasks = [KeptTask(n, "as it is", ({journal!r}, n, 0.1)) for n in names]
    finish(tasks, pool_tasks.journalled, 2, ResultFolder(Path({results!r})),
           final=pool_tasks.always, finished=lambda *told: None, lost=print)
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
    assert some.kept == {task.name for task in some.tasks}
    assert {name for name in kept if some.begun[name] != begun[name]} == set()


def test_files_of_similar_names_differ() -> None:
    names = ["a/b", "a_b", "a b", "ä", "x" * 300, "x" * 301, "", "."]
    stems = {file_stem(name) for name in names}
    assert len(stems) == len(names)
    assert all(len(stem) < 100 and "/" not in stem for stem in stems)
