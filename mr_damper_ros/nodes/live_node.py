"""Node that serves a page on which people see the running system."""

from __future__ import annotations

import math
import queue
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from mr_damper_msgs.msg import DamperParameters, DamperSignals, FitReport
from mr_damper_msgs.srv import SaveParameters
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from sensor_msgs.msg import Temperature
from std_srvs.srv import Trigger

from mr_damper_ros.live.live_record import Concern, LiveRecord, SetSeen, WindowSeen
from mr_damper_ros.live.page_server import PageServer, is_local
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import to_nanoseconds
from mr_damper_ros.nodes.mirrors import SIGNALS_TOPIC
from mr_damper_ros.nodes.node_parameters import ConfigurationError, NodeParameters
from mr_damper_ros.nodes.spinning import run
from mr_damper_ros.settings.option_table import ParameterTable, option
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.acceptance import Verdict

_WAITING = 50
"""Signals that may wait; then the oldest go. Nobody waits for whoever only looks."""

_SAME = (
    *("nrmse_before", "nrmse_after", "force_scale", "temperature", "current", "peak_velocity"),
    *("amplitude", "frequency"),
)
"""Figures of a window that are called as in FitReport."""


_OF_A_SET = ("model", "source", "node", "nrmse")
_ARRAYS_OF_A_SET = ("names", "units", "values", "standard_errors", "observable")
"""What of a set is called as in DamperParameters."""


def listen(node: Node, record: LiveRecord) -> None:
    """Subscribe a node to all that is shown, in its namespace, and keep it in the record."""
    seen = _Ear(record, node.get_namespace().strip("/"))
    looking = QoSProfile(
        reliability=ReliabilityPolicy.BEST_EFFORT, history=HistoryPolicy.KEEP_LAST, depth=_WAITING
    )
    for kind, topic, hear, profile in (
        (DamperSignals, SIGNALS_TOPIC, seen.signals, looking),
        (DamperParameters, "damper/parameters", seen.parameters, quality.latched()),
        (Temperature, "damper/fluid_temperature", seen.temperature, quality.stream(_WAITING)),
        (FitReport, "damper/fit_report", seen.report, quality.stream(_WAITING)),
        (DiagnosticArray, "/diagnostics", seen.diagnostics, quality.stream(_WAITING)),
    ):
        node.create_subscription(kind, topic, hear, profile)


class _Ear:
    """Takes messages apart; ``namespace`` is that of the diagnostics to keep, empty for all."""

    def __init__(self, record: LiveRecord, namespace: str) -> None:
        self._record = record
        self._prefix = f"{namespace}/" if namespace else ""

    def signals(self, message: DamperSignals) -> None:
        self._record.add_signals(
            to_nanoseconds(message.header.stamp) / NANOSECONDS,
            message.displacement,
            message.velocity,
            message.current,
            message.measured_force,
            message.predicted_force,
            valid=message.valid,
        )

    def temperature(self, message: Temperature) -> None:
        self._record.add_fluid_temperature(message.temperature, message.variance**0.5)

    def report(self, message: FitReport) -> None:
        named = Verdict.__members__.values()
        verdict = next((item.name for item in named if item == message.verdict), "NOT_TOLD")
        self._record.add_window(
            WindowSeen(
                figures={
                    **{name: getattr(message, name) for name in _SAME},
                    "time": to_nanoseconds(message.header.stamp) / NANOSECONDS,
                    "force_scale_error": message.force_scale_standard_error,
                    "fit_duration": message.duration,
                    "verdict": float(message.verdict),
                },
                verdict=verdict,
                reason=message.reason,
                parameter_set=message.parameter_set,
                accepted=message.accepted,
                coefficients={
                    name: (value, error)
                    for name, value, error in zip(
                        message.coefficient_names,
                        message.coefficients,
                        message.coefficient_standard_errors,
                        strict=False,
                    )
                    if math.isfinite(value)
                },
            )
        )

    def parameters(self, message: DamperParameters) -> None:
        arrays: dict[str, Any] = {n: list(getattr(message, n)) for n in _ARRAYS_OF_A_SET}
        if len({len(array) for array in arrays.values()}) > 1:
            return
        self._record.set_parameters(
            SetSeen(
                time=to_nanoseconds(message.header.stamp) / NANOSECONDS,
                set_id=message.id,
                peak_velocity_range=(message.peak_velocity_min, message.peak_velocity_max),
                current_range=(message.current_min, message.current_max),
                **{name: getattr(message, name) for name in _OF_A_SET},
                **arrays,
            )
        )

    def diagnostics(self, message: DiagnosticArray) -> None:
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


