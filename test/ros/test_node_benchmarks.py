"""What the figures of the nodes rest on: counted blocks, and a link that loses packets."""

from __future__ import annotations

import os
import shutil
import socket
import time
from contextlib import closing

import pytest

from benchmarks import lossy_link
from benchmarks.lossy_link import LossyLink, NetworkError
from benchmarks.streaming_load import Counter

PATIENCE = 30.0
RIGHT = "10.199.0.2"


def test_a_missing_block_is_counted() -> None:
    counter = Counter()
    for sequence, count in ((0, 10), (10, 5), (20, 10), (20, 10), (30, 1)):
        counter.take(sequence, count)
    assert (counter.missing, counter.end) == (5, 31)


def test_without_a_link_the_figure_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(duration: float) -> None:
        raise NetworkError("not allowed")

    monkeypatch.setattr(lossy_link, "measure", refuse)
    (figure,) = lossy_link.figures()
    assert (figure.key, figure.value, figure.note) == ("lossy_link_lost", None, "not allowed")


def linked(loss: float) -> LossyLink:
    """Return a link, or skip the test where there can be none."""
    if os.getuid() != 0 or shutil.which("ip") is None:
        pytest.skip("network namespaces need root and iproute2")
    try:
        return LossyLink(loss, delay=0.0)
    except NetworkError as error:
        pytest.skip(str(error))


def datagram_socket(link: LossyLink, side: str) -> socket.socket:
    with link.inside(side):
        return socket.socket(socket.AF_INET, socket.SOCK_DGRAM)


def test_the_link_carries_packets_between_its_sides() -> None:
    with (
        closing(linked(loss=0.0)) as link,
        datagram_socket(link, "left") as sender,
        datagram_socket(link, "right") as receiver,
    ):
        receiver.bind(("0.0.0.0", 0))
        receiver.settimeout(PATIENCE)
        sender.sendto(b"here", (RIGHT, receiver.getsockname()[1]))
        assert receiver.recv(100) == b"here"


def test_what_the_link_loses_does_not_arrive() -> None:
    with closing(linked(loss=1.0)) as link, datagram_socket(link, "left") as sender:
        sender.sendto(b"gone", (RIGHT, 9))
        deadline = time.monotonic() + PATIENCE
        while link.frames == 0:
            assert time.monotonic() < deadline, "the link never saw the packet"
            time.sleep(0.01)
        assert link.dropped == link.frames
