"""Reads the matrices of a MAT file, in a process of its own.

SciPy's reader believes what a file says of itself: a malformed one can end the process that reads
it (a segmentation fault), or keep it for ever. So a child process reads, which is given the bytes
of the file on its standard input and writes arrays without objects to its standard output.
"""

from __future__ import annotations

import signal
import subprocess
import sys
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mr_damper_ros.processes import child_process

TIME_LIMIT = 60.0
"""Seconds that reading may take."""

_VERSION_73, _NO_SCIPY, _DAMAGED = 3, 4, 5
"""Exit codes of the child."""

Matrices = dict[str, NDArray[np.number]]
"""Real matrices (rows, columns) of numbers, by name."""


class MatError(ValueError):
    """A file that cannot be read; the message goes on after the file's name."""


def read_matrices(path: Path) -> Matrices:
    """Return the matrices in a MAT file.

    Raises MatError where it cannot be read, whatever is wrong with it, or takes longer than
    :data:`TIME_LIMIT`, and OSError where there is no such file.
    """
    child = subprocess.run(
        child_process.command(serve, str(TIME_LIMIT)),
        input=path.read_bytes(),
        capture_output=True,
        start_new_session=True,
        check=False,
    )
    if child.returncode == 0:
        stream = BytesIO(child.stdout)
        names = np.load(stream, allow_pickle=False).tolist()
        return {name: np.load(stream, allow_pickle=False) for name in names}
    if child.returncode == _VERSION_73:
        raise MatError(
            "is a MAT file of version 7.3: save it in MATLAB with save(..., '-v7') first"
        )
    if child.returncode == _NO_SCIPY:
        raise MatError("is a MAT file, which needs SciPy: install it, or export the file as CSV")
    if child.returncode == -signal.SIGALRM:
        raise MatError(
            f"could not be read within {TIME_LIMIT:g} s: save a part of it, or export it as CSV"
        )
    raise MatError("is not a MAT file that can be read: save it again, or export it as CSV")


def serve(limit: str) -> None:
    """Be the child, for at most ``limit`` seconds."""
    # Without a handler the signal ends a process also while it is in a call into C.
    signal.setitimer(signal.ITIMER_REAL, float(limit))
    try:
        from scipy.io import loadmat  # here: see mr_damper_ros.entry_points
    except ImportError:
        raise SystemExit(_NO_SCIPY) from None
    try:
        content = loadmat(BytesIO(sys.stdin.buffer.read()))
    except NotImplementedError:
        raise SystemExit(_VERSION_73) from None
    except Exception:
        # Damaged bytes surface in the library as exceptions of many kinds.
        raise SystemExit(_DAMAGED) from None
    matrices = {
        name: value
        for name, value in content.items()
        if isinstance(value, np.ndarray) and value.ndim == 2 and value.dtype.kind in "fiu"
    }
    output = BytesIO()
    for array in (np.array(list(matrices), dtype=np.str_), *matrices.values()):
        np.save(output, array, allow_pickle=False)
    sys.stdout.buffer.write(output.getbuffer())
