"""Settings of a reproduction, and its long tasks, which run in parallel and can be resumed.

A task is a picklable function of keyword arguments that returns JSON values and depends on
nothing else, so the number of workers does not change any result. Results are kept line by line
and used again while neither the tasks nor the code have changed.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy

import mr_damper_ros
from mr_damper_ros.processes.process_pool import ProcessPool, Tell

_FOLDERS = (Path(mr_damper_ros.__file__).parent, Path(__file__).parents[1])
"""Code on which the results depend."""

_ABOVE = ("nodes", "tools")
"""Subpackages on which no result depends."""


@dataclass(frozen=True)
class Settings:
    """Settings: ``runs`` of random methods; ``quick`` for fewer evaluations and cases.

    ``folder`` receives all output. ``recordings`` is the folder ``utfsm`` of real recordings, or
    None. Raises ValueError for values out of range.
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
    """Runs the tasks of a reproduction and reports progress to ``say``."""

    settings: Settings
    say: Callable[[str], None] = field(default=lambda text: None)

    def seeds(self, count: int, purpose: int) -> list[list[int]]:
        """Independent seeds (as entropy lists) for ``count`` runs of one purpose."""
        root = np.random.SeedSequence([self.settings.seed, purpose])
        return [[int(x) for x in child.generate_state(4)] for child in root.spawn(count)]

    def each(self, name: str, function: Callable[..., Any], tasks: Sequence[Task]) -> list[Any]:
        """``function(**task)`` for every task, in order; earlier results are read from disk."""
        keys = [json.dumps(task, sort_keys=True) for task in tasks]
        path = self.settings.folder / "data" / f"{name}-{_code_digest()}.jsonl"
        known = _read(path)
        missing = [place for place, key in enumerate(keys) if key not in known]
        if not missing:
            return [known[key] for key in keys]
        path.parent.mkdir(parents=True, exist_ok=True)
        count = len(tasks) - len(missing)
        with path.open("a", encoding="utf-8") as file:
            file.write("\n")  # begin after the incomplete line of a killed campaign

            def keep(index: int, result: Any) -> None:
                nonlocal count
                key, count = keys[missing[index]], count + 1
                known[key] = result
                file.write(json.dumps([key, result]) + "\n")
                file.flush()
                # About ten lines for a log.
                if count == len(tasks) or count % max(len(missing) // 10, 1) == 0:
                    self.say(f"{name}: {count} of {len(tasks)}")

            with ProcessPool(self.settings.workers) as processes:
                chosen = [tasks[place] for place in missing]
                processes.map(partial(_call, function), chosen, done=keep)
        return [known[key] for key in keys]


def _call(function: Callable[..., Any], task: Task, tell: Tell) -> Any:
    return _plain(function(**task))


def _plain(value: Any) -> Any:
    """The value after a JSON round trip, so that new and stored results are equal."""
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


def code_files() -> list[Path]:
    """The files of code and tables on which the results depend."""
    return [
        path
        for folder in _FOLDERS
        for path in sorted(folder.rglob("*"))
        if path.suffix in (".py", ".csv") and path.relative_to(folder).parts[0] not in _ABOVE
    ]


@lru_cache(maxsize=1)
def _code_digest() -> str:
    """Digest of the code on which the results depend, taken when the program starts."""
    digest = hashlib.sha256(f"{sys.version} {np.__version__} {scipy.__version__}".encode())
    for path in code_files():
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()[:12]
