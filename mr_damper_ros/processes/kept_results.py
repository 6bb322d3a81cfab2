"""Many independent tasks whose results are kept, each in a file of its own, as they finish.

What is kept is never done again, however the program ended: a result is there when its file is,
and a file appears whole or not at all. A task is a picklable argument of a picklable function that
returns a JSON document and raises nothing; what it cannot do is part of its document.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.processes.files import write_text
from mr_damper_ros.processes.process_pool import Workforce

Document = dict[str, Any]

_SUSPECT = 2
"""A task that has been under way so often when a process died is done alone from then on."""

_GIVEN_UP = 4
"""A task that has been under way so often when a process died is not tried again."""

_SLUG = 60
"""Characters of a task's name that show in the name of its file."""


@dataclass(frozen=True)
class KeptTask:
    """``name`` tells tasks apart; ``fingerprint`` changes with whatever the result depends on."""

    name: str
    fingerprint: str
    argument: Any


class WorkersError(OSError):
    """The workers cannot do any task; the message says why."""


class ResultFolder:
    """One file for each finished task: its document, and the fingerprint that it was made for."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def path(self, name: str) -> Path:
        """File of the task of this name."""
        return self._folder / f"{file_stem(name)}.json"

    def kept(self, task: KeptTask) -> Document | None:
        """The document of a task, None where it is to be done."""
        try:
            found = json.loads(self.path(task.name).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        if not isinstance(found, dict) or found.get("fingerprint") != task.fingerprint:
            return None
        document = found.get("document")
        return document if isinstance(document, dict) else None

    def keep(self, task: KeptTask, document: Document) -> None:
        """Write the document of a task, whole or not at all. Raises OSError."""
        entry = {"fingerprint": task.fingerprint, "document": document}
        write_text(self.path(task.name), json.dumps(entry, allow_nan=False) + "\n")


def file_stem(name: str) -> str:
    """A name for a file, readable and different for different names."""
    slug = re.sub(r"[^\w.=+-]+", "_", name).strip("._")[:_SLUG]
    return f"{slug}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def finish(
    tasks: Iterable[KeptTask],
    function: Callable[[Any], Document],
    workforce: Workforce,
    results: ResultFolder,
    *,
    final: Callable[[Document], bool],
    finished: Callable[[KeptTask, Document], None],
    lost: Callable[[KeptTask], None],
) -> None:
    """Do the tasks and keep their documents; ``finished`` hears of each as soon as it is there.

    Where ``final`` says no, a document is told of and not kept, so that its task is done again the
    next time. A task whose process dies with it again and again is given up, and ``lost`` hears of
    it. Raises WorkersError where the workers can do nothing at all, and OSError where a result
    cannot be written.
    """
    call = _Call(function, results if workforce.shares_folders else None, final)
    waiting, suspects = deque(tasks), deque[KeptTask]()
    losses: Counter[str] = Counter()
    under_way: dict[Future[Document], KeptTask] = {}
    executor = workforce.start()
    try:
        while waiting or suspects or under_way:
            broken = False
            try:
                while waiting and len(under_way) < workforce.at_once:
                    under_way[executor.submit(call, waiting[0])] = waiting[0]
                    waiting.popleft()
                if suspects and not under_way:
                    under_way[executor.submit(call, suspects[0])] = suspects[0]
                    suspects.popleft()
            except workforce.breaks_with:
                broken = True
            done = wait(under_way, return_when=FIRST_COMPLETED).done if under_way else set()
            for future in done:
                task = under_way.pop(future)
                try:
                    document = future.result()
                except workforce.breaks_with:
                    broken = True
                    under_way[future] = task
                except workforce.loses_with:
                    lost(task)
                except (Exception, CancelledError) as error:
                    raise WorkersError(
                        f"the workers cannot do the tasks: {type(error).__name__}: {error}"
                    ) from error
                else:
                    if not workforce.shares_folders and final(document):
                        results.keep(task, document)
                    finished(task, document)
            if broken:
                _sort_out(under_way, results, losses, waiting, suspects, finished, lost)
                executor = workforce.start()
    finally:
        for future in under_way:
            future.cancel()
        workforce.end()


def _sort_out(
    under_way: dict[Future[Document], KeptTask],
    results: ResultFolder,
    losses: Counter[str],
    waiting: deque[KeptTask],
    suspects: deque[KeptTask],
    finished: Callable[[KeptTask, Document], None],
    lost: Callable[[KeptTask], None],
) -> None:
    """A process has died and taken all with it: what was under way is done again, or given up."""
    for task in under_way.values():
        # It may have been finished and kept before its process could say so.
        document = results.kept(task)
        if document is not None:
            finished(task, document)
            continue
        losses[task.name] += 1
        if losses[task.name] >= _GIVEN_UP:
            lost(task)
        elif losses[task.name] >= _SUSPECT:
            suspects.append(task)
        else:
            waiting.appendleft(task)
    under_way.clear()


@dataclass(frozen=True)
class _Call:
    """What a worker does: the task, and where the folder is shared, the keeping too."""

    function: Callable[[Any], Document]
    results: ResultFolder | None
    final: Callable[[Document], bool]

    def __call__(self, task: KeptTask) -> Document:
        with one_thread():  # of a process that may be another's
            document = self.function(task.argument)
        if self.results is not None and self.final(document):
            self.results.keep(task, document)
        return document


def fingerprint(content: Mapping[str, Any]) -> str:
    """A short text that changes with the content, which JSON must be able to hold."""
    text = json.dumps(content, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:24]
