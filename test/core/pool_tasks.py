"""Tasks for other processes, which cannot import a test module."""

import os
import signal
import time

import numpy as np
import scipy.linalg  # noqa: F401  # its BLAS is another than NumPy's

from mr_damper_ros.processes.process_pool import Notify


def sum_of_seed(seed: int, notify: Notify) -> float:
    notify(seed)
    return float(np.random.default_rng(seed).normal(size=1000).sum())


def patient(seconds: float, notify: Notify) -> str:
    """Run until told to stop."""
    if seconds < 0.0:
        raise ValueError("not for long")
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if not notify("working"):
            return "stopped"
        time.sleep(0.01)
    return "done"


def failing(number: int, notify: Notify) -> int:
    if number == 2:
        raise ValueError("two is not allowed")
    return number


def threads(*anything: object) -> int:
    """Largest number of threads of any BLAS in this process; 0 if none has several."""
    from threadpoolctl import threadpool_info

    libraries = (each for each in threadpool_info() if each["user_api"] == "blas")
    return max((library["num_threads"] for library in libraries), default=0)


def told(*arguments: str) -> None:
    print(list(arguments))


def answering() -> None:
    """Read a line and print it."""
    print("ready", flush=True)
    print(input(), flush=True)


def crash(*arguments: str) -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def deadly(number: int, notify: Notify) -> int:
    """Kill its process on every attempt at the second task."""
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return number
