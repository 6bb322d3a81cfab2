"""Identify, validate, plan and export magnetorheological dampers, and show them live."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version

from mr_damper_ros.processes.exits import TERMINATED, exit_code

COMMANDS = {
    "identify": "fit one parameter set of a force law to recordings",
    "validate": "report the error of a parameter set on recordings",
    "import": "convert a text, CSV, MAT, XLSX, TDMS or MF4 file to a bag",
    "check": "check the live signals of a rig and report faults (needs ROS 2)",
    "plan": "recommend the run of the test machine that is most informative",
    "replay": "report what identifier and model would have published for a recording",
    "export": "write a parameter set as code for a controller, with test vectors",
    "watch": "show the state of the running system in the terminal (needs ROS 2)",
    "demo": "play a bag to the nodes, and draw measured and predicted force (needs ROS 2)",
    "live": "show the running system (needs ROS 2) or a recording on a page",
}
"""The commands, with one line of help each. Each is a module of the package ``tools``."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command that the first argument names; returns its exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    # By default the process would end without cleaning up, and leave the nodes that it has started.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
    parser = argparse.ArgumentParser(
        "mr-damper", description=__doc__, epilog="mr-damper COMMAND --help describes a command."
    )
    parser.add_argument("--version", action="version", version=_version())
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, text in COMMANDS.items():
        commands.add_parser(name, help=text, add_help=False)
    # The module of the command, which takes seconds to load, parses the other arguments.
    command = parser.parse_args(given[:1]).command
    module = f"mr_damper_ros.tools.{'import_' if command == 'import' else command}"

    def run() -> int:
        code: int = import_module(module).main(given[1:])
        return code

    return exit_code(f"mr-damper {command}", run)


def _version() -> str:
    try:
        return version("mr_damper_ros")
    except PackageNotFoundError:  # python -m mr_damper_ros in a clone needs no installation
        return "not installed: run pip install . in the clone of mr_damper_ros"


if __name__ == "__main__":
    sys.exit(main())
