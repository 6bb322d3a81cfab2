"""The figures of the nodes under load, in runs so short that only the measuring is shown."""

from __future__ import annotations

import os
import shutil
import socket
import time
from contextlib import closing

import pytest

from benchmarks import (
    command_latency,
    eight_rigs,
    live_page,
    lossy_link,
    single_sample,
    streaming_load,
    topic_samples,
)
from benchmarks.network import LossyLink, NetworkError
from benchmarks.streaming_load import Counter

PATIENCE = 30.0
RIGHT = "10.199.0.2"


def test_every_key_of_the_load_is_measured_once() -> None:
    figures = streaming_load.figures(duration=2.0, latency_duration=4.0)
    assert [figure.key for figure in figures] == [
        *("lost_1khz", "lost_5khz", "latency_ratio_p50", "latency_ratio_p99"),
        *("cpu_model_percent", "cpu_identifier_percent"),
    ]
    assert all(isinstance(figure.value, (int, float)) for figure in figures)


def test_every_key_of_the_commands_is_measured_once() -> None:
    figures = command_latency.figures(duration=4.0)
    assert [figure.key for figure in figures] == [
        *("command_latency_ratio_p50", "command_latency_ratio_p99")
    ]
    assert all(isinstance(figure.value, float) for figure in figures)


def test_every_key_of_single_samples_is_measured_once() -> None:
    figures = single_sample.figures(duration=4.0, overload_duration=1.0)
    assert [figure.key for figure in figures] == [
        *("single_sample_lost", "single_sample_p99_ratio", "single_sample_cpu_ratio"),
        "stale_valid",
    ]
    assert all(figure.note for figure in figures)


def test_every_key_of_the_page_is_measured_once() -> None:
    figures = live_page.figures(duration=2.0, segment=4.0, segments=1, warm=1.0, siege=1.0)
    assert [figure.key for figure in figures] == [
        *("live_cpu_percent", "live_memory_growth_mb", "live_grey_s", "live_besieged_answer_s"),
        "live_p99_ratio",
    ]
    assert all(isinstance(figure.value, float) for figure in figures)


def test_every_key_of_samples_from_topics_is_measured_once() -> None:
    figures = topic_samples.figures(duration=1.0, bags=())
    assert [figure.key for figure in figures] == [
        *("topics_lost_inside", "topics_lost_by_dds", "topics_rmse_ratio")
    ]
    assert figures[0].reached == "yes"


def test_every_key_of_many_rigs_is_measured_once(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, short in (("_SETTLED", 0.0), ("_QUIET", 1.5)):
        monkeypatch.setattr(eight_rigs, name, short)
    figures = eight_rigs.figures(duration=2.0, rigs=2)
    assert [figure.key for figure in figures] == [
        *("eight_rigs_lost", "eight_rigs_unfitted"),
        *("eight_rigs_cpu_identifiers_percent", "eight_rigs_cpu_workers_percent"),
        *("eight_rigs_cpu_models_percent", "eight_rigs_cpu_bridges_percent"),
    ]
    assert figures[1].reached == "yes"


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
