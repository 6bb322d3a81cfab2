"""``watch``: how the running system stands, printed in place."""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from collections.abc import Sequence

from mr_damper_ros.live.live_record import LiveRecord
from mr_damper_ros.live.summary import summary
from mr_damper_ros.tools.console import run_tool

_HOME_AND_CLEAR = "\x1b[H\x1b[J"
_WITHOUT_CURSOR, _WITH_CURSOR = "\x1b[?25l", "\x1b[?25h"
_AT_LEAST = 3.0
"""Seconds after which everybody who is there has been heard: diagnostics come once a second."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    return run_tool(_parser(), _watch, arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="watch", description="Print how the running system stands, in place, until Ctrl-C."
    )
    parser.add_argument("--namespace", default="/", help="namespace of the damper (default /)")
    parser.add_argument(
        "--period", type=float, default=0.5, help="seconds between two prints (default 0.5)"
    )
    parser.add_argument(
        "--once", action="store_true", help=f"print once, after {_AT_LEAST:g} s, and end"
    )
    return parser


def _watch(options: argparse.Namespace) -> int:
    if not options.period > 0.0:
        raise ValueError(f"--period must be more than 0 s, not {options.period:g}")
    from mr_damper_ros.nodes.live_node import listen
    from mr_damper_ros.nodes.observer import Observer

    record = LiveRecord()
    with Observer("watch", namespace=options.namespace) as observer:
        listen(observer.node, record)
        if options.once:
            observer.spin_for(_AT_LEAST)
            print(summary(record, _width()))
            return 0
        in_place = sys.stdout.isatty()
        try:
            while True:
                observer.spin_for(options.period)
                text = summary(record, _width())
                if in_place:
                    print(_WITHOUT_CURSOR + _HOME_AND_CLEAR + text, flush=True)
                else:
                    print(f"{time.strftime('%H:%M:%S')}\n{text}\n", flush=True)
        finally:
            if in_place:
                print(_WITH_CURSOR, end="", flush=True)


def _width() -> int:
    return shutil.get_terminal_size().columns
