"""The nodes as programs, for ``ros2 run mr_damper_ros NODE``.

SciPy takes most of the loading time. A killed node should restart quickly, so the modules of a node
import SciPy only inside the functions that use it. The worker of a node loads SciPy before its
first task.
"""

from __future__ import annotations

from functools import partial
from importlib import import_module

from mr_damper_ros.processes.exits import exit_code


def _run(node: str) -> int:
    def main() -> int:
        code: int = import_module(f"mr_damper_ros.nodes.{node}_node").main()
        return code

    return exit_code(node, main, interrupted=0)


bridge = partial(_run, "bridge")
campaign = partial(_run, "campaign")
controller = partial(_run, "controller")
identifier = partial(_run, "identifier")
live = partial(_run, "live")
model = partial(_run, "model")
replay = partial(_run, "replay")
supply = partial(_run, "supply")
suspension = partial(_run, "suspension")
