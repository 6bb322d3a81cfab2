"""Programs started as processes, and a node that listens to them; deadlines instead of sleeps."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import rclpy
from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile

PATIENCE = 30.0
"""Deadline [s] of everything that is waited for; generous, for a loaded machine."""

_DOMAINS = range(61, 101)
_FIRST_PORT = 20_061


class DomainLock:
    """A ROS domain that no other test process uses, for as long as this object lives."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        for number in _DOMAINS:
            try:
                self._socket.bind(("127.0.0.1", _FIRST_PORT + number - _DOMAINS.start))
            except OSError:
                continue
            self.number = number
            return
        raise RuntimeError("all ROS domains of the tests are in use")


def installed_programs() -> Path:
    """Return the folder of the installed executables; fails the test where there is none."""
    try:
        return Path(get_package_prefix("mr_damper_ros")) / "lib" / "mr_damper_ros"
    except PackageNotFoundError:
        pytest.fail("mr_damper_ros is not built, or its environment not sourced")


def assert_one_sentence(text: str) -> None:
    """Assert that the text is one line for the user, and no traceback."""
    assert "Traceback" not in text, text
    assert len(text.strip().splitlines()) == 1, text


class Program:
    """A running program; its output is kept in memory, so that it never blocks."""

    def __init__(
        self,
        path: Path,
        *arguments: str,
        remap: dict[str, str] | None = None,
        **parameters: object,
    ) -> None:
        command = [str(path), *arguments, "--ros-args"]
        for name, value in (remap or {}).items():
            command += ["-r", f"{name}:={value}"]
        for name, value in parameters.items():
            written = str(value).lower() if isinstance(value, bool) else value
            command += ["-p", f"{name.replace('__', '.')}:={written}"]
        self._name = path.name
        self._stdout = os.memfd_create("stdout")
        self._stderr = os.memfd_create("stderr")
        # A group of its own: a shell's background jobs have SIGINT ignored, and what it starts
        # itself shall be found when it has ended.
        self._process = subprocess.Popen(
            command, stdout=self._stdout, stderr=self._stderr, start_new_session=True
        )

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    @property
    def errors(self) -> str:
        """What it has written to stderr, where its log goes too."""
        return self._read(self._stderr)

    @property
    def output(self) -> str:
        return self._read(self._stdout)

    @staticmethod
    def _read(file: int) -> str:
        return os.pread(file, os.fstat(file).st_size, 0).decode(errors="replace")

    def wait_for_log(self, part: str) -> None:
        """Wait until the log has this text."""
        deadline = time.monotonic() + PATIENCE
        while part not in self.errors:
            assert self.running, f"{self._name} ended before it logged {part!r}: {self.errors}"
            assert time.monotonic() < deadline, f"{self._name} never logged {part!r}: {self.errors}"
            time.sleep(0.02)

    def wait(self) -> int:
        """Wait for its end; returns the exit code."""
        return self._process.wait(PATIENCE)

    def send_signal(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def stop(self, number: signal.Signals = signal.SIGINT) -> None:
        """Ask it to end, and see that it does so cleanly, leaving nothing behind."""
        assert self.running, f"{self._name} has ended by itself: {self.errors}"
        self.send_signal(number)
        assert self.wait() == 0, self.errors
        assert "Traceback" not in self.errors + self.output, self.errors
        with pytest.raises(ProcessLookupError):
            os.killpg(self._process.pid, 0)

    def end(self) -> None:
        """Clean up after the test: stop it where it still runs."""
        try:
            if self.running:
                self.stop()
        finally:
            if self.running:
                os.killpg(self._process.pid, signal.SIGKILL)
                self._process.wait()
            os.close(self._stdout)
            os.close(self._stderr)


class Listener:
    """A node that keeps what it hears, and calls services."""

    def __init__(self) -> None:
        self._context = rclpy.Context()
        self._context.init()
        self.node = rclpy.create_node("listener", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

    def __enter__(self) -> Listener:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()

    def listen(
        self, message_type: type, topic: str, quality: QoSProfile | int = 1000, *, raw: bool = False
    ) -> list[Any]:
        """Subscribe; the list grows as messages come."""
        heard: list[Any] = []
        self.node.create_subscription(message_type, topic, heard.append, quality, raw=raw)
        return heard

    def until(self, condition: Callable[[], Any], what: str) -> None:
        """Spin until the condition holds; fails after the deadline."""
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline, f"in vain waited for {what}"
            self._executor.spin_once(timeout_sec=0.1)

    def spin_while(self, condition: Callable[[], bool]) -> None:
        """Spin as long as the condition holds, and until nothing more comes."""
        deadline = time.monotonic() + PATIENCE
        while condition():
            assert time.monotonic() < deadline, "it went on for too long"
            self._executor.spin_once(timeout_sec=0.1)

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

    def set_parameter(self, node: str, name: str, value: object) -> SetParametersResult:
        """Set a parameter of a node, and return what it says to that."""
        message: ParameterMessage = Parameter(name, value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[message])
        return self.call(SetParameters, f"{node}/set_parameters", request).results[0]

    def wait_for_finding(self, name: str, part: str) -> DiagnosticStatus:
        """Wait for a diagnostic of this name whose message has this text."""
        heard = self.listen(DiagnosticArray, "/diagnostics")
        found: list[DiagnosticStatus] = []

        def look() -> bool:
            found.extend(
                status
                for array in heard
                for status in array.status
                if status.name == name and part in status.message
            )
            heard.clear()
            return bool(found)

        self.until(look, f"{part!r} of {name} on /diagnostics")
        return found[0]
