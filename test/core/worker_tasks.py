"""Tasks for worker processes, which cannot import a test module; it loads nothing heavy."""

import os
import pathlib
import signal
import sys
import time
from collections.abc import Callable
from typing import Any


def call(function: Callable[..., Any], *args: Any) -> Any:
    return function(*args[:-1])  # the last argument is the control


def count(limit: int, control: Any) -> str:
    for step in range(limit):
        if not control.report(step):
            return f"stopped at {step}"
        time.sleep(0.01)
    return "counted"


def wait(control: Any) -> str:
    while not control.should_stop():
        time.sleep(0.01)
    return "waited"


def deaf(control: Any) -> None:
    while True:
        control.report(0)
        time.sleep(0.01)


def once(number: int, path: str, control: Any) -> str:
    """Send a signal to its process on the first call only."""
    marker = pathlib.Path(path)
    if not marker.exists():
        marker.write_text("once")
        os.kill(os.getpid(), number)
    return "second try"


def die(control: Any) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def unpicklable(control: Any) -> Callable[[], None]:
    return lambda: None


def modules(control: Any) -> list[str]:
    return sorted(sys.modules)
