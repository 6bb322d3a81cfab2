"""Reads the matrices of a MAT file, in a process of its own; hands over arrays without objects."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mr_damper_ros.io.confined_reading import limit_memory, limit_time, memory_for, run_confined
from mr_damper_ros.io.raw_table import MAXIMUM_SAMPLES

TIME_LIMIT = 60.0
"""Seconds that reading may take."""

_VERSION_73, _NO_SCIPY, _DAMAGED, _TOO_LARGE = 3, 4, 5, 6
"""Exit codes of the child."""

Matrices = dict[str, NDArray[np.number]]
"""Real matrices (rows, columns) of numbers, by name."""


class MatError(ValueError):
    """A file that cannot be read; the message goes on after the file's name."""


def read_matrices(path: Path, maximum_samples: int = MAXIMUM_SAMPLES) -> Matrices:
    """Return the matrices in a MAT file.

    Raises MatError where it cannot be read, whatever is wrong with it, takes longer than
    :data:`TIME_LIMIT` or more memory than so many samples of a record need, and OSError where
    there is no such file.
    """
    memory = memory_for(maximum_samples)
    code, stream = run_confined(serve, path, str(TIME_LIMIT), str(memory))
    with stream:
        if code == 0:
            names = np.load(stream, allow_pickle=False).tolist()
            return {name: np.load(stream, allow_pickle=False) for name in names}
    raise MatError(_reason(code, memory))


def _reason(code: int, memory: int) -> str:
    if code == _VERSION_73:
        return "is a MAT file of version 7.3: save it in MATLAB with save(..., '-v7') first"
    if code == _NO_SCIPY:
        return "is a MAT file, which needs SciPy: install it, or export the file as CSV"
    if code == _TOO_LARGE:
        return (
            f"needs more than {memory // 1_000_000} MB to be read: save a part of it, or allow "
            "more samples (import_record --maximum-samples)"
        )
    if code == -signal.SIGALRM:
        return f"could not be read within {TIME_LIMIT:g} s: save a part of it, or export it as CSV"
    return "is not a MAT file that can be read: save it again, or export it as CSV"


def serve(time_limit: str, memory_limit: str, result: str) -> None:
    """Be the child, for at most so many seconds and bytes: standard input to the file descriptor.

    What it has loaded itself is not counted.
    """
    limit_time(float(time_limit))
    try:
        from scipy.io import loadmat  # here: see mr_damper_ros.entry_points
    except ImportError:
        raise SystemExit(_NO_SCIPY) from None
    try:
        limit_memory(int(memory_limit))
        content = loadmat(sys.stdin.buffer)
        matrices = {
            name: value
            for name, value in content.items()
            if isinstance(value, np.ndarray) and value.ndim == 2 and value.dtype.kind in "fiu"
        }
        with open(int(result), "wb") as stream:
            for array in (np.array(list(matrices), dtype=np.str_), *matrices.values()):
                np.save(stream, array, allow_pickle=False)
    except MemoryError:
        raise SystemExit(_TOO_LARGE) from None
    except NotImplementedError:
        raise SystemExit(_VERSION_73) from None
    except Exception:
        # Damaged bytes surface in the library as exceptions of many kinds.
        raise SystemExit(_DAMAGED) from None
