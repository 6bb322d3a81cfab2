"""``demo``: identifier and model as processes at work, on a bag or on the emulated rig.

It plays a bag once and shows the outcome, or with ``--live`` serves the page until Ctrl-C. A tool
like the others, with the table and the figures of one: all that it knows of ROS is a watcher from
the nodes, loaded when it runs.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mr_damper_ros.api.comparison import Comparison, save_figures
from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.kinematics.motion import window_motion
from mr_damper_ros.models.published import LITERATURE
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES, sine_force
from mr_damper_ros.processes.programs import Program, ProgramError, RosDomain, node_arguments
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tools.console import run_tool

if TYPE_CHECKING:
    from mr_damper_ros.nodes.observer import DemoWatcher

_NODES = ("identifier", "model")
_START_LIMIT = 30.0
_SETTLE = 2.0
"""Seconds without a new report after which the identifier has finished."""


_LOOK = 0.2
"""Seconds between two looks whether all nodes still run."""


class DemoError(ValueError):
    """The demonstration cannot go on: a node is not there, or has failed; the message says why."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    return run_tool(
        _parser(), lambda options: (_live if options.live else _demo)(options), arguments
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="demo",
        description="Play a bag to identifier and model, each a ROS 2 process of its own, watch "
        "them, and draw measured and predicted force. With --live: run the emulated rig, or play a "
        "bag again and again, and serve the page that shows it, until Ctrl-C.",
    )
    parser.add_argument("--live", action="store_true", help="serve the page until Ctrl-C")
    parser.add_argument(
        "--bag",
        type=Path,
        help="bag to play (default: 5 mm, 1 Hz, 1.5 A; with --live the emulated rig)",
    )
    parser.add_argument(
        "--port",
        type=int,
        default=8770,
        help="of the page of --live (default %(default)s; 0: any that is free)",
    )
    parser.add_argument(
        "--rate", type=float, default=1.0, help="speed of the replay (default 1: real time)"
    )
    parser.add_argument(
        "--output", type=Path, default=Path("build/demo"), help="folder of the figures"
    )
    return parser


def _run(options: argparse.Namespace) -> int:
    return _live(options) if options.live else _demo(options)


def _demo(options: argparse.Namespace) -> int:
    from ament_index_python.packages import get_package_share_directory

    share = Path(get_package_share_directory("mr_damper_ros"))
    bag = options.bag or share / "bags" / "5.0mm_1Hz_1.5A"
    recording = max(read_bag(bag), key=lambda part: part.sample_count)
    print(f"bag: {bag}")
    for key, text in recording.details.items():
        print(f"  {key}: {text}")
    with ExitStack() as stack:
        # A domain of its own: nothing of a laboratory that is running is touched.
        stack.enter_context(stack.enter_context(RosDomain()).entered())
        running = {name: stack.enter_context(closing(start_node(name))) for name in _NODES}
        running["live"] = stack.enter_context(closing(start_node("live", port=0)))
        print(f"page of this run, while it lasts: {page_of(running['live'])}")
        from mr_damper_ros.nodes.observer import DemoWatcher

        watcher = stack.enter_context(DemoWatcher())
        _wait_for_nodes(watcher, running)
        replay = stack.enter_context(
            closing(start_node("replay", bag=bag, rate=options.rate, wait_for_subscribers=3))
        )
        _watch(watcher, {**running, "replay": replay})
    if watcher.parameters is None or not watcher.reports:
        raise DemoError("no window was identified: see the messages of the nodes above")
    return _summary(watcher, recording, options.output)


def _live(options: argparse.Namespace) -> int:
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


def start_node(name: str, **parameters: object) -> Program:
    """Start a node of this installation; raises DemoError where it is not built."""
    program = Path(sys.argv[0]).resolve().parent / name
    if not program.exists():
        raise DemoError(f"{program} is not there: build the package with `make setup`")
    return Program([str(program), *node_arguments(parameters)])


