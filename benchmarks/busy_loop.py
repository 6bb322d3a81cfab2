"""A program that is always busy, and ends with who has started it, however that one ends."""

from __future__ import annotations

import signal

from mr_damper_ros.processes import child_process
from mr_damper_ros.processes.programs import Program


def start_busy_loop() -> Program:
    """Start one."""
    return Program(child_process.command(_keep_busy))


def _keep_busy() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # so it is ended
    while True:
        pass
