"""Check bags, or the live signals of a rig, and report faults.

The machine must move; motion at several frequencies also reveals the skew of the channels.
"""

from __future__ import annotations

import argparse

from mr_damper_ros.api.check import check
from mr_damper_ros.data_check.findings import NOTE, REFUSE
from mr_damper_ros.data_check.streams import RigRecord, check_rig
from mr_damper_ros.processes.exits import DOUBTFUL, FAILED
from mr_damper_ros.tools.console import add_namespace_option, add_path, program


def _options(parser: argparse.ArgumentParser) -> None:
    bags = "bags to check instead of live signals; runs of one damper are also compared"
    add_path(parser, "bags", "BAG", bags, nargs="*")
    add_namespace_option(parser)
    parser.add_argument(
        "--seconds", type=float, default=30.0, help="time to listen [s] (default 30)"
    )


def _check(options: argparse.Namespace) -> int:
    if options.bags:
        return _check_bags(options)
    if not options.seconds > 0.0:
        raise ValueError(f"--seconds must be more than 0 s, not {options.seconds:g}")
    from mr_damper_ros.nodes.observer import Observer, record_rig

    record = RigRecord()
    with Observer("check", namespace=options.namespace) as observer:
        record_rig(observer.node, record)
        observer.spin_for(options.seconds)
    live = check_rig(record)
    print(f"{record.sample_count} samples in {options.seconds:g} s.\n\n{live}".rstrip())
    return DOUBTFUL if live.warnings else 0


def _check_bags(options: argparse.Namespace) -> int:
    found = check(*options.bags)
    print(found)
    return FAILED if found.severity is REFUSE else DOUBTFUL if found.severity > NOTE else 0


main = program("mr-damper check", __doc__, _options, _check)
"""Check bags or the rig; returns 1 if the signals have a fault, 2 if it refuses a bag."""