_COMMANDS = {
    "save_parameters": SaveParameters,
    "reset": Trigger,
    "acknowledge": Trigger,
}
"""Services of the identifier that the page may call, with empty requests."""

_WAITING_COMMANDS = 4

_LOOK = 0.1
"""Seconds between two looks whether somebody has pressed a button."""


@dataclass(frozen=True)
class LiveParameters(ParameterTable):
    """Parameters of the live node.

    It serves a page that shows the running system of its namespace, from damper/signals,
    damper/fit_report, damper/parameters, damper/fluid_temperature and /diagnostics.
    """

    host: str = option(
        "127.0.0.1",
        "Address of the page. 127.0.0.1: this computer only; others use a tunnel (ssh -L "
        "8770:127.0.0.1:8770 RIG). 0.0.0.0: everybody who can reach this computer, "
        "unencrypted and without a password.",
    )
    port: int = option(
        8770,
        "Port of the page; 0: any free port. The node logs the address of the page at its start.",
        minimum=0,
        maximum=65535,
    )
    allow_commands: bool = option(
        False,
        "Whether the page has buttons that save or reset the parameters of the identifier and "
        "acknowledge rejected files; false: the page is read-only.",
    )
    allowed_hosts: str = option(
        "",
        "Further host names and addresses of the page, separated by blanks: rig.example "
        "192.168.7.20. Localhost, the host name of this computer (also with .local) and the "
        "address of the request are always allowed. Other names are refused, because a web "
        "site can make its own name point to this computer. Needed behind a proxy or address "
        "translation.",
    )
    identifier: str = option(
        "identifier",
        "Name of the identifier that receives these commands, in the namespace of this node.",
    )


class LiveNode(Node):
    """Keeps what the others publish; threads of the page's server read it."""

    def __init__(self) -> None:
        super().__init__("live")
        options = NodeParameters(self, LiveParameters).values
        self._record = LiveRecord()
        self._waiting: queue.Queue[str] = queue.Queue(_WAITING_COMMANDS)
        commands = _COMMANDS if options.allow_commands else {}
        self._of_the_identifier = {
            name: self.create_client(kind, f"{options.identifier}/{name}")
            for name, kind in commands.items()
        }
        try:
            self._page = PageServer(
                self._record,
                options.host,
                options.port,
                self.get_namespace(),
                tuple(commands),
                self._take_command,
                options.allowed_hosts.split(),
            )
        except ValueError as error:
            raise ConfigurationError(
                f"allowed_hosts: {error}: give names and addresses, separated by blanks"
            ) from error
        except OSError as error:
            raise ConfigurationError(
                f"the page cannot be served at {options.host}, port {options.port}: "
                f"{error.strerror or error}; choose another with -p port:=NUMBER"
            ) from error
        listen(self, self._record)
        self.get_logger().info(f"the page is at {self._page.address}")
        if not is_local(options.host):
            self.get_logger().warning(
                "everybody who can reach this computer can see the page"
                + (" and give commands" if commands else "")
            )

    def destroy_node(self) -> None:
        """Stop serving, then end."""
        self._page.close()
        super().destroy_node()

    def attend(self) -> float:
        """Pass on what was asked for on the page; returns the seconds until the next look."""
        while not self._waiting.empty():
            self._call(self._waiting.get_nowait())
        return _LOOK

    def _take_command(self, name: str) -> bool:
        """Called by the threads of the server."""
        try:
            self._waiting.put_nowait(name)
        except queue.Full:
            return False
        return True

    def _call(self, name: str) -> None:
        client = self._of_the_identifier[name]
        if not client.service_is_ready():
            self._record.add_event(f"{name}: nobody offers {client.srv_name}")
            return
        self.get_logger().info(f"{name} was requested on the page")
        client.call_async(client.srv_type.Request()).add_done_callback(
            lambda future: self._tell(name, future)
        )

    def _tell(self, name: str, future: Future) -> None:
        answer: Any = future.result()
        outcome = "done" if answer.success else "refused"
        self._record.add_event(f"{name}: {outcome}: {answer.message}")


def main() -> int:
    """Run the node."""
    return run(LiveNode, LiveParameters, between=LiveNode.attend)
