"""Programs of nodes: their arguments, their processes, and a separate ROS domain for them."""

from __future__ import annotations

import atexit
import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from pathlib import Path

PATIENCE = 60.0
"""Deadline [s] for the start or end of a process; generous, for a loaded machine."""


class ProgramError(RuntimeError):
    """A program did not behave as expected; the message contains its output."""


_LIBC = ctypes.CDLL(None)


def signal_at_death_of(parent: int, number: signal.Signals) -> None:
    """Let this process receive a signal when its parent dies, for whatever reason (Linux).

    The signal comes at once if the parent has died before. The request outlives `exec`.
    """
    if sys.platform == "linux":
        _LIBC.prctl(1, number)  # PR_SET_PDEATHSIG
    if os.getppid() != parent:
        os.kill(os.getpid(), number)


def _prepare(parent: int) -> None:
    # In background jobs of a script, Ctrl-C is ignored, and the program would inherit this.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal_at_death_of(parent, signal.SIGTERM)


class Program:
    """A running program; its output is kept in memory, so that it never blocks.

    ``environment`` is added to the environment of this process. The program ends when the thread
    that has started it ends, even if it is killed. Raises OSError if the program does not exist.
    """

    def __init__(
        self, command: Sequence[str], environment: Mapping[str, str] | None = None
    ) -> None:
        self.name = Path(command[0]).name
        self._stdout = os.memfd_create("stdout")
        self._stderr = os.memfd_create("stderr")
        try:
            # In its own process group: Ctrl-C in the terminal ends this process, which then ends
            # the program.
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=self._stdout,
                stderr=self._stderr,
                env={**os.environ, **(environment or {})},
                start_new_session=True,
                preexec_fn=partial(_prepare, os.getpid()),
            )
            # If this process fails, the program and its children must not continue.
            atexit.register(self._process.kill)
        except BaseException:
            # If Ctrl-C interrupted Popen after the fork, the process id is lost, but the output
            # identifies the process.
            output = os.fstat(self._stdout)
            for pid in _children_of(os.getpid()):
                with suppress(OSError):
                    if os.path.samestat(os.stat(f"/proc/{pid}/fd/1"), output):
                        os.kill(pid, signal.SIGKILL)
                        os.waitpid(pid, 0)
            os.close(self._stdout)
            os.close(self._stderr)
            raise

    @property
    def pid(self) -> int:
        """Id of the process, and of the group of all its children."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether the program is running."""
        return self._process.poll() is None

    @property
    def exit_code(self) -> int | None:
        """The exit code, or minus the number of the signal that ended it; None while it runs."""
        return self._process.poll()

    @property
    def output(self) -> str:
        """The standard output so far."""
        return _content(self._stdout)

    @property
    def errors(self) -> str:
        """The standard error so far, which contains the log of a node."""
        return _content(self._stderr)

    @property
    def log(self) -> str:
        """Standard output and standard error so far."""
        return self.output + self.errors

    @property
    def last_words(self) -> str:
        """The last lines of the output, joined in one line."""
        return " / ".join(self.log.strip().splitlines()[-3:])

    @property
    def children(self) -> list[int]:
        """Ids of its running child processes."""
        return _children_of(self.pid)

    def wait_for_log(self, part: str, patience: float = PATIENCE) -> None:
        """Wait until the standard error contains this text.

        Raises ProgramError if the program ends first, or after ``patience`` [s].
        """
        deadline = time.monotonic() + patience
        while part not in self.errors:
            if not self.running and part not in self.errors:
                raise ProgramError(f"{self.name} ended before it logged {part!r}: {self.errors}")
            if time.monotonic() > deadline:
                raise ProgramError(f"{self.name} never logged {part!r}: {self.errors}")
            time.sleep(0.02)

    def wait(self, patience: float = PATIENCE) -> int:
        """Wait for the end of the program; returns the exit code.

        Raises ProgramError after ``patience`` [s].
        """
        try:
            return self._process.wait(patience)
        except subprocess.TimeoutExpired:
            raise ProgramError(f"{self.name} did not end within {patience:g} s") from None

    def send_signal(self, number: signal.Signals) -> None:
        """Send the program a signal; no effect if it has ended."""
        self._process.send_signal(number)

    def kill(self) -> None:
        """Kill the program, so that it cannot clean up, and wait for its end."""
        self._process.kill()
        self._process.wait(PATIENCE)

    def stop(self, number: signal.Signals = signal.SIGINT, patience: float = PATIENCE) -> int:
        """End the program as Ctrl-C does, or kill it if that fails; returns the exit code."""
        self.send_signal(number)
        try:
            return self.wait(patience)
        except ProgramError:
            self.kill()
            return self._process.returncode

    def close(self) -> None:
        """End the program, if it runs, and discard its output."""
        if self.running:
            self.stop()
        atexit.unregister(self._process.kill)
        os.close(self._stdout)
        os.close(self._stderr)


def _children_of(parent: int) -> list[int]:
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has just ended
            # The name, in parentheses, may contain blanks.
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
            if int(fields[1]) == parent:
                found.append(int(entry.name))
    return found


def node_arguments(
    parameters: Mapping[str, object], remappings: Mapping[str, str] | None = None
) -> list[str]:
    """Arguments of a node; two underscores in the name of a parameter become a dot."""
    arguments = ["--ros-args"]
    for name, other in (remappings or {}).items():
        arguments += ["-r", f"{name}:={other}"]
    for name, value in parameters.items():
        written = str(value).lower() if isinstance(value, bool) else value
        arguments += ["-p", f"{name.replace('__', '.')}:={written}"]
    return arguments


def _content(file: int) -> str:
    return os.pread(file, os.fstat(file).st_size, 0).decode(errors="replace")


class RosDomain(AbstractContextManager):
    """A ROS domain that no other process can reserve until this object is closed.

    Raises RuntimeError if no domain is free.
    """

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        # Above the usual numbers, and below 102, because the ports of higher ones may be in use.
        for number in range(61, 101):
            try:
                self._socket.bind(("127.0.0.1", 20_000 + number))
            except OSError:
                continue
            self.number = number
            return
        self._socket.close()
        raise RuntimeError("all ROS domains for tests, figures and demonstrations are in use")

    @property
    def environment(self) -> dict[str, str]:
        """Environment variables for a program in this domain, which other computers cannot see."""
        return {
            "ROS_DOMAIN_ID": str(self.number),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "RCUTILS_COLORIZED_OUTPUT": "0",
        }

    @contextmanager
    def entered(self) -> Iterator[None]:
        """Set the environment of this process to the domain, and restore it at the end."""
        before = dict(os.environ)
        os.environ.update(self.environment)
        try:
            yield
        finally:
            os.environ.clear()
            os.environ.update(before)

    def close(self) -> None:
        """Release the domain."""
        self._socket.close()

    def __exit__(self, *_: object) -> None:
        self.close()
