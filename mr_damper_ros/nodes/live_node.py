"""Node that serves a web page of the running system."""

from __future__ import annotations

import math
import re
import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from mr_damper_msgs.msg import (
    CurrentCommand,
    DamperParameters,
    DesiredForce,
    ExcitationCommand,
    FitReport,
    MtsSamples,
    PredictedForce,
    SupplyCurrent,
)
from mr_damper_msgs.srv import SaveParameters
from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from rclpy.task import Future
from sensor_msgs.msg import Temperature
from std_srvs.srv import Trigger

from mr_damper_ros.io.bag_writer import BagStream
from mr_damper_ros.live.live_record import Concern, LiveRecord
from mr_damper_ros.live.page_server import LOCAL, PageServer
from mr_damper_ros.models.parameter_set import ParameterError
from mr_damper_ros.nodes import messages, quality
from mr_damper_ros.nodes.command_topic import COMMAND_TOPIC, DEMAND_TOPIC, EXCITATION_TOPIC
from mr_damper_ros.nodes.inputs import CURRENT_TOPIC, SAMPLES_TOPIC
from mr_damper_ros.nodes.node_parameters import NodeParameters
from mr_damper_ros.nodes.spinning import run
from mr_damper_ros.processes.files import reason_of
from mr_damper_ros.settings.option_table import ParameterTable, option
from mr_damper_ros.signals.blocks import NANOSECONDS, BlockError
from mr_damper_ros.tracking.force_scale import FluidTemperature

_WAITING = 50
"""Queue length; the oldest messages are dropped, so that a viewer exerts no back-pressure."""


class RecordInput:
    """Stores the messages of a node's namespace in a record.

    Diagnostics are stored only from nodes of this namespace, or without a namespace from all nodes.
    """

    def __init__(self, node: Node, record: LiveRecord) -> None:
        self._record = record
        namespace = node.get_namespace().strip("/")
        self._prefix = f"{namespace}/" if namespace else ""
        self._samples: deque[MtsSamples] = deque(maxlen=_WAITING)
        self._fluid = FluidTemperature()
        waiting = quality.stream(_WAITING)
        looking = quality.stream(_WAITING)
        looking.reliability = ReliabilityPolicy.BEST_EFFORT
        for kind, topic, take, profile in (
            (MtsSamples, messages.JOINED_SAMPLES_TOPIC, self._take_samples, looking),
            (PredictedForce, messages.JOINED_FORCES_TOPIC, self._take_forces, looking),
            (SupplyCurrent, CURRENT_TOPIC, self._take_current, looking),
            (CurrentCommand, COMMAND_TOPIC, self._take_command, looking),
            (DesiredForce, DEMAND_TOPIC, self._take_desired_force, looking),
            (DamperParameters, messages.PARAMETERS_TOPIC, self._take_parameters, quality.latched()),
            (Temperature, "damper/fluid_temperature", self._take_temperature, waiting),
            (FitReport, messages.REPORT_TOPIC, self._take_report, waiting),
            (DiagnosticArray, "/diagnostics", self._take_diagnostics, waiting),
        ):
            node.create_subscription(kind, topic, take, profile)

    def _take_samples(self, message: MtsSamples) -> None:
        self._samples.append(message)

    def _take_forces(self, message: PredictedForce) -> None:
        """Join predicted forces with their samples, which arrive before them."""
        same = [block for block in self._samples if block.seq == message.seq]
        self._samples.clear()
        predicted = messages.from_field(message.force)
        valid = np.frombuffer(message.sample_doubts, dtype=np.uint8) == PredictedForce.NONE
        if not same or not len(same[0].force) == predicted.size == valid.size:
            return
        with suppress(BlockError):
            block = messages.sample_block(same[0])
            start_s, period = block.start_ns / NANOSECONDS, block.period
            self._record.add_samples(
                start_s, period, block.displacement, block.force, predicted, valid
            )

    def _take_current(self, message: SupplyCurrent) -> None:
        stamp_ns = messages.to_nanoseconds(message.header.stamp)
        self._record.add_current(stamp_ns / NANOSECONDS, message.current)

    def _take_command(self, message: CurrentCommand) -> None:
        self._record.set_point("current_command", message.current)

    def _take_desired_force(self, message: DesiredForce) -> None:
        self._record.set_point("desired_force", message.force)

    def _take_temperature(self, message: Temperature) -> None:
        variance = message.variance if message.variance > 0.0 else math.nan  # 0 means unknown
        self._fluid = FluidTemperature(message.temperature, math.sqrt(variance))

    def _take_report(self, message: FitReport) -> None:
        """Add a report, with the fluid temperature that was published before it."""
        report = replace(messages.report_of(message), fluid=self._fluid)
        self._fluid = FluidTemperature()
        self._record.add_report(report, message.duration)

    def _take_parameters(self, message: DamperParameters) -> None:
        try:
            self._record.set_parameters(messages.parameter_set(message))
        except ParameterError as error:
            self._record.add_event(
                f"parameters {message.id[: messages.SHOWN]} are not shown: {error}"
            )

    def _take_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.startswith(self._prefix):
                self._record.add_concern(
                    Concern(
                        status.name.removeprefix(self._prefix),
                        int.from_bytes(status.level, "little"),
                        status.message,
                        {entry.key: entry.value for entry in status.values},
                    )
                )


