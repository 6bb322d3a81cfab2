"""Bridge, identifier and model as processes on an emulated rig, and what they publish."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

from mr_damper_msgs.msg import DamperParameters, FitReport, MtsSamples, PredictedForce

from benchmarks.processes import ProfiledDomain, start_node
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.observer import Observer
from mr_damper_ros.processes.programs import Program
from mr_damper_ros.tracking.state_directory import StateDirectory

NODES = ("bridge", "identifier", "model")

_BAD_WORDS = ("[ERROR]", "[FATAL]", "Traceback")


class ThreeNodes:
    """The three nodes in a domain of their own; every end of one leaves its log behind.

    ``options`` are the parameters of each node, in the form that ``start_node`` takes; the
    identifier keeps its state in ``folder``.
    """

    def __init__(self, folder: Path, options: Mapping[str, Mapping[str, object]]) -> None:
        self.state = StateDirectory(folder)
        self._options = {**options, "identifier": {**options["identifier"], "state_dir": folder}}
        self._domain = ProfiledDomain()
        self._ended: list[str] = []
        self.sets: list[DamperParameters] = []
        self.reports: list[FitReport] = []
        self.observer = Observer(domain=self._domain)
        # More than the publisher's one message: none shall replace another on its way.
        latched = quality.latched()
        latched.depth = 100
        self.observer.listen(DamperParameters, "damper/parameters", latched, self.sets.append)
        self.observer.listen(FitReport, "damper/fit_report", quality.stream(), self.reports.append)
        self.nodes: dict[str, Program] = {}

    def __enter__(self) -> ThreeNodes:
        for name in NODES:
            self.start(name)
        self.observer.wait_for_publishers("mts/samples")
        self.observer.wait_for_publishers("damper/predicted_force")
        self.observer.until(lambda: self.reports, "the first report")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for node in self.nodes.values():
            node.stop()
            self._forget(node)
        self.observer.close()
        self._domain.close()

    def start(self, name: str) -> Program:
        """Start a node, in place of the one of this name, which has ended."""
        if name in self.nodes:
            self._forget(self.nodes[name])
        self.nodes[name] = start_node(name, self._domain, **self._options[name])
        return self.nodes[name]

    def _forget(self, node: Program) -> None:
        self._ended.append(node.log)
        node.close()

    @property
    def worker(self) -> int | None:
        """Id of the identifier's worker process; None while there is none."""
        children = self.nodes["identifier"].children
        return children[0] if children else None

    @property
    def errors(self) -> list[str]:
        """Lines that tell of errors in the logs of all nodes, those that have ended too."""
        running = [node.log for node in self.nodes.values() if node.running]
        return [
            line
            for log in self._ended + running
            for line in log.splitlines()
            if any(word in line for word in _BAD_WORDS)
        ]

    def hear_next(self, message_type: type, topic: str) -> Heard:
        """Wait for messages on a topic from now on."""
        return Heard(self.observer, message_type, topic)


class Heard:
    """When the first message that counts has come on a topic; ``close`` it when done."""

    def __init__(self, observer: Observer, message_type: type, topic: str) -> None:
        self._node = observer.node
        self.at: float | None = None
        self._subscription = self._node.create_subscription(
            message_type, topic, self._take, quality.stream()
        )

    def _take(self, message: MtsSamples | PredictedForce) -> None:
        if self.at is None and getattr(message, "valid", True):
            self.at = time.monotonic()

    def forget(self) -> None:
        """What has come so far does not count."""
        self.at = None

    def close(self) -> None:
        """Listen no longer."""
        self._node.destroy_subscription(self._subscription)
