"""What the parts of ``make bench`` and ``make soak`` return; ``figures.yaml`` lists all figures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, TypeVar

Value = float | list[float] | None
Measured = dict[str, Value | tuple[Value, str]]
"""Values of figures by key, with or without a note; None if one was not measured."""

Result = TypeVar("Result")

Case = TypeVar("Case")

PROCESSES = 2
"""Number of cores on which the figures are measured."""


def some_of(cases: Sequence[Case], every: int, seed: int) -> Sequence[Case]:
    """One in ``every`` case, the first of them chosen by the seed."""
    return cases[seed % every :: every]


def in_processes(work: Callable[..., Result], *arguments: Iterable[Any]) -> list[Result]:
    """Results of the calls in order, as of ``map``, from fresh processes."""
    with ProcessPoolExecutor(PROCESSES, mp_context=get_context("spawn")) as pool:
        return list(pool.map(work, *arguments))