_RECORDED = {
    SAMPLES_TOPIC: MtsSamples,
    CURRENT_TOPIC: SupplyCurrent,
    "temperature": Temperature,
    "damper/predicted_force": PredictedForce,
    messages.REPORT_TOPIC: FitReport,
    messages.PARAMETERS_TOPIC: DamperParameters,
    COMMAND_TOPIC: CurrentCommand,
    DEMAND_TOPIC: DesiredForce,
    EXCITATION_TOPIC: ExcitationCommand,
}
"""Topics of a recording: everything that a replay of a run needs."""


class _BagRecording:
    """Records the topics of a node to a bag; ``failure`` says why that has failed, or is empty.

    Raises OSError or ValueError if the bag cannot be created.
    """

    def __init__(self, node: Node, path: Path, details: Mapping[str, str]) -> None:
        names = {topic: node.resolve_topic_name(topic) for topic in _RECORDED}
        kinds = {
            names[topic]: f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"
            for topic, kind in _RECORDED.items()
        }
        self.path, self.failure = path, ""
        self._node, self._bag, self._open = node, BagStream(path, kinds, details), True
        self._subscriptions = [
            node.create_subscription(
                kind,
                topic,
                partial(self._write, names[topic]),
                quality.latched() if kind is DamperParameters else quality.stream(),
                raw=True,
            )
            for topic, kind in _RECORDED.items()
        ]

    def _write(self, topic: str, data: Any) -> None:
        # The executor may still pass on messages after the end of the recording.
        if self._open and not self.failure:
            try:
                self._bag.write(topic, self._node.get_clock().now().nanoseconds, bytes(data))
            except OSError as error:
                self.failure = reason_of(error)

    def close(self) -> str:
        """End the recording; returns its failure, and where the written part is."""
        self._open = False
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        written = self.path
        try:
            self._bag.close()
        except OSError as error:
            self.failure = self.failure or reason_of(error)
            written = self._bag.fresh
        return self.failure and f"{self.failure}; what was written is in {written}"


_COMMANDS = {"save_parameters": SaveParameters, "reset": Trigger, "acknowledge": Trigger}
"""Services of the identifier that the page may call; their requests are empty."""

_RECORD, _STOP = "record", "stop_recording"
"""Commands that this node executes itself."""


@dataclass(frozen=True)
class LiveParameters(ParameterTable):
    """Parameters of the live node.

    It serves a page that shows the running system of its namespace, from damper/joined_samples,
    damper/joined_forces, supply/current, damper/fit_report, damper/parameters,
    damper/fluid_temperature and /diagnostics.
    """

    host: str = option(
        "127.0.0.1",
        "Address of the page. 127.0.0.1: this computer only; others use a tunnel (ssh -L "
        "8770:127.0.0.1:8770 RIG). 0.0.0.0: every computer that can reach this one, "
        "unencrypted and without a password.",
    )
    port: int = option(
        8770,
        "Port of the page; 0: any free port. The node logs the address of the page at its start.",
        within=(0, 65535),
    )
    allow_commands: bool = option(
        False,
        "Whether the page has buttons that record the run, save or reset the parameters of the "
        "identifier and acknowledge rejected files; false: the page is read-only.",
    )
    record_folder: str = option(
        "~/.ros/recordings",
        "Folder for the bags recorded from the page; `mr-damper live --bag FILE` opens them again.",
    )
    allowed_hosts: str = option(
        "",
        "Further host names and addresses of the page, separated by blanks: rig.example "
        "192.168.7.20. They are needed behind a proxy or address translation. Localhost, the host "
        "name of this computer (also with .local) and the address of the request are always "
        "allowed. Other names are rejected, because a web site can make its own name point to "
        "this computer.",
    )
    identifier: str = option(
        "identifier",
        "Name of the identifier that receives these commands, in the namespace of this node.",
    )