def check_running(running: Mapping[str, Program]) -> None:
    """Raise DemoError where a node has failed, with the end of what it said."""
    for name, program in running.items():
        if program.exit_code:
            raise DemoError(f"{name} ended with code {program.exit_code}: {program.last_words}")


def page_of(live: Program) -> str:
    """Address of the page that a node live serves; raises DemoError where it serves none."""
    try:
        live.wait_for_log("the page is at")
    except ProgramError as error:
        raise DemoError(live.last_words) from error
    found = re.search(r"the page is at (\S+)", live.log)
    assert found
    return found[1]


def _wait_for_nodes(watcher: DemoWatcher, running: Mapping[str, Program]) -> None:
    deadline = time.monotonic() + _START_LIMIT
    while not set(_NODES) <= set(watcher.node.get_node_names()):
        check_running(running)
        if time.monotonic() > deadline:
            raise DemoError(f"{' and '.join(_NODES)} did not start within {_START_LIMIT:.0f} s")
        watcher.spin_once()


def _watch(watcher: DemoWatcher, running: Mapping[str, Program]) -> None:
    print("\nwindow        held-back samples: before -> after the fit")
    replay = running["replay"]
    while replay.running or time.monotonic() - watcher.last_report < _SETTLE:
        check_running(running)
        watcher.spin_once()


def _summary(watcher: DemoWatcher, recording: Recording, folder: Path) -> int:
    found = watcher.parameters
    assert found is not None
    values = dict(zip(found.names, found.values, strict=True))
    print("\nparameter        value  standard error  unit")
    for parameter, value, error, unit, observable in zip(
        found.names,
        found.values,
        found.standard_errors,
        found.units,
        found.observable,
        strict=True,
    ):
        shown = f"{error:14.3g}" if observable else "not observable"
        print(f"{parameter:>9} {value:12.6g}  {shown}  {unit}")

    displacement = np.concatenate(
        [watcher.displacement[seq] for seq in sorted(watcher.displacement)]
    )
    measured = np.concatenate([watcher.measured[seq] for seq in sorted(watcher.measured)])
    motion = window_motion(displacement, recording.period)
    kinematics = (motion.displacement, motion.velocity, motion.acceleration)
    identified = np.array([values[parameter] for parameter in PARAMETER_NAMES])
    amperes = float(np.mean(recording.current))
    before = _nrmse(sine_force(LITERATURE, *kinematics, amperes), measured)
    after = _nrmse(sine_force(identified, *kinematics, amperes), measured)
    print(f"\nNRMSE with the literature set, before:     {before:10.2%}")
    print(f"NRMSE with the identified set, after:      {after:10.2%}")
    both = [seq for seq in sorted(watcher.predicted) if seq in watcher.measured]
    if not both:
        raise DemoError("the model node predicted nothing valid: see /diagnostics")
    predicted = np.concatenate([watcher.predicted[seq] for seq in both])
    seen = np.concatenate([watcher.measured[seq] for seq in both])
    print(f"NRMSE of the force predicted while it ran: {_nrmse(predicted, seen):10.2%}")
    evaluations = sum(report.evaluations for report in watcher.reports)
    print(f"evaluations of the force law:              {evaluations:10d}")
    first = both[0]
    chosen = slice(first, first + predicted.size)
    comparison = Comparison(
        name=recording.name,
        time=recording.time[chosen],
        displacement=motion.displacement[chosen],
        velocity=motion.velocity[chosen],
        measured=seen,
        predicted=predicted,
        provenance=recording.details.get("provenance", ""),
    )
    figures = save_figures([comparison], folder, ["png"], "predicted while the bag was playing")
    print("figures: " + ", ".join(str(path) for path in figures))
    return 0


def _nrmse(predicted: Array, measured: Array) -> float:
    return float(np.sqrt(np.mean((predicted - measured) ** 2)) / np.std(measured))
