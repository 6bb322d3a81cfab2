"""Check the live signals of a rig and report faults.

The machine must move; motion at several frequencies also reveals the skew of the channels.
"""

from __future__ import annotations

import argparse

from mr_damper_ros.data_check.streams import RigRecord, check_rig
from mr_damper_ros.processes.exits import DOUBTFUL
from mr_damper_ros.tools.console import add_namespace_option, program


def _options(parser: argparse.ArgumentParser) -> None:
    add_namespace_option(parser)
    parser.add_argument(
        "--seconds", type=float, default=30.0, help="time to listen [s] (default 30)"
    )


def _check(options: argparse.Namespace) -> int:
    if not options.seconds > 0.0:
        raise ValueError(f"--seconds must be more than 0 s, not {options.seconds:g}")
    from mr_damper_ros.nodes.observer import Observer, record_rig

    record = RigRecord()
    with Observer("check", namespace=options.namespace) as observer:
        record_rig(observer.node, record)
        observer.spin_for(options.seconds)
    check = check_rig(record)
    print(f"{record.sample_count} samples in {options.seconds:g} s.\n\n{check}".rstrip())
    return DOUBTFUL if check.warnings else 0


main = program("mr-damper check", __doc__, _options, _check)
"""Check the rig; returns 1 if the signals have a fault."""
