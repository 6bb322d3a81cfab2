"""Runs loops over samples as machine code if Numba is installed.

The state of a law depends on the previous sample, so array operations cannot replace the loop.
Numba compiles the same loop that also runs without Numba. It is used for windows, which are
evaluated many times. It is not used for blocks of a stream, because loading it takes seconds.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import Any

import numpy as np

from mr_damper_ros.signals.arrays import Array

Loop = Callable[..., Any]

_MACHINE_CODE: ContextVar[bool] = ContextVar("loops run as machine code", default=False)


@contextmanager
def as_machine_code() -> Iterator[None]:
    """Run loops as machine code in this context if Numba is installed; also a decorator."""
    before = _MACHINE_CODE.set(True)
    try:
        yield
    finally:
        _MACHINE_CODE.reset(before)


def runs_machine_code() -> bool:
    """Whether loops run as machine code now, if a compiler is available."""
    return _MACHINE_CODE.get()


def run_loop(
    loop: Loop, called: tuple[Loop, ...], given: Sequence[Array], results: int, *numbers: float
) -> tuple[list[Array], Any]:
    """Run ``loop(*given, *results, *numbers)``; return the filled results (n,) and its value.

    The first element of ``given`` has shape (n,). The loop receives lists, or arrays if it is
    compiled; it may index them and take their length. ``called`` are the functions that it calls,
    which must be in the same file, because the cache on disk does not detect changes in other
    files.
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
    """Whether Numba, the compiler for loops, is installed."""
    return importlib.util.find_spec("numba") is not None


@functools.cache
def machine_code(loop: Loop, called: tuple[Loop, ...]) -> Loop | None:
    """The loop as machine code, cached on disk for later programs; None without Numba."""
    try:
        from numba import njit
        from numba.extending import register_jitable
    except ImportError:
        return None
    for function in called:
        register_jitable(function)
    compiled, cached = njit(error_model="numpy")(loop), None
    with suppress(RuntimeError):  # no writable place for the cache
        cached = njit(cache=True, error_model="numpy")(loop)

    def run(*arguments: Any) -> Any:
        nonlocal cached
        # If the cache is damaged, as after a power failure, or the disk is full, Numba raises
        # exceptions of many types. The loop itself raises none.
        tried = cached
        if tried is not None:
            with suppress(Exception):
                return tried(*arguments)
            with suppress(Exception):
                tried.recompile()  # empties the cache
                return tried(*arguments)
            cached = None
        return compiled(*arguments)

    return run
