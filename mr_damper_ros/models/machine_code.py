"""Loops over samples as machine code, where Numba is installed.

The state of a law goes on from sample to sample, which no operation on arrays replaces. Numba
compiles such a loop as it stands: it is written once, and runs without Numba as well. It is for
windows, which are followed many times: to load it takes seconds, which no block may wait for.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, cast

import numpy as np

from mr_damper_ros.signals.arrays import Array

Loop = Callable[..., Any]

_MACHINE_CODE: ContextVar[bool] = ContextVar("loops run as machine code", default=False)


@contextmanager
def as_machine_code() -> Iterator[None]:
    """Loops run as machine code meanwhile, where Numba is installed; also decorates a function."""
    before = _MACHINE_CODE.set(True)
    try:
        yield
    finally:
        _MACHINE_CODE.reset(before)


def runs_machine_code() -> bool:
    """Whether loops run as machine code now, where there is any."""
    return _MACHINE_CODE.get()


def run_loop(
    loop: Loop, called: tuple[Loop, ...], given: Sequence[Array], results: int, *numbers: float
) -> tuple[list[Array], Any]:
    """Run ``loop(*given, *results, *numbers)``: the results (n,) that it fills, what it returns.

    The first of ``given`` has shape (n,). The loop gets lists, or arrays where it is compiled: it
    may index them and ask for their length. ``called`` are the functions that it calls, which must
    stand in its file: a change of theirs in another one would not be noticed.
    """
    count = len(given[0])
    machine = machine_code(loop, called) if runs_machine_code() else None
    if machine is not None:
        filled = [np.empty(count) for _ in range(results)]
        arrays = (np.ascontiguousarray(values, dtype=float) for values in given)
        return filled, machine(*arrays, *filled, *numbers)
    lists = [[0.0] * count for _ in range(results)]
    returned = loop(*(values.tolist() for values in given), *lists, *numbers)
    return [np.array(values) for values in lists], returned


def is_available() -> bool:
    """Whether there is a compiler for loops: Numba is installed."""
    return importlib.util.find_spec("numba") is not None


@functools.cache
def machine_code(loop: Loop, called: tuple[Loop, ...]) -> Loop | None:
    """The loop as machine code, kept on disk for the next program; None without Numba."""
    try:
        from numba import njit
        from numba.extending import register_jitable
    except ImportError:
        return None
    for function in called:
        register_jitable(function)
    try:
        kept = njit(cache=True, error_model="numpy")(loop)
    except RuntimeError:  # there is no place on disk to keep it
        return cast(Loop, njit(error_model="numpy")(loop))
    return _KeptLoop(kept, njit(error_model="numpy")(loop))


class _KeptLoop:
    """A loop that is compiled at its first call, unless it is found on disk.

    What is there may be damaged, by a power failure for one, or the disk may be full: Numba then
    raises whatever it likes. The loop itself raises nothing.
    """

    def __init__(self, kept: Any, not_kept: Loop) -> None:
        self._kept = kept
        self._not_kept = not_kept

    def __call__(self, *arguments: Any) -> Any:
        if self._kept is not None:
            try:
                return self._kept(*arguments)
            except Exception:
                return self._called_afresh(arguments)
        return self._not_kept(*arguments)

    def _called_afresh(self, arguments: tuple[Any, ...]) -> Any:
        try:
            self._kept.recompile()  # what is on disk is forgotten
            return self._kept(*arguments)
        except Exception:
            self._kept = None
            return self._not_kept(*arguments)
