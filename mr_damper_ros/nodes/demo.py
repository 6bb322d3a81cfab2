"""``demo``: a bag through replay, identifier and model as three processes, with the outcome."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO

import numpy as np
import rclpy
from ament_index_python.packages import get_package_share_directory
from mr_damper_msgs.msg import DamperParameters, FitReport, MtsSamples, PredictedForce
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from mr_damper_ros.interface.comparison import Comparison
from mr_damper_ros.interface.figures import save_figures
from mr_damper_ros.io.bags import read_bag
from mr_damper_ros.kinematics.motion import window_motion
from mr_damper_ros.models.published import LITERATURE
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES, force
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import from_field, to_nanoseconds
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tools.console import run_tool

_NODES = ("identifier", "model")
_START_LIMIT = 30.0
_SETTLE = 2.0
"""Seconds without a new report after which the identifier has finished."""

_SHUTDOWN_LIMIT = 5.0


class DemoError(ValueError):
    """The demonstration cannot go on; the message says why."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    return run_tool(_parser(), _demo, arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="demo",
        description="Play a bag to identifier and model, each a ROS 2 process of its own, watch "
        "them, and draw measured and predicted force.",
    )
    parser.add_argument("--bag", type=Path, help="bag to play (default: 5 mm, 1 Hz, 1.5 A)")
    parser.add_argument(
        "--rate", type=float, default=1.0, help="speed of the replay (default 1: real time)"
    )
    parser.add_argument(
        "--output", type=Path, default=Path("build/demo"), help="folder of the figures"
    )
    return parser


def _demo(options: argparse.Namespace) -> int:
    share = Path(get_package_share_directory("mr_damper_ros"))
    bag = options.bag or share / "bags" / "5.0mm_1Hz_1.5A"
    recording = max(read_bag(bag), key=lambda part: part.sample_count)
    print(f"bag: {bag}")
    for key, text in recording.details.items():
        print(f"  {key}: {text}")
    # A domain of its own: nothing of a laboratory that is running is touched.
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    with Processes(Path(sys.argv[0]).resolve().parent) as processes:
        for name in _NODES:
            processes.start(name)
        rclpy.init()
        try:
            watcher = Watcher()
            _wait_for_nodes(watcher, processes)
            replay = processes.start(
                "replay",
                *("-p", f"bag:={bag}", "-p", f"rate:={options.rate}"),
                *("-p", "wait_for_subscribers:=3"),
            )
            _watch(watcher, processes, replay)
        except ExternalShutdownException:
            raise KeyboardInterrupt from None
        finally:
            rclpy.try_shutdown()
    if watcher.parameters is None or not watcher.reports:
        raise DemoError("no window was identified: see the messages of the nodes above")
    return _summary(watcher, recording, options.output)


class Processes:
    """The nodes as processes of their own; all are ended, and only they, on leaving."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._running: dict[str, tuple[subprocess.Popen[bytes], IO[bytes]]] = {}

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *_: object) -> None:
        for process, _log in self._running.values():
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + _SHUTDOWN_LIMIT
        for process, log in self._running.values():
            try:
                process.wait(max(deadline - time.monotonic(), 0.1))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            log.close()

    def start(self, name: str, *parameters: str) -> subprocess.Popen[bytes]:
        """Start a node; raises DemoError where it is not installed."""
        program = self._folder / name
        if not program.exists():
            raise DemoError(f"{program} is not there: build the package with `make setup`")
        log = tempfile.TemporaryFile()  # noqa: SIM115  (closed with the processes)
        process = subprocess.Popen(
            [str(program), "--ros-args", *parameters],
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        self._running[name] = (process, log)
        return process

    def check(self) -> None:
        """Raise DemoError where a node has failed, with the end of what it said."""
        for name, (process, log) in self._running.items():
            if process.poll():
                log.seek(0)
                said = log.read().decode(errors="replace").strip().splitlines()[-3:]
                raise DemoError(f"{name} ended with code {process.returncode}: {' / '.join(said)}")


class Watcher(Node):  # type: ignore[misc]
    """Keeps the samples, the predictions, the reports and the newest parameters."""

    def __init__(self) -> None:
        super().__init__("demo")
        self.displacement: dict[int, Array] = {}
        self.measured: dict[int, Array] = {}
        self.predicted: dict[int, Array] = {}
        self.reports: list[FitReport] = []
        self.parameters: DamperParameters | None = None
        self.last_report = time.monotonic()
        subscribe = self.create_subscription
        subscribe(MtsSamples, "mts/samples", self._keep_samples, quality.stream())
        subscribe(PredictedForce, "damper/predicted_force", self._keep_force, quality.stream())
        subscribe(FitReport, "damper/fit_report", self._keep_report, quality.stream())
        subscribe(DamperParameters, "damper/parameters", self._keep_set, quality.latched())

    def _keep_samples(self, message: MtsSamples) -> None:
        self.displacement[message.seq] = from_field(message.displacement).copy()
        self.measured[message.seq] = from_field(message.force).copy()

    def _keep_force(self, message: PredictedForce) -> None:
        if message.valid:
            self.predicted[message.seq] = from_field(message.force).copy()

    def _keep_set(self, message: DamperParameters) -> None:
        self.parameters = message

    def _keep_report(self, message: FitReport) -> None:
        self.reports.append(message)
        self.last_report = time.monotonic()
        elapsed = 1e-9 * (
            to_nanoseconds(message.header.stamp) - to_nanoseconds(self.reports[0].window_start)
        )
        verdict = "accepted" if message.accepted else f"kept: {message.reason}"
        print(
            f"{elapsed:6.1f} s  NRMSE {message.nrmse_before:9.2%} -> {message.nrmse_after:6.2%}  "
            f"{message.evaluations:4d} evaluations, {1e3 * message.duration:4.0f} ms  "
            f"force scale {message.force_scale:6.4f}  {message.parameter_set}: {verdict}",
            flush=True,
        )


def _wait_for_nodes(watcher: Watcher, processes: Processes) -> None:
    deadline = time.monotonic() + _START_LIMIT
    while not set(_NODES) <= set(watcher.get_node_names()):
        processes.check()
        if time.monotonic() > deadline:
            raise DemoError(f"{' and '.join(_NODES)} did not start within {_START_LIMIT:.0f} s")
        rclpy.spin_once(watcher, timeout_sec=0.1)


def _watch(watcher: Watcher, processes: Processes, replay: subprocess.Popen[bytes]) -> None:
    print("\nwindow        held-back samples: before -> after the fit")
    while replay.poll() is None or time.monotonic() - watcher.last_report < _SETTLE:
        processes.check()
        rclpy.spin_once(watcher, timeout_sec=0.1)


def _summary(watcher: Watcher, recording: Recording, folder: Path) -> int:
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
    before = _nrmse(force(LITERATURE, *kinematics, amperes), measured)
    after = _nrmse(force(identified, *kinematics, amperes), measured)
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
    figures = save_figures([comparison], folder, ["png"], "predicted while it ran")
    print("figures: " + ", ".join(str(path) for path in figures))
    return 0


def _nrmse(predicted: Array, measured: Array) -> float:
    return float(np.sqrt(np.mean((predicted - measured) ** 2)) / np.std(measured))
