"""Show the running system on a page until Ctrl-C, as the node live does.

With --bag: show a recording, with the results of identifier and model. They start from the set in
use at the beginning of the recording.
"""

from __future__ import annotations

import argparse
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from mr_damper_ros.io.bag_messages import stamp_of
from mr_damper_ros.io.bag_reader import OpenBag, bag_stream, opened_bag
from mr_damper_ros.live.live_record import LiveRecord
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.programs import node_arguments
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.signals.recording import CurrentReading, StreamItem
from mr_damper_ros.tools.console import (
    add_namespace_option,
    add_path,
    add_port_option,
    program,
)
from mr_damper_ros.tracking.engine import Engine
from mr_damper_ros.tracking.state_directory import read_parameter_file
from mr_damper_ros.tracking.validity import DoubtKind

_SET_POINTS = (
    ("/supply/current_command", "mr_damper_msgs/msg/CurrentCommand", "current_command", "current"),
    ("/damper/desired_force", "mr_damper_msgs/msg/DesiredForce", "desired_force", "force"),
)
"""Topic, message type, name in the record, and field of the message."""


def empty_record(path: Path) -> LiveRecord:
    """A record with room for the signals of a bag, for :func:`replay_into`; raises BagError.

    Its title is name, operator, note and file name of the recording.
    """
    with opened_bag(path) as bag:
        told = [bag.details.get(key, "") for key in ("name", "operator", "note")]
    title = ", ".join(dict.fromkeys([*filter(None, told), path.name]))
    return LiveRecord(recorded=title, signals_kept=1_000_000)  # almost three hours


def replay_into(record: LiveRecord, path: Path, start: ParameterSet | None = None) -> None:
    """Replay a bag into a record, with the same results as the live identifier and model.

    Without ``start``, the initial set is the set in use at the start of the recording. Raises
    BagError or ParameterError if the bag or the set cannot be used.
    """
    with opened_bag(path) as bag:
        set_points = deque(_set_points(bag))
        text = bag.details.get("start_set", "")
    if start is None and text:
        start = ParameterSet.from_yaml(text)
    if start is not None:
        record.set_parameters(replace(start, stamp_ns=0))
    engine = Engine(None, start)

    def stream() -> Iterator[StreamItem]:
        for item in bag_stream(path):
            if isinstance(item, CurrentReading):
                record.add_current(item.stamp_ns / NANOSECONDS, item.current)
            yield item

    for block, prediction in engine.follow(stream()):
        while set_points and set_points[0][0] <= prediction.start_ns:
            record.set_point(*set_points.popleft()[1:])
        record.add_samples(
            prediction.start_ns / NANOSECONDS,
            prediction.period,
            prediction.at_its_samples(block.displacement),
            prediction.at_its_samples(block.force),
            prediction.force,
            prediction.doubts == DoubtKind.NONE,
            prediction.velocity,
        )
        _show_publications(record, engine)
    _show_publications(record, engine)


def _show_publications(record: LiveRecord, engine: Engine) -> None:
    for published in engine.take_publications():
        report = published.report
        record.add_report(report, published.duration)
        if published.parameters is not None:
            record.set_parameters(replace(published.parameters, stamp_ns=report.stamp_ns))


def _set_points(bag: OpenBag) -> list[tuple[int, str, float]]:
    """Stamp [ns], name and value of each setpoint in a bag, in the order of the stamps."""
    found = []
    fields = {
        bag.topic(topic, kind, required=False): (name, field)
        for topic, kind, name, field in _SET_POINTS
    }
    fields.pop("", None)
    for topic, _, message in bag.decoded(set(fields)) if fields else ():
        name, field = fields[topic]
        found.append((stamp_of(message), name, float(getattr(message, field))))
    return sorted(found)


def _options(parser: argparse.ArgumentParser) -> None:
    add_path(parser, "--bag", "FILE", "the recording; without it, the running system is shown")
    add_path(parser, "--parameters", "FILE", "with --bag: parameter set to start from instead")
    add_namespace_option(parser)
    add_port_option(parser)


def _show(options: argparse.Namespace) -> int:
    if options.bag is not None:
        if options.namespace != "/":
            raise ValueError("--namespace is for a running system: omit --bag or --namespace")
        return _show_bag(options)
    if options.parameters is not None:
        raise ValueError("--parameters is for a recording: give it with --bag, or omit it")
    from mr_damper_ros.nodes.live_node import main as run_node

    namespace = f"/{options.namespace.strip('/')}"
    return run_node(["live", *node_arguments({"port": options.port}, {"__ns": namespace})])


def _show_bag(options: argparse.Namespace) -> int:
    from mr_damper_ros.live.page_server import PageServer  # aiohttp is an optional package

    start = None if options.parameters is None else read_parameter_file(options.parameters)
    record = empty_record(options.bag)
    with closing(PageServer(record, "127.0.0.1", options.port)) as server:
        print(f"the page is at {server.address}; Ctrl-C ends it", flush=True)
        replay_into(record, options.bag, start)
        print("the whole recording is shown", flush=True)
        threading.Event().wait()
    return 0


main = program("mr-damper live", __doc__, _options, _show)
