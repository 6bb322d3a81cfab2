"""One thread of BLAS: the arrays here are small, and more threads would wait for each other.

The same sums come out on every computer, too: they depend on the number of threads.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_lock = threading.Lock()
_users = 0
_limits: Any = None


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute with one thread of BLAS; also a decorator of functions.

    The process gets its threads back when the last of those that compute, in whatever threads of
    Python, has ended.
    """
    _load()
    global _users, _limits
    with _lock:
        if _users == 0:
            _limits = _limited()
        _users += 1
    try:
        yield
    finally:
        with _lock:
            _users -= 1
            if _users == 0:
                _limits.restore_original_limits()


def keep_one_thread(*, with_scipy: bool = True) -> None:
    """Have this process compute with one thread of BLAS for all its life.

    Without SciPy, which takes half a second to load, it holds for NumPy, and for SciPy where that
    is loaded already.
    """
    if with_scipy:
        _load()
    _limited()


def _load() -> None:
    # Its BLAS is another than NumPy's, and what is loaded later would not be limited.
    import scipy.linalg  # noqa: F401  # here: see mr_damper_ros.entry_points


def _limited() -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().limit(limits=1)
