"""Play a bag to the nodes identifier and model, and draw measured and predicted force.

With --live: serve the live page of the emulated rig, or of a looping bag, until Ctrl-C.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mr_damper_ros.api.comparison import Comparison, save_figures, validate
from mr_damper_ros.api.findings import estimates_table, parameter_estimates
from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.models.parameter_set import start_set
from mr_damper_ros.processes.programs import Program, ProgramError, RosDomain, node_arguments
from mr_damper_ros.report.document import text_table
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tools.console import add_path, add_port_option, program

if TYPE_CHECKING:
    from mr_damper_ros.nodes.observer import Observer

_NODES = ("identifier", "model")
_START_LIMIT = 30.0
_SETTLE = 2.0
"""Time [s] without a new report after which the identifier has finished."""


_LOOK = 0.2
"""Time [s] between two checks that all nodes are still running."""


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
    from ament_index_python.packages import get_package_share_directory

    share = Path(get_package_share_directory("mr_damper_ros"))
    bag = options.bag or share / "bags" / "5.0mm_1Hz_1.5A"
    recording = max(read_bag(bag), key=lambda part: part.sample_count)
    print(f"bag: {bag}")
    for key, text in recording.details.items():
        print(f"  {key}: {text}")
    with _own_domain() as stack:
        running = {name: stack.enter_context(closing(start_node(name))) for name in _NODES}
        running["live"] = stack.enter_context(closing(start_node("live", port=0)))
        print(f"live page during this run: {page_of(running['live'])}")
        from mr_damper_ros.nodes.observer import Observer

        heard = _Messages(stack.enter_context(Observer("demo")))
        deadline = time.monotonic() + _START_LIMIT
        while not set(_NODES) <= set(heard.observer.node.get_node_names()):
            check_running(running)
            if time.monotonic() > deadline:
                raise ValueError(
                    f"{' and '.join(_NODES)} did not start within {_START_LIMIT:.0f} s"
                )
            heard.observer.spin_once()
        running["replay"] = stack.enter_context(
            closing(start_node("replay", bag=bag, rate=options.rate, wait_for_subscribers=3))
        )
        heard.receive(running)
    if not heard.sets or not heard.reports:
        raise ValueError("no window was identified: see the messages of the nodes above")
    from mr_damper_ros.nodes.messages import parameter_set

    found = parameter_set(heard.sets[-1])
    print(f"\n{text_table(*estimates_table('parameter', parameter_estimates(found)))}\n")
    for known, when in ((start_set(found.model), "before"), (found, "after")):
        nrmse = validate(known, recording).nrmse
        print(f"NRMSE with the set {known.set_id}, {when}: {nrmse:.2%}")
    comparison = heard.predicted(recording)
    print(f"NRMSE of the force predicted during the run: {comparison.error.nrmse:.2%}")
    figures = save_figures(
        [comparison], options.output, ["png"], "predicted while the bag was playing"
    )
    print("figures: " + ", ".join(map(str, figures)))
    return 0


def _live(options: argparse.Namespace) -> int:
    with _own_domain() as stack:

        def started(name: str, **parameters: object) -> Program:
            return stack.enter_context(closing(start_node(name, **parameters)))

        running = {"live": started("live", port=options.port, allow_commands=True)}
        running.update((name, started(name)) for name in _NODES)
        print(f"the page is at {page_of(running['live'])}; Ctrl-C ends it", flush=True)
        if options.bag:
            bag = {"bag": options.bag, "loop": True}
            running["replay"] = started("replay", wait_for_subscribers=2, **bag)
        else:
            running["bridge"] = started("bridge", wait_for_subscribers=2)
        with suppress(KeyboardInterrupt):  # Ctrl-C ends the demonstration
            while True:
                check_running(running)
                time.sleep(_LOOK)
    return 0


@contextmanager
def _own_domain() -> Iterator[ExitStack]:
    """A reserved domain, so that the demonstration does not affect a running laboratory."""
    with RosDomain() as domain, domain.entered(), ExitStack() as stack:
        yield stack


def start_node(name: str, **parameters: object) -> Program:
    """Start a node of this installation; raises ValueError if the package is not built."""
    path = Path(sys.argv[0]).resolve().parent / name
    if not path.exists():
        raise ValueError(f"{path} does not exist: build the package with `make setup`")
    return Program([str(path), *node_arguments(parameters)])


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


class _Messages:
    """Messages of the nodes: samples, forces, sets, and reports, which are also printed."""

    def __init__(self, observer: Observer) -> None:
        from mr_damper_ros.nodes.observer import listen_to_identification

        self.observer = observer
        self._last = time.monotonic()
        self.reports: list[Any] = []
        self.samples, self.forces, self.sets = listen_to_identification(observer, self._print)

    def _print(self, report: Any) -> None:
        self.reports.append(report)
        self._last = time.monotonic()
        now, begin = report.header.stamp, self.reports[0].window_start
        elapsed = now.sec - begin.sec + 1e-9 * (now.nanosec - begin.nanosec)
        verdict = "accepted" if report.accepted else f"kept: {report.reason}"
        print(
            f"{elapsed:6.1f} s  NRMSE {report.nrmse_before:9.2%} -> {report.nrmse_after:6.2%}  "
            f"{report.evaluations:4d} evaluations, {1e3 * report.duration:4.0f} ms  "
            f"force scale {report.force_scale:6.4f}  {report.parameter_set}: {verdict}",
            flush=True,
        )

    def receive(self, running: Mapping[str, Program]) -> None:
        """Receive until the bag has ended and the identifier has finished. Raises ValueError."""
        print("\nwindow        validation samples: before -> after the fit")
        while running["replay"].running or time.monotonic() - self._last < _SETTLE:
            check_running(running)
            self.observer.spin_once()

    def predicted(self, recording: Recording) -> Comparison:
        """The force that was predicted during the run. Raises ValueError."""
        samples = {message.seq: message for message in self.samples}
        forces = {m.seq: m.force for m in self.forces if m.valid and m.seq in samples}
        if not forces:
            raise ValueError("the model node predicted no valid force: see /diagnostics")
        numbers, period = sorted(forces), recording.period
        moved, measured = (
            np.concatenate([getattr(samples[seq], name) for seq in numbers])
            for name in ("displacement", "force")
        )
        return Comparison(
            name=recording.name,
            time=np.concatenate([(seq + np.arange(len(forces[seq]))) * period for seq in numbers]),
            displacement=moved,
            velocity=np.gradient(moved, period),
            measured=measured,
            predicted=np.concatenate([forces[seq] for seq in numbers]),
            provenance=recording.details.get("provenance", ""),
        )


main = program(
    __name__, __doc__, _options, lambda options: _live(options) if options.live else _demo(options)
)
