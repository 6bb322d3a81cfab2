"""Play a bag to the nodes identifier and model, and draw measured and predicted force.

With --live: serve the live page of the emulated rig, or of a looping bag, until Ctrl-C.
"""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from mr_damper_ros.api.comparison import Comparison, save_figures, validate
from mr_damper_ros.api.details import estimates_table, parameter_estimates
from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.kinematics.motion import window_motion
from mr_damper_ros.models.parameter_set import start_set
from mr_damper_ros.processes.programs import Program, ProgramError, RosDomain, node_arguments
from mr_damper_ros.report.document import text_table
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tools.console import add_path, add_port_option, program

_NODES = ("identifier", "model")
_START_LIMIT = 30.0


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--live", action="store_true", help="serve the page until Ctrl-C")
    default = "5 mm, 1 Hz, 1.5 A; with --live the emulated rig"
    add_path(parser, "--bag", "BAG", f"bag to play (default: {default})")
    add_port_option(parser)
    parser.add_argument(
        "--rate", type=float, default=1.0, help="speed of the replay (default 1: real time)"
    )
    add_path(parser, "--output", "FOLDER", "folder of the figures", default=Path("build/demo"))


def _demo(options: argparse.Namespace) -> int:
    bag = options.bag or _prefix() / "share" / "mr_damper_ros" / "bags" / "5.0mm_1Hz_1.5A"
    recording = max(read_bag(bag), key=lambda part: part.sample_count)
    print(f"bag: {bag}")
    for key, text in recording.details.items():
        print(f"  {key}: {text}")
    from mr_damper_ros.nodes.observer import Observer, listen_to_identification

    with _own_domain() as start, Observer("demo") as observer:
        running = {name: start(name) for name in _NODES}
        running["live"] = start("live", port=0)
        print(f"live page during this run: {page_of(running['live'])}")
        reports: list[Any] = []
        last = time.monotonic()

        def take(report: Any) -> None:
            nonlocal last
            reports.append(report)
            last = time.monotonic()
            _print_report(report, reports[0])

        samples, forces, sets = listen_to_identification(observer, take)
        deadline = time.monotonic() + _START_LIMIT
        while not set(_NODES) <= set(observer.node.get_node_names()):
            check_running(running)
            if time.monotonic() > deadline:
                raise ValueError(
                    f"{' and '.join(_NODES)} did not start within {_START_LIMIT:.0f} s"
                )
            observer.spin_once()
        running["replay"] = start("replay", bag=bag, rate=options.rate, wait_for_subscribers=3)
        print("\nwindow        validation samples: before -> after the fit")
        # After 2 s without a new report, the identifier has finished.
        while running["replay"].running or time.monotonic() - last < 2.0:
            check_running(running)
            observer.spin_once()
    if not sets or not reports:
        raise ValueError("no window was identified: see the messages of the nodes above")
    from mr_damper_ros.nodes.messages import parameter_set

    found = parameter_set(sets[-1])
    print(f"\n{text_table(*estimates_table('parameter', parameter_estimates(found)))}\n")
    for known, when in ((start_set(found.model), "before"), (found, "after")):
        nrmse = validate(known, recording).nrmse
        print(f"NRMSE with the set {known.set_id}, {when}: {nrmse:.2%}")
    comparison = _predicted(recording, samples, forces)
    print(f"NRMSE of the force predicted during the run: {comparison.error.nrmse:.2%}")
    title = "predicted while the bag was playing"
    figures = save_figures([comparison], options.output, ["png"], title)
    print("figures: " + ", ".join(map(str, figures)))
    return 0


def _live(options: argparse.Namespace) -> int:
    with _own_domain() as start:
        running = {"live": start("live", port=options.port, allow_commands=True)}
        running.update((name, start(name)) for name in _NODES)
        print(f"the page is at {page_of(running['live'])}; Ctrl-C ends it", flush=True)
        if options.bag:
            running["replay"] = start("replay", bag=options.bag, loop=True, wait_for_subscribers=2)
        else:
            running["bridge"] = start("bridge", wait_for_subscribers=2)
        with suppress(KeyboardInterrupt):  # Ctrl-C ends the demonstration
            while True:
                check_running(running)
                time.sleep(0.2)
    return 0


def _prefix() -> Path:
    """Folder of the installed package with its nodes and bags. Raises ValueError."""
    from ament_index_python.packages import PackageNotFoundError, get_package_prefix

    try:
        return Path(get_package_prefix("mr_damper_ros"))
    except PackageNotFoundError:
        raise ValueError(
            "ROS 2 does not find the nodes of this package: build it in a workspace and source "
            "install/setup.bash"
        ) from None


@contextmanager
def _own_domain() -> Iterator[Callable[..., Program]]:
    """A function that starts nodes of this installation in a reserved domain, until the end.

    So the demonstration does not affect a running laboratory.
    """
    with RosDomain() as domain, domain.entered(), ExitStack() as stack:

        def start(name: str, **parameters: object) -> Program:
            path = _prefix() / "lib" / "mr_damper_ros" / name
            return stack.enter_context(closing(Program([str(path), *node_arguments(parameters)])))

        yield start


def check_running(running: Mapping[str, Program]) -> None:
    """Raise ValueError if a node has failed, with the end of its output."""
    for name, node in running.items():
        if node.exit_code:
            raise ValueError(f"{name} ended with code {node.exit_code}: {node.last_words}")


def page_of(live: Program) -> str:
    """Address of the page that the live node serves; raises ValueError if it serves none."""
    try:
        live.wait_for_log("the page is at")
    except ProgramError as error:
        raise ValueError(live.last_words) from error
    found = re.search(r"the page is at (\S+)", live.log)
    assert found
    return found[1]


def _print_report(report: Any, first: Any) -> None:
    now, begin = report.header.stamp, first.window_start
    elapsed = now.sec - begin.sec + 1e-9 * (now.nanosec - begin.nanosec)
    verdict = "accepted" if report.accepted else f"kept: {report.reason}"
    print(
        f"{elapsed:6.1f} s  NRMSE {report.nrmse_before:9.2%} -> {report.nrmse_after:6.2%}  "
        f"{report.evaluations:4d} evaluations, {1e3 * report.duration:4.0f} ms  "
        f"force scale {report.force_scale:6.4f}  {report.parameter_set}: {verdict}",
        flush=True,
    )


def _predicted(recording: Recording, blocks: Sequence[Any], forces: Sequence[Any]) -> Comparison:
    """Measured and predicted force of the messages of a run. Raises ValueError."""
    samples = {message.seq: message for message in blocks}
    pairs = {m.seq: (samples[m.seq], m) for m in forces if m.valid and m.seq in samples}
    if not pairs:
        raise ValueError("the model node predicted no valid force: see /diagnostics")
    columns = [
        (seq + np.arange(len(made.force)), block.displacement, block.force, made.force)
        for seq, (block, made) in sorted(pairs.items())
    ]
    number, moved, measured, force = map(np.concatenate, zip(*columns, strict=True))
    return Comparison(
        name=recording.name,
        time=number * recording.period,
        displacement=moved,
        velocity=window_motion(moved, recording.period).velocity,
        measured=measured,
        predicted=force,
        provenance=recording.details.get("provenance", ""),
    )


def _run(options: argparse.Namespace) -> int:
    return _live(options) if options.live else _demo(options)


main = program("mr-damper demo", __doc__, _options, _run)
