"""Malformed and hostile input: blocks, record files, bags, parameter and state files.

Every case starts from good input and spoils it. It fails where anything but the documented errors
is raised, where it takes longer than a limit, or where a value comes out as valid that is not the
law's. The same seed gives the same cases.
"""

from __future__ import annotations

import math
import random
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks import hostile_files as files
from benchmarks.figure import Figure
from benchmarks.hostile_blocks import HostileStream
from benchmarks.hostile_input import spoilt
from benchmarks.hostile_state import HostileState

TIME_LIMIT = 10.0
"""Seconds after which a case counts as hanging."""

_SHARES = {"blocks": 35, "text": 20, "yaml": 20, "state": 23, "mat": 1, "bag": 1}
"""Parts [%] of the kinds of input."""


def figures(cases: int = 100_000, seed: int = 0) -> list[Figure]:
    """Try so many cases."""
    began = time.monotonic()
    tried, faults = campaign(cases, seed, TIME_LIMIT)
    return [
        Figure(
            "fuzz_cases",
            sum(tried.values()),
            "malformed or hostile blocks, record files (text, MAT, bags), parameter and state "
            "files, of one seed",
            (float(cases), math.inf),
            f"{dict(tried)}, {time.monotonic() - began:.0f} s",
        ),
        Figure(
            "fuzz_failures",
            len(faults),
            "of them, those that ended in any but the documented errors, took longer than "
            f"{TIME_LIMIT:g} s, or let a wrong value pass as valid",
            (0.0, 0.0),
            "; ".join(faults[:3]),
        ),
    ]


def campaign(
    cases: int, seed: int, limit: float | None = None, kinds: tuple[str, ...] = tuple(_SHARES)
) -> tuple[Counter[str], list[str]]:
    """Cases tried of each kind, and what went wrong; ``limit`` [s] is the time of each."""
    chance = random.Random(seed)
    tried: Counter[str] = Counter()
    faults: list[str] = []
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        tries = _tries(chance, Path(folder))
        weights = [_SHARES[kind] for kind in kinds]
        for number in range(cases):
            (kind,) = chance.choices(kinds, weights)
            tried[kind] += 1
            try:
                with _limited(limit):
                    fault = tries[kind]()
            except Exception as error:
                fault = f"{type(error).__name__}: {str(error)[:200]}"
            if fault:
                faults.append(f"case {number}, {kind}: {fault}")
    return tried, faults


@contextmanager
def _limited(seconds: float | None) -> Iterator[None]:
    """Raise TimeoutError in whatever takes longer."""

    def ring(*_: object) -> None:
        raise TimeoutError(f"it takes longer than {seconds} s")

    if seconds is None:
        yield
        return
    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _tries(chance: random.Random, folder: Path) -> dict[str, Callable[[], str]]:
    text, mat, bag = files.record_text(), files.record_mat(), files.record_bag(folder)
    state = HostileState(chance, folder / "states" / "state")
    return {
        "blocks": HostileStream(chance).try_block,
        "text": lambda: files.try_record(chance, folder / "record.csv", spoilt(chance, text)),
        "mat": lambda: files.try_record(chance, folder / "record.mat", spoilt(chance, mat)),
        "bag": lambda: files.try_bag(folder / "record.mcap", spoilt(chance, bag)),
        "yaml": lambda: files.try_yaml(spoilt(chance, files.YAML)),
        "state": state.try_out,
    }
