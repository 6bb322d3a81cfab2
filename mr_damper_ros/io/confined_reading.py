"""Reads a file with a library that believes what the file says, in a process of its own.

A malformed file can end the process that reads it (a segmentation fault), keep it for ever, or
unpack a few bytes to more than the memory. So a child process reads, with limited time and memory.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from mr_damper_ros.processes import child_process

_BYTES_PER_SAMPLE = 100
"""Memory [B] that may be used: four columns of eight bytes, compressed, unpacked and turned."""

_LEAST_MEMORY = 100_000_000
"""Bytes that any file may use."""


def memory_for(maximum_samples: int) -> int:
    """Bytes that reading so many samples may take."""
    return max(_BYTES_PER_SAMPLE * maximum_samples, _LEAST_MEMORY)


def run_confined(serve: Callable[..., None], path: Path, *arguments: str) -> tuple[int, BinaryIO]:
    """Exit code of a child that runs ``serve(*arguments, result)``, and what it wrote.

    The file is its standard input; ``result`` is the number of the file descriptor that it writes
    to. Raises OSError where there is no such file.
    """
    result = os.memfd_create("result")
    stream = open(result, "w+b")  # noqa: SIM115 (handed over)
    with path.open("rb") as file:
        code = subprocess.run(
            child_process.command(serve, *arguments, str(result)),
            stdin=file,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=[result],
            start_new_session=True,
            check=False,
        ).returncode
    stream.seek(0)
    return code, stream


def limit_time(seconds: float) -> None:
    """End this process after so many seconds, also while it is in a call into C."""
    signal.setitimer(signal.ITIMER_REAL, seconds)


def limit_memory(size: int) -> None:
    """Let this process take and write so many bytes more than now. Elsewhere than on Linux: not."""
    if sys.platform != "linux":
        return
    import resource

    pages = int(Path("/proc/self/statm").read_text().split()[5])  # data and stack
    used = pages * os.sysconf("SC_PAGE_SIZE")
    for kind, limit in ((resource.RLIMIT_DATA, used + size), (resource.RLIMIT_FSIZE, size)):
        with contextlib.suppress(ValueError):  # a lower limit is set already
            resource.setrlimit(kind, (limit, limit))