class LiveNode(Node):
    """Stores the messages of the other nodes; the thread of the page's server reads them."""

    def __init__(self) -> None:
        super().__init__("live")
        self._options = options = NodeParameters(self, LiveParameters).values
        self._record = LiveRecord()
        self._recording: _BagRecording | None = None
        self._waiting: deque[tuple[str, Mapping[str, str]]] = deque()
        commands = _COMMANDS if options.allow_commands else {}
        self._identifier_clients = {
            name: self.create_client(kind, f"{options.identifier}/{name}")
            for name, kind in commands.items()
        }
        try:
            self._page = PageServer(
                self._record,
                options.host,
                options.port,
                self.get_namespace(),
                (_RECORD, _STOP, *commands) if commands else (),
                self._take_command,
                options.allowed_hosts.split(),
            )
        except ValueError as error:
            raise ValueError(
                f"allowed_hosts: {error}: give names and addresses, separated by blanks"
            ) from error
        except OSError as error:
            raise ValueError(
                f"the page cannot be served at {options.host}, port {options.port}: "
                f"{error.strerror or error}; choose another with -p port:=NUMBER"
            ) from error
        self._input = RecordInput(self, self._record)
        self.get_logger().info(f"the page is at {self._page.address}")
        if options.host not in LOCAL:
            self.get_logger().warning(
                "every computer that can reach this one can see the page"
                + (" and give commands" if commands else "")
            )

    def destroy_node(self) -> None:
        """Stop serving and recording, then end."""
        self._page.close()
        self._stop_recording()
        super().destroy_node()

    def do_commands(self) -> float:
        """Carry out the commands from the page; returns the seconds until the next check."""
        while self._waiting:
            name, arguments = self._waiting.popleft()
            if name == _RECORD:
                self._begin_recording(arguments)
            elif name == _STOP:
                self._stop_recording()
            else:
                self._call(name)
        if self._recording is not None and self._recording.failure:
            self._stop_recording()
        return 0.1

    def _take_command(self, name: str, arguments: Mapping[str, str]) -> bool:
        """Queue a command from the thread of the server; returns False if the queue is full."""
        if len(self._waiting) >= 4:
            return False
        self._waiting.append((name, arguments))
        return True

    def _begin_recording(self, arguments: Mapping[str, str]) -> None:
        if self._recording is not None:
            return
        entries = {key: arguments.get(key, "").strip() for key in ("name", "operator", "note")}
        entries["name"] = entries["name"] or "run"
        by = f" by {entries['operator']}" if entries["operator"] else ""
        details = {
            **entries,
            "provenance": f"recorded from the page{by}: {entries['note']}".rstrip(": "),
        }
        if self._record.parameters is not None:
            details["start_set"] = self._record.parameters.to_yaml()
        plain = re.sub(r"[^\w.+-]+", "_", details["name"]).strip("._")[:60] or "run"
        folder = Path(self._options.record_folder).expanduser()
        path = folder / f"{time.strftime('%Y%m%d_%H%M%S')}_{plain}"
        try:
            self._recording = _BagRecording(self, path, details)
        except (OSError, ValueError) as error:
            self._record.add_event(f"recording cannot start: {reason_of(error)}")
            return
        began = f"{time.time():.3f}"
        self._record.set_recording({**entries, "path": str(path), "began": began})
        self.get_logger().info(f"recording to {path}")

    def _stop_recording(self) -> None:
        recording, self._recording = self._recording, None
        if recording is None:
            return
        self._record.set_recording(None)
        failure = recording.close()
        self._record.add_event(
            f"the recording has failed: {failure}" if failure else f"recorded: {recording.path}"
        )

    def _call(self, name: str) -> None:
        client = self._identifier_clients[name]
        if not client.service_is_ready():
            self._record.add_event(f"{name}: no node offers the service {client.srv_name}")
            return
        self.get_logger().info(f"{name} was requested on the page")

        def report(future: Future) -> None:
            answer: Any = future.result()
            outcome = "done" if answer.success else "refused"
            self._record.add_event(f"{name}: {outcome}: {answer.message}")

        client.call_async(client.srv_type.Request()).add_done_callback(report)


main = partial(run, LiveNode, LiveParameters, between=LiveNode.do_commands)
