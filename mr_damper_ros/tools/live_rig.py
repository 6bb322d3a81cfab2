"""``live_rig``: the emulated rig under identification, and the page that shows it."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path

from mr_damper_ros.processes.programs import RosDomain
from mr_damper_ros.tools.console import run_tool
from mr_damper_ros.tools.node_programs import check_running, page_of, start_node

_LOOK = 0.2
"""Seconds between two looks whether all nodes still run."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    return run_tool(_parser(), _run, arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="live_rig",
        description="Run the emulated rig, or play a bag again and again, to identifier and model, "
        "and serve the page that shows it, until Ctrl-C.",
    )
    parser.add_argument("--bag", type=Path, help="bag to play instead of the emulated rig")
    parser.add_argument(
        "--port", type=int, default=8770, help="of the page (default 8770; 0: any that is free)"
    )
    return parser


def _run(options: argparse.Namespace) -> int:
    with ExitStack() as stack:
        # A domain of its own: nothing of a laboratory that is running is touched.
        stack.enter_context(stack.enter_context(RosDomain()).entered())
        running = {
            name: stack.enter_context(closing(start_node(name, **parameters)))
            for name, parameters in (
                ("live", {"port": options.port}),
                ("identifier", {}),
                ("model", {}),
            )
        }
        print(f"the page is at {page_of(running['live'])}; Ctrl-C ends it", flush=True)
        source = ("replay", {"bag": options.bag, "loop": True}) if options.bag else ("bridge", {})
        name, parameters = source
        running[name] = stack.enter_context(
            closing(start_node(name, wait_for_subscribers=2, **parameters))
        )
        while True:
            check_running(running)
            time.sleep(_LOOK)
