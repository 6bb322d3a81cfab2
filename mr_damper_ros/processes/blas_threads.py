"""Limits BLAS to one thread, because with small arrays more threads only wait for each other.

Sums depend on the number of threads, so one thread also gives the same results on every computer.
"""

from __future__ import annotations

import ctypes
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_USERS = ("numpy.linalg._umath_linalg", "scipy.linalg._fblas")
"""Extension modules linked to the BLAS of NumPy and of SciPy, which may be two libraries."""

_FUNCTIONS = (
    ("openblas_get_num_threads", "openblas_set_num_threads"),
    ("openblas_get_num_threads64_", "openblas_set_num_threads64_"),
    ("scipy_openblas_get_num_threads", "scipy_openblas_set_num_threads"),
    ("scipy_openblas_get_num_threads64_", "scipy_openblas_set_num_threads64_"),
    ("MKL_Get_Max_Threads", "MKL_Set_Num_Threads"),
)
"""Functions of OpenBLAS, by its names in the wheels of NumPy and SciPy, and of MKL."""

_lock = threading.Lock()
_limits: list[Callable[[], None]] = []
"""Functions that undo the limit of this process, one for each of its present users."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute with one BLAS thread; also a decorator of functions.

    The process gets its BLAS threads back when the last such context of any Python thread ends.
    """
    _load()
    with _lock:
        _limits.append(_limits[0] if _limits else _limit())
    try:
        yield
    finally:
        with _lock:
            restore = _limits.pop()
            if not _limits:
                restore()


def keep_one_thread(*, with_scipy: bool = True) -> None:
    """Make this process compute with one BLAS thread until it ends.

    Importing SciPy takes half a second. Without ``with_scipy`` it is not imported, and the limit
    applies only to what is already loaded.
    """
    if with_scipy:
        _load()
    _limit()


def _load() -> None:
    # SciPy has its own BLAS, and a library loaded later would not be limited.
    import scipy.linalg  # noqa: F401  # imported late: see entry_points


def _limit() -> Callable[[], None]:
    """Limit the libraries that are loaded; returns the function that undoes this."""
    limited: list[tuple[Callable[[int], object], int]] = []
    for user in _USERS:
        if user in sys.modules:
            # The system's loader also searches the libraries that the module is linked to.
            library = ctypes.CDLL(sys.modules[user].__file__)
            for getter, setter in _FUNCTIONS:
                if hasattr(library, setter):
                    limited.append((library[setter], library[getter]()))
                    library[setter](1)

    def restore() -> None:
        for set_threads, count in limited:
            set_threads(count)

    return restore
