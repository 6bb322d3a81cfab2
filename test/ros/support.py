"""Programs as processes, and a node that listens to them; with deadlines instead of sleeps."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter

from mr_damper_ros.nodes.observer import Observer
from mr_damper_ros.processes.programs import Program, node_arguments

PATIENCE = 30.0
"""Deadline [s] of all waits; generous, for a loaded machine."""


def installed_programs() -> Path:
    """Return the folder of the installed executables; fails the test if there is none."""
    try:
        return Path(get_package_prefix("mr_damper_ros")) / "lib" / "mr_damper_ros"
    except PackageNotFoundError:
        pytest.fail("mr_damper_ros is not built, or its environment not sourced")


def assert_one_sentence(text: str) -> None:
    """Assert that the text is one line for the user, and no traceback."""
    assert "Traceback" not in text, text
    assert len(text.strip().splitlines()) == 1, text


class TriedProgram(Program):
    """An installed program under test; fails unless it ends cleanly."""

    def __init__(
        self, path: Path, *arguments: str, remap: dict[str, str] | None = None, **parameters: object
    ) -> None:
        super().__init__([str(path), *arguments, *node_arguments(parameters, remap)])

    def wait(self, patience: float = PATIENCE) -> int:
        """Wait for its end; returns the exit code."""
        return super().wait(patience)

    def stop(self, number: signal.Signals = signal.SIGINT, patience: float = PATIENCE) -> int:
        """Ask it to end, and assert that it does so cleanly and leaves nothing behind."""
        code = self.ended_with(number, patience)
        assert code == 0, self.errors
        return code

    def ended_with(self, number: signal.Signals, patience: float = PATIENCE) -> int:
        """The exit code when it is asked to end; asserts that it leaves nothing behind."""
        assert self.running, f"{self.name} has ended by itself: {self.errors}"
        self.send_signal(number)
        code = self.wait(patience)
        assert "Traceback" not in self.log, self.errors
        with pytest.raises(ProcessLookupError):
            os.killpg(self.pid, 0)
        return code

    def end(self) -> None:
        """Clean up after the test: stop the program if it still runs."""
        try:
            if self.running:
                self.stop()
        finally:
            if self.running:
                os.killpg(self.pid, signal.SIGKILL)
            self.kill()
            # Shown if the test has failed.
            print(f"{self.name} said:\n{self.log}")
            self.close()


class Listener(Observer):
    """A node of the test that also calls services."""

    def __init__(self) -> None:
        super().__init__("listener")
        self._findings: list[tuple[int, DiagnosticStatus]] = []
        # Subscribed at the start, because some messages are sent only once.
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._hear_findings, 1000)

    def _hear_findings(self, array: DiagnosticArray, info: dict[str, int]) -> None:
        self._findings += [(info["source_timestamp"], status) for status in array.status]

    def until(
        self, condition: Callable[[], Any], what: str, patience: float = PATIENCE, tick: float = 0.1
    ) -> None:
        """Spin until the condition holds; fails after the deadline."""
        super().until(condition, what, patience, tick)

    def call(self, service_type: type, name: str, request: Any = None) -> Any:
        """Call a service and return its response."""
        client = self.node.create_client(service_type, name)
        try:
            self.until(client.service_is_ready, f"the service {name}")
            future = client.call_async(request or service_type.Request())
            self.until(future.done, f"an answer of {name}")
            return future.result()
        finally:
            self.node.destroy_client(client)

    def state(self, node: str) -> int:
        """State of a managed node."""
        return self.call(GetState, f"{node}/get_state").current_state.id

    def change(self, node: str, transition: int) -> bool:
        """Ask a managed node for a transition; returns whether it was made."""
        request = ChangeState.Request(transition=Transition(id=transition))
        return self.call(ChangeState, f"{node}/change_state", request).success

    def set_parameter(self, node: str, name: str, value: object) -> SetParametersResult:
        """Set a parameter of a node, and return the node's answer."""
        message: ParameterMessage = Parameter(name, value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[message])
        return self.call(SetParameters, f"{node}/set_parameters", request).results[0]

    def wait_for_finding(self, name: str, part: str) -> DiagnosticStatus:
        """Wait for a new diagnostic of this name whose message contains this text."""
        now_ns = time.time_ns()
        found: list[DiagnosticStatus] = []

        def look() -> bool:
            found.extend(
                status
                for sent_ns, status in self._findings
                if sent_ns >= now_ns and status.name == name and part in status.message
            )
            self._findings.clear()
            return bool(found)

        self.until(look, f"{part!r} of {name} on /diagnostics")
        return found[0]
