"""Tasks of a study in processes, with their results by task."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

from mr_damper_ros.processes.process_pool import ProcessPool, Tell

Task = TypeVar("Task")
Result = TypeVar("Result")
Say = Callable[[str], None]


def each_result(
    pool: ProcessPool,
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    name: str,
    say: Say,
) -> dict[Task, Result]:
    """Results by their tasks."""
    count = 0

    def done(_: int, __: Result) -> None:
        nonlocal count
        count += 1
        say(f"{name}: {count} of {len(tasks)}")

    work = [(function, task) for task in tasks]
    results = pool.map(_call, work, done=done)
    return {task: result for task, result in zip(tasks, results, strict=True) if result is not None}


def _call(work: tuple[Callable[[Task], Result], Task], tell: Tell) -> Result:
    function, task = work
    return function(task)
