"""Bags: what is written is read back, and unreadable files give one clear sentence."""

import math
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_contents import messages
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mr_damper_ros.io.bag_files import BagError
from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.io.bag_writer import write_bag
from mr_damper_ros.signals.recording import Recording

START = 1_700_000_000_123_456_789

REPOSITORY = Path(__file__).resolve().parents[2]


def recording(count: int = 350, **changes: Any) -> Recording:
    time = np.arange(count) * 1e-3
    fields: dict[str, Any] = {
        "name": "run",
        "start_ns": START,
        "period": 1e-3,
        "displacement": 0.005 * np.sin(20.0 * time),
        "force": 900.0 * np.cos(20.0 * time),
        "current": np.full(count, 0.5),
        "details": {"condition": "5 mm, 1 Hz", "provenance": "made by a test"},
    }
    return Recording(**{**fields, **changes})


def assert_same(read: Recording, written: Recording) -> None:
    assert read.name == written.name
    assert read.start_ns == written.start_ns
    assert read.period == written.period
    np.testing.assert_array_equal(read.displacement, written.displacement)
    np.testing.assert_array_equal(read.force, written.force)
    np.testing.assert_array_equal(read.current, written.current)
    assert read.details == written.details


@settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    values=st.lists(
        st.tuples(
            st.floats(-1e3, 1e3, allow_subnormal=True),
            st.floats(-1e9, 1e9),
            st.sampled_from([0.0, 0.5, 1.0, 1.5]),
        ),
        min_size=1,
        max_size=60,
    ),
    period=st.sampled_from([1e-3, 5e-3, 1.0 / 3000.0, 1.0 / 4096.0, 1e-5]),
    block_size=st.integers(1, 70),
    start_ns=st.integers(0, (2**31 - 1) * 10**9),
)
def test_a_recording_comes_back_bit_for_bit(
    tmp_path: Path,
    values: list[tuple[float, float, float]],
    period: float,
    block_size: int,
    start_ns: int,
) -> None:
    displacement, force, current = np.array(values).T
    written = recording(
        len(values),
        start_ns=start_ns,
        period=period,
        displacement=displacement,
        force=force,
        current=current,
    )
    write_bag(tmp_path / "bag", written, block_size=block_size, overwrite=True)
    (read,) = read_bag(tmp_path / "bag")
    assert_same(read, written)


def test_the_file_alone_and_its_folder_read_the_same(tmp_path: Path) -> None:
    write_bag(tmp_path / "5.0mm_1Hz", recording())
    shutil.copy(tmp_path / "5.0mm_1Hz" / "5.0mm_1Hz.mcap", tmp_path / "alone.mcap")
    assert_same(read_bag(tmp_path / "5.0mm_1Hz" / "5.0mm_1Hz.mcap")[0], recording())
    (alone,) = read_bag(tmp_path / "alone.mcap")
    np.testing.assert_array_equal(alone.force, recording().force)
    assert alone.name == "alone"


def test_the_current_is_known_for_every_block_that_was_played(tmp_path: Path) -> None:
    current = np.where(np.arange(350) < 233, 0.0, 1.5)
    write_bag(tmp_path / "bag", recording(current=current))
    stamps = [m.time_ns for m in messages(tmp_path / "bag", "/supply/current")]
    assert [s - START for s in stamps] == [k * 1_000_000 for k in (0, 99, 199, 233, 299, 349)]
    order = [m.topic for m in messages(tmp_path / "bag")]
    assert order[-2:] == ["/supply/current", "/mts/samples"]


# ---- never half a bag ----


def test_a_bag_is_replaced_only_on_request(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", recording())
    with pytest.raises(BagError, match="exists already"):
        write_bag(tmp_path / "bag", recording(20))
    assert read_bag(tmp_path / "bag")[0].sample_count == 350
    write_bag(tmp_path / "bag", recording(20), overwrite=True)
    assert read_bag(tmp_path / "bag")[0].sample_count == 20
    assert [entry.name for entry in tmp_path.iterdir()] == ["bag"]


def test_a_folder_that_is_no_bag_is_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.txt").write_text("years of work")
    with pytest.raises(BagError, match="is not a bag"):
        write_bag(tmp_path / "thesis", recording(), overwrite=True)
    assert (tmp_path / "thesis" / "chapter.txt").read_text() == "years of work"


@pytest.mark.parametrize("failure", [KeyboardInterrupt, OSError])
def test_an_interrupted_write_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: type[BaseException]
) -> None:
    write_bag(tmp_path / "bag", recording())
    writes = iter(range(1))

    def write(self: Writer, *arguments: Any) -> None:
        if next(writes, None) is None:
            raise failure

    monkeypatch.setattr(Writer, "write", write)
    with pytest.raises(failure):
        write_bag(tmp_path / "bag", recording(20), overwrite=True)
    with pytest.raises(failure) as raised:
        write_bag(tmp_path / "other", recording(20))
    named = str(tmp_path / "other")
    assert getattr(raised.value, "filename", named) == named
    assert [entry.name for entry in tmp_path.iterdir()] == ["bag"]
    assert_same(read_bag(tmp_path / "bag")[0], recording())


