"""The frame of every study: options, tasks in processes, stored results, and the final page."""

from __future__ import annotations

import argparse
import hashlib
import json
import pickle
import sys
import textwrap
import time
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import scipy

import mr_damper_ros
from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.processes.files import write_bytes, write_text
from mr_damper_ros.processes.process_pool import Notify, ProcessPool, processor_count
from mr_damper_ros.report.document import Chapter, styled, write_report
from mr_damper_ros.tools.console import program

K = TypeVar("K", bound=Hashable)

_FOLDERS = (Path(mr_damper_ros.__file__).parent, Path(__file__).parent)
"""Code on which the results depend."""

_ABOVE = ("nodes", "tools")
"""Subpackages on which no result depends."""

RUNS, QUICK_RUNS = 100, 10
"""Repetitions of random searches."""


@dataclass
class Campaign:
    """One call of a study: its options, and the processes for its tasks.

    ``folder`` receives all output. ``quick`` asks for fewer evaluations and cases. ``runs`` is the
    number of repetitions of random methods (0: the default). ``figures`` receives numbers for the
    document beside the report. Raises ValueError for values out of range.
    """

    folder: Path
    workers: int = 1
    quick: bool = False
    seed: int = 0
    runs: int = 0
    say: Callable[[str], None] = lambda text: None
    figures: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.runs = self.runs or (QUICK_RUNS if self.quick else RUNS)
        for name, least in (("runs", 2), ("workers", 1), ("seed", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} is {getattr(self, name)}: at least {least} is needed")

    def seeds(self, purpose: int, count: int = 0) -> list[tuple[int, ...]]:
        """Independent seeds (as entropy) for ``count`` runs of one purpose."""
        root = np.random.SeedSequence([self.seed, purpose])
        children = root.spawn(count or self.runs)
        return [tuple(int(x) for x in child.generate_state(4)) for child in children]

    def each(
        self, name: str, function: Callable[..., Any], keys: Iterable[K], **common: Any
    ) -> dict[K, Any]:
        """``function(*key, **common)`` by key, in order, whatever the number of processes.

        A key that is no tuple is a single argument. Results are stored, and reused until the
        arguments or the code change.
        """
        folder = self.folder / "data" / f"{name}-{_code_digest()}"
        tasks = {key: key if isinstance(key, tuple) else (key,) for key in keys}
        with np.printoptions(precision=17, threshold=sys.maxsize):
            texts = [repr((task, common)) for task in tasks.values()]
        names = [hashlib.sha256(text.encode()).hexdigest()[:16] for text in texts]
        paths = {key: folder / f"{name}.pickle" for key, name in zip(tasks, names, strict=True)}
        missing = [key for key, path in paths.items() if not path.exists()]
        count = len(tasks) - len(missing)

        def keep(place: int, result: Any) -> None:
            nonlocal count
            write_bytes(paths[missing[place]], pickle.dumps(result))
            count += 1
            # About ten lines for a log.
            if count == len(tasks) or count % max(len(missing) // 10, 1) == 0:
                self.say(f"{name}: {count} of {len(tasks)}")

        try:
            with ProcessPool(self.workers) as processes:
                given = [tasks[key] for key in missing]
                processes.map(partial(_call, function, common), given, done=keep)
        except KeyboardInterrupt:
            self.say("finished tasks are stored: call again to continue")
            raise
        return {key: pickle.loads(path.read_bytes()) for key, path in paths.items()}


def _call(
    function: Callable[..., Any], common: Mapping[str, Any], task: tuple[Any, ...], notify: Notify
) -> Any:
    return function(*task, **common)


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


def study(
    name: str,
    description: str,
    title: str,
    notice: Callable[[Campaign], str],
    parts: Mapping[str, str],
    quick: str,
    *,
    random: bool = False,
) -> Callable[..., int]:
    """The program of a study, which takes command-line arguments and returns the exit code.

    The ``parts`` name functions that return the chapters of a part of the report; their modules are
    loaded when the part is made. ``notice`` returns the paragraph above the report. ``quick``
    describes what the short variant leaves out; ``random`` adds the options of random searches. The
    program writes ``report.html`` and, if parts have figures, ``<name>.json``.
    """

    def options(parser: argparse.ArgumentParser) -> None:
        add, names = parser.add_argument, tuple(parts)
        add("--only", choices=names, nargs="+", default=names, help="only these parts")
        add("--quick", action="store_true", help=f"quick variant: {quick}")
        workers = "processes; the results do not depend on it (default: one per core)"
        add("--workers", type=int, default=processor_count(), help=workers)
        output = "folder for report.html, figures and tables (default %(default)s)"
        add("--output", type=Path, default=Path("build", name), metavar="FOLDER", help=output)
        if random:
            runs = f"repetitions of random searches (default {RUNS}, quick {QUICK_RUNS})"
            add("--runs", type=int, default=0, help=runs)
            add("--seed", type=int, default=0, help="seed of the random numbers (default 0)")

    @one_thread()
    def run(given: argparse.Namespace) -> int:
        began = time.monotonic()
        seed, runs = getattr(given, "seed", 0), getattr(given, "runs", 0)
        campaign = Campaign(given.output, given.workers, given.quick, seed, runs, say)
        told, chapters = notice(campaign), list[Chapter]()
        with styled():
            for part in (each for each in parts if each in given.only):
                say(f"{part} ...")
                module, _, function = parts[part].rpartition(".")
                chapters += getattr(import_module(f"studies.{module}"), function)(campaign)
            page = write_report(campaign.folder, title, told, chapters)
        if campaign.figures:
            document = {"quick": campaign.quick, **campaign.figures}
            text = json.dumps(document, indent=2, allow_nan=False)
            write_text(campaign.folder / f"{name}.json", text + "\n")
        say("")
        print(f"{page} written in {time.monotonic() - began:.0f} s")
        return 0

    told = f"{description} Results are stored, so a stopped study continues from them."
    return program(f"studies {name}", textwrap.fill(told, 79), options, run)


def say(text: str) -> None:
    """Progress display: a single updated line on a terminal, separate lines elsewhere.

    An empty text clears the line.
    """
    if sys.stderr.isatty():
        sys.stderr.write(f"\r{text}\033[K")
    elif text:
        sys.stderr.write(f"{text}\n")
    sys.stderr.flush()
