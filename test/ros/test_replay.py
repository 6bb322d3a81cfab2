"""The replay node as a process: its topics and its behaviour."""

import shutil
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_contents import messages
from mr_damper_msgs.msg import MtsSamples, SupplyCurrent
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from std_srvs.srv import Trigger
from support import Listener, assert_one_sentence

from mr_damper_ros.io.bag_writer import write_bag
from mr_damper_ros.models.published import find
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import to_nanoseconds
from studies.thesis import runs as thesis

BAG = Path(__file__).parents[2] / "bags" / "5.0mm_1Hz_1.5A"
SAMPLES = "/mts/samples"
CURRENT = "/supply/current"


def recorded(bag: Path, topic: str) -> list[bytes]:
    return [message.data for message in messages(bag, topic)]


def write_texts(
    bag: Path, texts: Sequence[str], *, latched: bool = False, foreign: bool = False
) -> None:
    """A bag of strings; with ``foreign`` also a message type that is not installed."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("int32 x\n", "somewhere_msgs/msg/Thing"))
    # Same name as an installed type, but different fields.
    other = get_typestore(Stores.ROS2_JAZZY)
    other.register(get_types_from_msg("float64 current\n", "mr_damper_msgs/msg/SupplyCurrent"))
    never = QosTime(2147483647, 4294967295)
    profile = Qos(
        history=QosHistory.KEEP_LAST,
        depth=1,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=never,
        lifespan=never,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=never,
        avoid_ros_namespace_conventions=False,
    )
    with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection(
            "/words", "std_msgs/msg/String", typestore=store, offered_qos_profiles=[profile]
        )
        text_type = store.types["std_msgs/msg/String"]
        for number, text in enumerate(texts):
            data = store.serialize_cdr(text_type(data=text), "std_msgs/msg/String")
            writer.write(topic, 1_000_000_000 * (number + 1), data)
        if foreign:
            thing = "somewhere_msgs/msg/Thing"
            topic = writer.add_connection("/thing", thing, typestore=store)
            writer.write(topic, 1_500_000_000, store.serialize_cdr(store.types[thing](1), thing))
            current = "mr_damper_msgs/msg/SupplyCurrent"
            topic = writer.add_connection("/supply/current", current, typestore=other)
            data = other.serialize_cdr(other.types[current](1.0), current)
            writer.write(topic, 1_600_000_000, data)


def test_as_fast_as_possible_a_slow_subscriber_loses_nothing(
    start: Any, listener: Listener, tmp_path: Path
) -> None:
    bag = tmp_path / "bag"
    # More messages than the queues of the middleware hold.
    recording = thesis.synthesise(find("5.0mm_1Hz_1.5A"), seed=1)
    write_bag(bag, recording, block_size=1)
    heard: list[bytes] = []

    def work(message: bytes) -> None:
        heard.append(message)
        busy_until = time.perf_counter() + 2e-4
        while time.perf_counter() < busy_until:
            pass

    listener.node.create_subscription(MtsSamples, SAMPLES, work, quality.lossless(), raw=True)
    current = listener.listen(SupplyCurrent, CURRENT, quality.lossless(), raw=True)
    replay = start("replay", bag=bag, rate=0.0)
    listener.until(lambda: not replay.running, "the end of the bag")
    expected, readings = recorded(bag, SAMPLES), recorded(bag, CURRENT)
    listener.until(lambda: len(heard) >= len(expected), "the last samples")
    listener.until(lambda: len(current) >= len(readings), "the last current")
    assert replay.wait() == 0
    assert heard == expected
    assert current == readings
    assert f"end of the bag: {len(expected) + len(current)} messages were sent" in replay.errors
    assert "provenance: re-synthesised" in replay.errors
    assert "Traceback" not in replay.errors


def test_the_clock_follows_the_bag(start: Any, listener: Listener) -> None:
    clock = listener.listen(Clock, "/clock")
    samples = listener.listen(MtsSamples, SAMPLES)
    replay = start("replay", bag=BAG, rate=20.0)
    listener.until(lambda: not replay.running, "the end of the bag")
    ticks = np.array([to_nanoseconds(message.clock) for message in clock])
    times = [m.time_ns for m in messages(BAG)]
    assert ticks[0] <= times[0] + 1_000_000_000
    assert ticks[-1] <= times[-1]
    assert times[-1] - ticks[-1] <= 300_000_000
    assert set(np.diff(ticks)) == {200_000_000}
    assert len(samples) == len(recorded(BAG, SAMPLES))


def test_a_paused_bag_goes_step_by_step_and_resumes(start: Any, listener: Listener) -> None:
    samples = listener.listen(MtsSamples, SAMPLES)
    current = listener.listen(SupplyCurrent, CURRENT)
    replay = start("replay", bag=BAG, rate=50.0, start_paused=True)
    listener.wait_for_finding("replay: replay", "paused")
    for count in range(1, 4):
        assert listener.call(Trigger, "replay/step").success
        listener.until(lambda n=count: len(samples) + len(current) == n, "one message")
    assert listener.call(Trigger, "replay/resume").success
    refused = listener.call(Trigger, "replay/step")
    assert not refused.success
    assert "pause" in refused.message
    listener.until(lambda: not replay.running, "the end of the bag")
    assert len(samples) == len(recorded(BAG, SAMPLES))
    assert len(current) == len(recorded(BAG, CURRENT))


def test_a_loop_starts_again_and_says_so(start: Any, listener: Listener) -> None:
    samples = listener.listen(MtsSamples, SAMPLES)
    replay = start("replay", bag=BAG, rate=50.0, loop=True)
    listener.until(lambda: sum(message.seq == 0 for message in samples) >= 3, "three rounds")
    starts = [index for index, message in enumerate(samples) if message.seq == 0]
    assert samples[starts[0]] == samples[starts[1]]
    assert "starts again" in replay.errors
    replay.stop()


@pytest.mark.parametrize(("number", "subscribed"), [(signal.SIGINT, True), (signal.SIGTERM, False)])
def test_it_can_be_stopped_at_any_time(
    start: Any, listener: Listener, number: signal.Signals, subscribed: bool
) -> None:
    samples = listener.listen(MtsSamples, SAMPLES) if subscribed else []
    replay = start("replay", bag=BAG, rate=0.1, wait_timeout=1000.0)
    if subscribed:
        listener.until(lambda: samples, "samples")
    else:
        replay.wait_for_log("playing")
    replay.stop(number)


def test_it_plays_to_nobody_after_the_timeout_and_says_so(start: Any) -> None:
    replay = start("replay", bag=BAG, rate=0.0, wait_timeout=0.2)
    assert replay.wait() == 0
    assert "fewer than 1 nodes subscribed within 0.2 s" in replay.errors


def test_a_latched_topic_is_latched_again(start: Any, listener: Listener, tmp_path: Path) -> None:
    write_texts(tmp_path / "bag", ["first", "second"], latched=True)
    replay = start("replay", bag=tmp_path / "bag", rate=50.0, loop=True, wait_for_subscribers=0)
    replay.wait_for_log("starts again")
    words = listener.listen(String, "/words", quality.latched())
    listener.until(lambda: words, "the latched word")


def test_what_cannot_be_played_is_named_and_the_rest_is_played(
    start: Any, listener: Listener, tmp_path: Path
) -> None:
    write_texts(tmp_path / "bag", ["one", "two"], foreign=True)
    words = listener.listen(String, "/words")
    replay = start("replay", bag=tmp_path / "bag", rate=0.0)
    listener.until(lambda: not replay.running, "the end of the bag")
    assert replay.wait() == 0
    assert [message.data for message in words] == ["one", "two"]
    assert "/thing is omitted: the package somewhere_msgs" in replay.errors
    assert "/supply/current is omitted: it was recorded with a different def" in replay.errors


def test_the_inputs_of_a_full_recording_can_be_played_alone(
    start: Any, listener: Listener, tmp_path: Path
) -> None:
    write_texts(tmp_path / "bag", ["said then"], foreign=True)
    words = listener.listen(String, "/words")
    replay = start("replay", bag=BAG, rate=0.0, topics="inputs")
    samples = listener.listen(MtsSamples, SAMPLES)
    listener.until(lambda: not replay.running, "the end of the bag")
    assert len(samples) == len(recorded(BAG, SAMPLES))
    refused = start("replay", bag=tmp_path / "bag", topics="inputs")
    assert refused.wait() == 2
    assert "has nothing to play" in refused.errors
    assert words == []


def test_topics_that_another_node_publishes_are_named(start: Any, listener: Listener) -> None:
    listener.node.create_publisher(SupplyCurrent, CURRENT, 10)
    start("replay", bag=BAG, loop=True, wait_for_subscribers=1, wait_timeout=2.0)
    listener.listen(MtsSamples, SAMPLES)
    listener.wait_for_finding("replay: replay", "/supply/current is also published by /listener")


def test_a_bag_that_was_changed_is_not_played(start: Any, tmp_path: Path) -> None:
    copy = tmp_path / BAG.name
    shutil.copytree(BAG, copy)
    file = next(copy.glob("*.mcap"))
    whole = bytearray(file.read_bytes())
    whole[len(whole) // 2] ^= 1
    file.write_bytes(bytes(whole))
    replay = start("replay", bag=copy)
    assert replay.wait() == 2
    assert "is damaged" in replay.errors
    assert_one_sentence(replay.errors)
