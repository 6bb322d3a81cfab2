"""Settings of a reproduction, and its long tasks: in parallel, kept on disk, gone on with.

A task is a picklable function of keyword arguments that returns JSON values and depends on
nothing else, so the number of workers does not change any result. Results are kept line by line
and used again while neither the tasks nor the code have changed.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import resources
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

_CODE = ("damper", "damper/models", "kinematics", "identification", "rig", "thesis")


@dataclass(frozen=True)
class Settings:
    """``runs``: repetitions of what is random; ``quick``: fewer evaluations, generations and cases.

    ``folder`` holds everything that is written; ``recordings`` is the folder ``utfsm`` of real
    recordings, or None. Raises ValueError for values out of range.
    """

    folder: Path
    runs: int = 100
    workers: int = 1
    seed: int = 0
    quick: bool = False
    recordings: Path | None = None

    def __post_init__(self) -> None:
        for name, least in (("runs", 2), ("workers", 1), ("seed", 0)):
            value = getattr(self, name)
            if value < least:
                raise ValueError(f"{name} is {value}: at least {least} is needed")


Task = dict[str, Any]


@dataclass
class Campaign:
    """Runs the tasks of a reproduction; ``say`` hears of the progress."""

    settings: Settings
    say: Callable[[str], None] = field(default=lambda text: None)

    def seeds(self, count: int, purpose: int) -> list[list[int]]:
        """Independent seeds (as entropy lists) for ``count`` runs of one purpose."""
        root = np.random.SeedSequence([self.settings.seed, purpose])
        return [[int(x) for x in child.generate_state(4)] for child in root.spawn(count)]

    def each(self, name: str, function: Callable[..., Any], tasks: Sequence[Task]) -> list[Any]:
        """``function(**task)`` for every task, in order; those done earlier are read from disk."""
        keys = [json.dumps(task, sort_keys=True) for task in tasks]
        path = self.settings.folder / "data" / f"{name}-{_code_digest()}.jsonl"
        known = _read(path)
        missing = [place for place, key in enumerate(keys) if key not in known]
        if missing:
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("a", encoding="utf-8") as file:
                file.write("\n")  # after the incomplete line of a campaign that was killed
                for done, (place, result) in enumerate(
                    self._results(function, tasks, missing), start=1
                ):
                    known[keys[place]] = result
                    file.write(json.dumps([keys[place], result]) + "\n")
                    file.flush()
                    # Ten lines at most for a log.
                    if done % max(len(missing) // 10, 1) == 0:
                        self.say(f"{name}: {len(tasks) - len(missing) + done} of {len(tasks)}")
        return [known[key] for key in keys]

    def _results(
        self, function: Callable[..., Any], tasks: Sequence[Task], missing: Sequence[int]
    ) -> Any:
        if self.settings.workers == 1 or len(missing) == 1:
            for place in missing:
                yield place, _plain(function(**tasks[place]))
            return
        # One thread each: the libraries' own threads would only get in each other's way.
        for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
            os.environ.setdefault(variable, "1")
        pool = ProcessPoolExecutor(
            self.settings.workers, mp_context=get_context("spawn"), initializer=_ignore_interrupts
        )
        try:
            waiting = {pool.submit(_call, function, tasks[place]): place for place in missing}
            for future in as_completed(waiting):
                yield waiting[future], future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _call(function: Callable[..., Any], task: Task) -> Any:
    return _plain(function(**task))


def _ignore_interrupts() -> None:
    # Ctrl-C goes to all processes of a terminal; the first one decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _plain(value: Any) -> Any:
    """The value as JSON gives it back, so that fresh and kept results are the same."""
    return json.loads(json.dumps(value))


def _read(path: Path) -> dict[str, Any]:
    known: dict[str, Any] = {}
    if path.exists():
        for line in path.read_text("utf-8").splitlines():
            try:
                key, result = json.loads(line)
            except ValueError:
                continue  # empty, or incomplete
            known[key] = result
    return known


@lru_cache(maxsize=1)
def _code_digest() -> str:
    """Digest of the code that the results depend on, as it is when the program starts."""
    digest = hashlib.sha256(sys.version.encode() + np.__version__.encode())
    root = resources.files("mr_damper_ros")
    for folder in _CODE:
        entries = sorted(root.joinpath(folder).iterdir(), key=lambda entry: entry.name)
        for entry in entries:
            if entry.name.endswith((".py", ".csv")):
                digest.update(entry.read_bytes())
    return digest.hexdigest()[:12]
