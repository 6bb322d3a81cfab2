"""A ROS domain that nothing else on this computer uses, for tests, figures and demonstrations."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType

_NUMBERS = range(61, 101)
"""Above the numbers that people choose by hand; below those whose ports may be taken (102)."""

_FIRST_PORT = 20_000
"""A domain is held by the port of its number above this one, which nobody else can bind."""


class RosDomain:
    """A domain that no other object of this kind has, in whatever process, until it is closed.

    Raises RuntimeError where none is left.
    """

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        for number in _NUMBERS:
            try:
                self._socket.bind(("127.0.0.1", _FIRST_PORT + number))
            except OSError:
                continue
            self.number = number
            return
        self._socket.close()
        raise RuntimeError("all ROS domains for tests, figures and demonstrations are in use")

    @property
    def environment(self) -> dict[str, str]:
        """What a program must be started with to be in this domain, and in no other's reach."""
        return {
            "ROS_DOMAIN_ID": str(self.number),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "RCUTILS_COLORIZED_OUTPUT": "0",
        }

    @contextmanager
    def entered(self) -> Iterator[None]:
        """Let this process and what it starts meanwhile be in it; afterwards all is as before."""
        before = dict(os.environ)
        os.environ.update(self.environment)
        try:
            yield
        finally:
            os.environ.clear()
            os.environ.update(before)

    def close(self) -> None:
        """Let others have the domain."""
        self._socket.close()

    def __enter__(self) -> RosDomain:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
