"""Limits BLAS to one thread, because with small arrays more threads only wait for each other.

Sums depend on the number of threads, so one thread also gives the same results on every computer.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_lock = threading.Lock()
_limits: list[Any] = []
"""The limit of this process, once for each of its present users."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute with one BLAS thread; also a decorator of functions.

    The process gets its BLAS threads back when the last such context of any Python thread ends.
    """
    _load()
    with _lock:
        _limits.append(_limits[0] if _limits else _limited())
    try:
        yield
    finally:
        with _lock:
            limit = _limits.pop()
            if not _limits:
                limit.restore_original_limits()


def keep_one_thread(*, with_scipy: bool = True) -> None:
    """Make this process compute with one BLAS thread until it ends.

    Importing SciPy takes half a second. Without ``with_scipy`` it is not imported, and the limit
    applies to NumPy, and to SciPy only if it is already loaded.
    """
    if with_scipy:
        _load()
    _limited()


def _load() -> None:
    # SciPy has its own BLAS, and a library loaded later would not be limited.
    import scipy.linalg  # noqa: F401  # imported late: see entry_points


def _limited() -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().limit(limits=1)
