"""The bridge with a stream: what a sender puts on a wire is on the topics, and a cut is told."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from mr_damper_msgs.msg import MtsSamples, SupplyCurrent
from support import Listener

from mr_damper_ros.nodes.messages import from_field

COLUMNS = "time:us,displacement:mm,force:kN,current:mA"
RATE = 500


class Microcontroller:
    """Sends lines over TCP, 20 samples every 40 ms, to whoever connects; ``cut`` ends the link."""

    def __init__(self) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp:127.0.0.1:{self._server.getsockname()[1]}"
        self._server.settimeout(0.1)
        self._ended = threading.Event()
        self._link: socket.socket | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        begin = time.monotonic()
        while not self._ended.is_set():
            try:
                self._link, _ = self._server.accept()
            except TimeoutError:
                continue
            sent = round((time.monotonic() - begin) * RATE)
            with suppress(OSError):
                while not self._ended.is_set():
                    until = round((time.monotonic() - begin) * RATE)
                    self._link.sendall(b"".join(self._line(k) for k in range(sent, until)))
                    sent = until
                    time.sleep(0.04)

    def _line(self, k: int) -> bytes:
        phase = 2.0 * math.pi * k / RATE
        return b"%d,%.6f,%.6f,1500\n" % (
            k * 1_000_000 // RATE,
            5.0 * math.sin(phase),
            math.cos(phase),
        )

    def cut(self) -> None:
        assert self._link is not None
        self._link.shutdown(socket.SHUT_RDWR)
        self._link.close()

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self._server.close()


@pytest.fixture
def sender() -> Iterator[Microcontroller]:
    made = Microcontroller()
    yield made
    made.close()


def count(samples: list[MtsSamples]) -> int:
    return sum(len(message.force) for message in samples)


def test_lines_over_tcp_come_on_the_topics_also_after_a_cut(
    start: Any, listener: Listener, sender: Microcontroller
) -> None:
    samples = listener.listen(MtsSamples, "mts/samples")
    current = listener.listen(SupplyCurrent, "supply/current")
    start("bridge", source="stream", stream__address=sender.address, stream__columns=COLUMNS)
    listener.until(lambda: count(samples) >= 200, "samples")
    moved = np.concatenate([from_field(message.displacement) for message in samples])
    pulled = np.concatenate([from_field(message.force) for message in samples])
    # Sine and cosine: 5 mm, 1 kN.
    np.testing.assert_allclose(np.hypot(moved / 0.005, pulled / 1000.0), 1.0, atol=1e-4)
    assert samples[0].period == pytest.approx(1.0 / RATE, rel=1e-6)
    listener.until(lambda: current, "the current, which is on a topic of its own")
    assert {message.current for message in current} == {1.5}

    sender.cut()
    found = listener.wait_for_finding("bridge: source", "")
    before = samples[-1].seq
    samples.clear()
    listener.until(lambda: count(samples) >= 100, "samples after the cut")
    found = listener.wait_for_finding("bridge: source", "")
    assert {item.key: item.value for item in found.values}["connections"] == "2"
    assert samples[0].seq >= before + 10
