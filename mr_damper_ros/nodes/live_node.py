"""Node that serves a page on which people see the running system."""

from __future__ import annotations

import queue
from dataclasses import dataclass
from typing import Any

from mr_damper_msgs.srv import SaveParameters
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from mr_damper_ros.live.live_record import LiveRecord
from mr_damper_ros.live.page_server import PageServer, is_local
from mr_damper_ros.nodes.live_inputs import listen
from mr_damper_ros.nodes.node_parameters import ConfigurationError, NodeParameters
from mr_damper_ros.nodes.spinning import run
from mr_damper_ros.settings.option_table import ParameterTable, option

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
        "Address to serve the page at. 127.0.0.1: for this computer alone; others come through a "
        "tunnel (ssh -L 8770:127.0.0.1:8770 RIG). 0.0.0.0: for everybody who reaches this "
        "computer, unencrypted and without a password.",
        read_only=True,
    )
    port: int = option(
        8770,
        "Port of the page; 0 takes any that is free. The node says at its start where the page is.",
        minimum=0,
        maximum=65535,
        read_only=True,
    )
    allow_commands: bool = option(
        False,
        "Whether the page has buttons that save or reset the parameters of the identifier and "
        "acknowledge what it has set aside; false: the page only shows.",
        read_only=True,
    )
    allowed_hosts: str = option(
        "",
        "Other names and addresses under which browsers may ask for the page, separated by blanks: "
        "rig.example 192.168.7.20. Localhost, this computer's host name (also with .local) and the "
        "address that a request comes to are always allowed; any other name is refused, since a "
        "web site can make a name of its own point to this computer. Needed behind a proxy or "
        "address translation.",
        read_only=True,
    )
    identifier: str = option(
        "identifier",
        "Name of the node that these commands go to, in the namespace of this one.",
        read_only=True,
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
                "everybody who reaches this computer can see the page"
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
        self.get_logger().info(f"{name} was asked for on the page")
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