@pytest.mark.parametrize(
    ("changes", "block_size", "sentence"),
    [
        ({}, 0, "at least 1 sample"),
        ({"start_ns": -1}, 10, "from 1970 to 2038"),
        ({"start_ns": 2**31 * 10**9 - 1000}, 10, "from 1970 to 2038"),
    ],
)
def test_what_cannot_be_written_is_refused(
    tmp_path: Path, changes: dict[str, int], block_size: int, sentence: str
) -> None:
    with pytest.raises(BagError, match=sentence):
        write_bag(tmp_path / "bag", recording(**changes), block_size=block_size)
    with pytest.raises(BagError, match="give the path first, then the recording"):
        write_bag(recording(), tmp_path / "bag")
    assert not list(tmp_path.iterdir())


# ---- damaged and foreign bags ----


def refused(path: Path, **topics: str) -> str:
    with pytest.raises(BagError) as error:
        read_bag(path, **topics)
    sentence = str(error.value)
    assert "\n" not in sentence
    return sentence


@pytest.mark.parametrize("length", [0, 5, 500, 3000, -40, -8])
def test_a_truncated_bag_is_said_to_be_cut_off(tmp_path: Path, length: int) -> None:
    write_bag(tmp_path / "bag", recording())
    file = tmp_path / "bag" / "bag.mcap"
    file.write_bytes(file.read_bytes()[:length])
    assert "incomplete" in refused(tmp_path / "bag")


def test_what_is_no_bag_is_said_to_be_none(tmp_path: Path) -> None:
    (tmp_path / "run.txt").write_text("0 1 2")
    assert "there is no bag at" in refused(tmp_path / "missing")
    assert "give the folder that holds metadata.yaml" in refused(tmp_path)
    assert "mr-damper import makes a bag" in refused(tmp_path / "run.txt")


@pytest.fixture(scope="module")
def typestore() -> Any:
    store = get_typestore(Stores.ROS2_JAZZY)
    for name in ("MtsSamples", "SupplyCurrent"):
        text = (REPOSITORY / "msg_defs" / "msg" / f"{name}.msg").read_text()
        store.register(get_types_from_msg(text, f"mr_damper_msgs/msg/{name}"))
    return store


class Recorder:
    """Writes any messages on any topics, like a recording of a running system."""

    def __init__(self, path: Path, store: Any) -> None:
        self.writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self.store = store
        self.connections: dict[str, Any] = {}
        self.time = 0

    def topic(self, topic: str, message_type: str) -> None:
        self.connections[topic] = self.writer.add_connection(
            topic, message_type, typestore=self.store
        )

    def send(self, topic: str, stamp: float | None, **fields: Any) -> None:
        types, connection = self.store.types, self.connections[topic]
        if stamp is not None:
            seconds, nanoseconds = divmod(START + round(stamp * 1e9), 10**9)
            time = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
            fields["header"] = types["std_msgs/msg/Header"](stamp=time, frame_id="")
        message = types[connection.msgtype](**fields)
        self.time += 1
        self.writer.write(
            connection, self.time, self.store.serialize_cdr(message, connection.msgtype)
        )

    def block(self, stamp: float, seq: int, count: int = 10, **changes: Any) -> None:
        values = np.arange(seq, seq + count, dtype=float)
        fields = {"period": 0.01, "displacement": values, "force": -values, **changes}
        self.send("/mts/samples", stamp, seq=seq, **fields)

    def current(self, stamp: float, value: float) -> None:
        self.send("/supply/current", stamp, current=value)


@pytest.fixture
def recorder(tmp_path: Path, typestore: Any) -> Iterator[Recorder]:
    recorder = Recorder(tmp_path / "bag", typestore)
    recorder.writer.open()
    recorder.topic("/mts/samples", "mr_damper_msgs/msg/MtsSamples")
    recorder.topic("/supply/current", "mr_damper_msgs/msg/SupplyCurrent")
    yield recorder
    if recorder.writer.storage:
        recorder.writer.close()


