"""The installed nodes as processes: started in a ROS domain of their own, measured, ended by id.

Only what is started here is ever ended; everything that is waited for has a deadline.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy
from ament_index_python.packages import get_package_prefix
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile

PATIENCE = 60.0
"""Deadline [s] of everything that is waited for; generous, for a loaded machine."""

_DOMAINS = range(21, 61)
_FIRST_PORT = 20_121

_PROFILES = Path(__file__).parents[1] / "config" / "fastdds.xml"
"""Nodes that are started again are found sooner; see there."""

_TICKS = os.sysconf("SC_CLK_TCK")


class Domain:
    """A ROS domain on this computer that no other benchmark uses, while this object lives.

    Raises RuntimeError where none is left.
    """

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        for place, number in enumerate(_DOMAINS):
            try:
                self._socket.bind(("127.0.0.1", _FIRST_PORT + place))
            except OSError:
                continue
            self.number = number
            return
        self._socket.close()
        raise RuntimeError("all ROS domains of the benchmarks are in use")

    def close(self) -> None:
        """Let others use the domain."""
        self._socket.close()

    @property
    def environment(self) -> dict[str, str]:
        """What a program must be started with to be in this domain, and in no other's reach."""
        return {
            "ROS_DOMAIN_ID": str(self.number),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "RCUTILS_COLORIZED_OUTPUT": "0",
            "FASTRTPS_DEFAULT_PROFILES_FILE": str(_PROFILES),
        }


class Process:
    """A running program, its output kept in memory; ``environment`` is added to this process's."""

    def __init__(self, command: list[str], environment: dict[str, str]) -> None:
        self._log = os.memfd_create("log")
        self.name = Path(command[0]).name
        # A group of its own, so that a Ctrl-C in the terminal ends the benchmark, which ends it.
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
            env={**os.environ, **environment},
            start_new_session=True,
        )
        # Where the benchmark fails, nothing of it goes on.
        atexit.register(self._process.kill)

    @property
    def pid(self) -> int:
        """Id of the process."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self._process.poll() is None

    @property
    def log(self) -> str:
        """What it has written so far, to both outputs."""
        return os.pread(self._log, os.fstat(self._log).st_size, 0).decode(errors="replace")

    @property
    def resident_bytes(self) -> int:
        """Memory [B] that it has in use (resident set), without its children's."""
        return resident_bytes(self.pid)

    @property
    def cpu_seconds(self) -> float:
        """Processor time [s] that it has used so far, without its children's."""
        fields = _fields(self.pid)
        return (int(fields[11]) + int(fields[12])) / _TICKS

    @property
    def children(self) -> list[int]:
        """Ids of the processes that it has started and that still run."""
        found = []
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                with contextlib.suppress(OSError):  # it has just ended
                    if int(_fields(int(entry.name))[1]) == self.pid:
                        found.append(int(entry.name))
        return found

    def kill(self) -> None:
        """End it at once, without a chance to tidy up, and wait until it is gone."""
        self._process.kill()
        self._process.wait(PATIENCE)

    def stop(self) -> int:
        """Ask it to end as Ctrl-C does and return its exit code; killed where it does not end."""
        if self.running:
            self._process.send_signal(signal.SIGINT)
        return self.wait()

    def wait(self) -> int:
        """Wait until it has ended and return its exit code; killed where it does not end."""
        try:
            return self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self.kill()
            return self._process.returncode

    def close(self) -> None:
        """End it and forget its output."""
        self.stop()
        os.close(self._log)
        atexit.unregister(self._process.kill)


def resident_bytes(pid: int) -> int:
    """Memory [B] that a process has in use (resident set), shared libraries included."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def _fields(pid: int) -> list[str]:
    """State, parent's id and the following fields that Linux has of a process."""
    # The name, in parentheses, may hold blanks: the fields are counted from its end.
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()


def start_node(program: str, domain: Domain, *arguments: str, **parameters: object) -> Process:
    """Start an installed node, such as "bridge", in a domain.

    ``arguments`` are more ROS arguments (``"-r", "a:=b"``); in the names of ``parameters`` two
    underscores stand for a dot.
    """
    path = Path(get_package_prefix("mr_damper_ros")) / "lib" / "mr_damper_ros" / program
    command = [str(path), "--ros-args", *arguments]
    for name, value in parameters.items():
        written = str(value).lower() if isinstance(value, bool) else value
        command += ["-p", f"{name.replace('__', '.')}:={written}"]
    return Process(command, domain.environment)


class Observer:
    """A node of the benchmark's own in a domain: it listens, and waits for others."""

    def __init__(self, domain: Domain) -> None:
        self._context = rclpy.Context()
        # They are read from there alone.
        for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE"):
            os.environ[name] = domain.environment[name]
        self._context.init(domain_id=domain.number)
        self.node = rclpy.create_node("observer", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

    def close(self) -> None:
        """Leave the domain."""
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()

    def listen(
        self, message_type: type, topic: str, hear: Callable[[Any], None], quality: QoSProfile | int
    ) -> None:
        """Call ``hear`` with each message while spinning."""
        self.node.create_subscription(message_type, topic, hear, quality)

    def spin_once(self, timeout: float = 0.1) -> None:
        """Take what comes next, if anything comes within ``timeout`` [s]."""
        self._executor.spin_once(timeout_sec=timeout)

    def spin_for(self, duration: float) -> None:
        """Take what comes in the next ``duration`` seconds."""
        end = time.monotonic() + duration
        while (left := end - time.monotonic()) > 0.0:
            self.spin_once(left)

    def until(
        self, condition: Callable[[], Any], what: str, patience: float = PATIENCE, tick: float = 0.1
    ) -> None:
        """Spin until the condition holds; raises TimeoutError after ``patience`` [s]."""
        deadline = time.monotonic() + patience
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(f"in vain waited {patience:g} s for {what}")
            self.spin_once(tick)

    def wait_for_publishers(self, topic: str, count: int = 1) -> None:
        """Wait until so many publishers of a topic are known: their nodes are ready."""
        self.until(
            lambda: self.node.count_publishers(topic) >= count, f"{count} publishers of {topic}"
        )

    def wait_for_subscribers(self, topic: str, count: int = 1) -> None:
        """Wait until so many subscribers of a topic are known: their nodes are ready."""
        self.until(
            lambda: self.node.count_subscribers(topic) >= count, f"{count} subscribers of {topic}"
        )
