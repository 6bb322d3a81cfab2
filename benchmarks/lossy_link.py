"""Two network namespaces that act as two machines, with a bad network between them.

A thread carries every Ethernet frame from one tap device to the other, so that no kernel module
for traffic control (netem) is needed. It needs Linux, the rights of root, and iproute2.
"""

from __future__ import annotations

import ctypes
import fcntl
import heapq
import os
import random
import select
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

_TUNSETIFF = 0x400454CA
_IFF_TAP, _IFF_NO_PI = 0x0002, 0x1000
_CLONE_NEWNET = 0x40000000
_LARGEST_FRAME = 65_536


class NetworkError(RuntimeError):
    """The namespaces or their link cannot be created; the message gives the reason."""


class LossyLink:
    """Namespaces "left" and "right", each with one interface, joined by a link.

    ``loss`` is the fraction of frames that is dropped in each direction, and ``delay`` [s] the
    delay of the other frames. Raises NetworkError if the link cannot be created.
    """

    def __init__(self, loss: float, delay: float, seed: int = 0) -> None:
        self.frames = 0
        self.dropped = 0
        self._loss = loss
        self._delay = delay
        self._random = random.Random(seed)
        self._names = {side: f"mr_damper_{os.getpid()}_{side}" for side in ("left", "right")}
        self._undo = ExitStack()
        try:
            self._taps = [self._side(number, side) for number, side in enumerate(self._names)]
        except OSError as error:
            self._undo.close()
            raise NetworkError(f"there can be no network namespaces here: {error}") from error
        self._ended, end = os.pipe()
        self._undo.callback(os.close, self._ended)
        self._thread = threading.Thread(target=self._carry, name="link", daemon=True)
        self._thread.start()
        self._undo.callback(self._thread.join)
        self._undo.callback(os.close, end)

    def close(self) -> None:
        """Remove the link and the namespaces."""
        self._undo.close()

    @contextmanager
    def inside(self, side: str) -> Iterator[None]:
        """Context in which this thread opens sockets and starts programs in one namespace."""
        with open("/proc/thread-self/ns/net") as own, open(self._path(side)) as other:
            _enter(other.fileno())
            try:
                yield
            finally:
                _enter(own.fileno())

    def _path(self, side: str) -> Path:
        return Path("/var/run/netns") / self._names[side]

    def _side(self, number: int, side: str) -> int:
        name, device = self._names[side], f"mrd{os.getpid() % 100_000}{side[0]}"
        _ip("netns", "add", name)
        self._undo.callback(_ip, "netns", "delete", name)
        tap = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
        self._undo.callback(os.close, tap)
        fcntl.ioctl(tap, _TUNSETIFF, struct.pack("16sH", device.encode(), _IFF_TAP | _IFF_NO_PI))
        _ip("link", "set", device, "netns", name)
        _ip("-n", name, "address", "add", f"10.199.0.{number + 1}/24", "dev", device)
        for interface in ("lo", device):
            _ip("-n", name, "link", "set", interface, "up")
        _ip("-n", name, "route", "add", "224.0.0.0/4", "dev", device)
        return tap

    def _carry(self) -> None:
        underway: list[tuple[float, int, int, bytes]] = []
        to = dict(zip(self._taps, reversed(self._taps), strict=True))
        while True:
            timeout = max(underway[0][0] - time.monotonic(), 0.0) if underway else None
            ready, _, _ = select.select([*self._taps, self._ended], [], [], timeout)
            if self._ended in ready:
                return
            for tap in ready:
                frame = os.read(tap, _LARGEST_FRAME)
                self.frames += 1
                if self._random.random() < self._loss:
                    self.dropped += 1
                else:
                    due = time.monotonic() + self._delay
                    heapq.heappush(underway, (due, self.frames, to[tap], frame))
            while underway and underway[0][0] <= time.monotonic():
                _, _, tap, frame = heapq.heappop(underway)
                os.write(tap, frame)


def _ip(*arguments: str) -> None:
    done = subprocess.run(["ip", *arguments], check=False, capture_output=True, text=True)
    if done.returncode != 0:
        raise OSError(f"ip {' '.join(arguments)}: {done.stderr.strip()}")


def _enter(namespace: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.setns(namespace, _CLONE_NEWNET) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