def test_lost_samples_split_a_bag(recorder: Recorder) -> None:
    recorder.current(0.0, 1.0)
    recorder.block(0.0, 0)
    recorder.block(0.1, 10)
    recorder.block(0.3, 30)
    recorder.writer.close()
    first, second = read_bag(recorder.writer.path)
    assert (first.sample_count, second.sample_count) == (20, 10)
    assert second.start_ns - first.start_ns == 300_000_000
    assert (first.name, second.name) == ("bag, part 1", "bag, part 2")


def test_stamps_that_waver_within_half_a_period_do_not_split_a_bag(recorder: Recorder) -> None:
    recorder.current(0.0, 1.0)
    recorder.block(0.0, 0)
    recorder.block(0.104, 10)
    recorder.writer.close()
    assert [r.sample_count for r in read_bag(recorder.writer.path)] == [20]


def test_each_round_of_a_loop_has_its_own_current(recorder: Recorder) -> None:
    for first, second in ((0.0, 0.5), (1.0, 1.5)):
        recorder.current(0.0, first)
        recorder.current(5.0, second)
        for k in range(100):
            recorder.block(0.1 * k, 10 * k)
    recorder.writer.close()
    rounds = read_bag(recorder.writer.path)
    assert [r.sample_count for r in rounds] == [1000, 1000]
    assert [sorted(set(r.current)) for r in rounds] == [[0.0, 0.5], [1.0, 1.5]]
    assert all(r.current[499] != r.current[500] for r in rounds)


def test_samples_before_the_first_current_are_left_out(recorder: Recorder) -> None:
    recorder.block(0.0, 0)
    recorder.current(0.03, 1.0)
    recorder.writer.close()
    (read,) = read_bag(recorder.writer.path)
    np.testing.assert_array_equal(read.displacement, np.arange(3.0, 10.0))
    assert read.start_ns == START + 30_000_000


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"force": np.array([1.0, 2.0, np.nan])}, "at sample 40, the force of sample 2"),
        ({"displacement": np.array([np.inf, 2.0, 1.0])}, "the displacement of sample 0"),
        ({"period": -0.01}, "the sample period is -0.01 s: it must be positive"),
        ({"period": 0.0}, "it must be positive"),
        ({"force": np.zeros(4)}, "3 displacements but 4 forces"),
    ],
)
def test_bad_samples_are_named(recorder: Recorder, changes: dict[str, Any], sentence: str) -> None:
    recorder.current(0.0, 1.0)
    fields = {"displacement": np.arange(3.0), "force": np.arange(3.0), **changes}
    recorder.block(0.0, 40, **fields)
    recorder.writer.close()
    assert sentence in refused(recorder.writer.path)


@pytest.mark.parametrize(
    ("block", "current", "sentence"),
    [
        (True, (1000.0, 1.0), "stamp both with the same clock"),
        (True, (0.0, math.nan), "the current on /supply/current"),
        (True, None, "the topic /supply/current is empty"),
        (False, None, "holds no messages"),
    ],
)
def test_a_current_that_cannot_be_used_is_named(
    recorder: Recorder, block: bool, current: tuple[float, float] | None, sentence: str
) -> None:
    if block:
        recorder.block(0.0, 0)
    if current is not None:
        recorder.current(*current)
    recorder.writer.close()
    assert sentence in refused(recorder.writer.path)


@pytest.mark.parametrize(
    ("topics", "sentence"),
    [
        ({"/talk": "String"}, r"no topic /mts/samples.*/talk \(std_msgs/msg/String\)"),
        ({"/mts/samples": "String"}, "has the type std_msgs/msg/String"),
        ({"/a/mts/samples": "", "/b/mts/samples": ""}, "/a/mts/samples, /b/mts/samples"),
    ],
)
def test_a_bag_without_the_topics_of_one_rig_is_refused_with_those_that_are_there(
    tmp_path: Path, typestore: Any, topics: dict[str, str], sentence: str
) -> None:
    recorder = Recorder(tmp_path / "bag", typestore)
    samples = {"seq": 0, "period": 0.1, "displacement": np.zeros(5), "force": np.zeros(5)}
    with recorder.writer:
        for topic, kind in topics.items():
            recorder.topic(
                topic, "std_msgs/msg/String" if kind else "mr_damper_msgs/msg/MtsSamples"
            )
            recorder.send(
                topic, *((None,) if kind else (0.0,)), **({"data": "hello"} if kind else samples)
            )
    assert re.search(sentence, refused(tmp_path / "bag"))
