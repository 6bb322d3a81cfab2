"""Bags of all kinds of recorders are read whole, or what is missing is said."""

import shutil
import sqlite3
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from bag_contents import messages
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from mr_damper_ros.api.measured_runs import measured_runs
from mr_damper_ros.io.bag_files import BagError
from mr_damper_ros.io.bag_messages import decoded_samples, known_types
from mr_damper_ros.io.bag_reader import bag_stream, read_bag
from mr_damper_ros.io.bag_writer import write_bag
from mr_damper_ros.signals.blocks import SampleBlock
from mr_damper_ros.signals.recording import Recording

COUNT, BLOCK = 700, 10
TIME = np.arange(COUNT) * 1e-3
RUN = Recording(
    "run",
    1_700_000_000_000_000_000,
    1e-3,
    5e-3 * np.sin(20.0 * TIME),
    900.0 * np.cos(20.0 * TIME),
    np.where(TIME < 0.35, 0.5, 1.0),
)

SAMPLES, CURRENT = "/mts/samples", "/supply/current"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    write_bag(tmp_path / "run", RUN, block_size=BLOCK)
    return tmp_path / "run"


Extra = tuple[str, str, str]
"""Topic, type and definition."""


def rewritten(
    bag: Path, name: str, storage: StoragePlugin, extra: tuple[Extra, ...] = (), **options: Any
) -> Path:
    """The messages of a bag in another storage, with more topics."""
    path = bag.with_name(name)
    compression = options.pop("compression", None)
    with AnyReader([bag]) as reader:
        writer = Writer(path, version=9, storage_plugin=storage)
        if compression is not None:
            writer.set_compression(compression, CompressionFormat.ZSTD)
        with writer:
            made = {
                each.topic: writer.add_connection(
                    each.topic, each.msgtype, msgdef=each.msgdef.data, rihs01=each.digest
                )
                for each in reader.connections
            }
            for topic, kind, text in extra:
                digest = "RIHS01_" + "0" * 64
                made[topic] = writer.add_connection(topic, kind, msgdef=text, rihs01=digest)
            for connection, time_ns, data in reader.messages():
                writer.write(made[connection.topic], time_ns, data)
            for topic, _, _ in extra:
                writer.write(made[topic], time_ns, b"\0\1\0\0")
    return path


def database(bag: Path) -> Path:
    """The .db3 file of a bag that is rewritten as SQLite."""
    path = rewritten(bag, "lite", StoragePlugin.SQLITE3)
    return path / "lite.db3"


def read_whole(path: Path) -> str:
    """Assert that the whole run is read; returns the note."""
    (read,) = read_bag(path)
    np.testing.assert_array_equal(read.displacement, RUN.displacement)
    np.testing.assert_array_equal(read.force, RUN.force)
    np.testing.assert_array_equal(read.current, RUN.current)
    assert read.start_ns == RUN.start_ns
    return read.details.get("note", "")


def refused(path: Path) -> str:
    with pytest.raises(BagError) as error:
        read_bag(path)
    sentence = str(error.value)
    assert "\n" not in sentence
    return sentence


# ---- storages ----


@pytest.mark.parametrize("mode", [None, *CompressionMode])
@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_every_storage_is_read_the_same(
    run: Path, storage: StoragePlugin, mode: CompressionMode | None
) -> None:
    if (storage, mode) == (StoragePlugin.SQLITE3, CompressionMode.STORAGE):
        pytest.skip("SQLite has no compression of its own")
    if mode is CompressionMode.NONE:
        mode = None
    assert read_whole(rewritten(run, "other", storage, compression=mode)) == ""


def test_messages_outside_chunks_and_out_of_order_are_read(tmp_path: Path, run: Path) -> None:
    from mcap.writer import Writer as McapWriter

    parts = messages(run)
    random = np.random.default_rng(0).permutation(len(parts))
    for name, order, chunks in (("plain", range(len(parts)), False), ("mixed", random, True)):
        (tmp_path / name).mkdir()
        path = tmp_path / name / f"{name}.mcap"
        with path.open("wb") as file:
            writer = McapWriter(file, use_chunking=chunks, chunk_size=4000)
            writer.start("ros2")
            made = {}
            for k in order:
                part = parts[k]
                if part.topic not in made:
                    schema = writer.register_schema(part.message_type, "unknown", b"\xfe")
                    made[part.topic] = writer.register_channel(part.topic, "cdr", schema)
                writer.add_message(made[part.topic], part.time_ns, part.data, part.time_ns)
            writer.finish()
        read_whole(path)


def humble(bag: Path, *, samples_only: bool = False) -> Path:
    """A .db3 of ROS 2 Humble, which holds no definitions."""
    source, path = database(bag), bag.with_name("humble.db3")
    with sqlite3.connect(path) as made:
        made.execute(f"ATTACH '{source}' AS old")
        made.execute(
            "CREATE TABLE topics AS SELECT id, name, type, serialization_format, "
            "'' AS offered_qos_profiles FROM old.topics"
        )
        made.execute("CREATE TABLE messages AS SELECT * FROM old.messages")
    made.close()
    return path


def test_a_bag_without_definitions_is_read(run: Path) -> None:
    assert read_whole(humble(run)) == ""


FOREIGN: dict[str, Extra] = {
    "service events": (
        "/add/_service_event",
        "example_interfaces/srv/AddTwoInts_Event",
        "int64 a\nint64 b\n---\nint64 sum\n",
    ),
    "no definition": ("/secret", "vendor_msgs/msg/Secret", ""),
    "another language": ("/secret", "vendor_msgs/msg/Secret", "module { unknown"),
}


@pytest.mark.parametrize("storage", list(StoragePlugin))
@pytest.mark.parametrize("foreign", FOREIGN)
def test_topics_that_are_not_needed_cannot_make_a_bag_unreadable(
    run: Path, storage: StoragePlugin, foreign: str
) -> None:
    assert read_whole(rewritten(run, "other", storage, (FOREIGN[foreign],))) == ""


# ---- interrupted recorders ----


def killed(source: Path, folder: Path, mode: str, checkpoint: int | None) -> Path:
    """A .db3 as a killed recorder leaves it, with the messages after the ``checkpoint`` in -wal."""
    folder.mkdir()
    live = folder.with_name("live.db3")
    shutil.copy(source, live)
    base = sqlite3.connect(live, isolation_level=None)
    base.execute(f"PRAGMA journal_mode={mode}")
    base.execute("PRAGMA wal_autocheckpoint=0")
    rows = list(base.execute("SELECT * FROM messages ORDER BY id"))
    base.execute("BEGIN")
    base.execute("DELETE FROM messages")
    base.execute("COMMIT")
    for k, row in enumerate(rows):
        base.execute("INSERT INTO messages VALUES (?, ?, ?, ?)", row)
        if k == checkpoint:
            base.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    for each in live.parent.glob("live.db3*"):
        shutil.copy(each, folder / each.name.replace("live", "rec"))
    base.close()
    return folder / "rec.db3"


@pytest.mark.parametrize("checkpoint", [None, 0, 61, 139])
def test_the_journal_of_a_killed_recorder_is_read_and_named(
    tmp_path: Path, run: Path, checkpoint: int | None
) -> None:
    path = killed(database(run), tmp_path / "killed", "WAL", checkpoint)
    before = {each.name: each.read_bytes() for each in path.parent.iterdir()}
    path.parent.chmod(0o555)
    assert "the journal rec.db3-wal of an interrupted recording was read" in read_whole(path)
    assert before == {each.name: each.read_bytes() for each in path.parent.iterdir()}
    path.parent.chmod(0o755)


@pytest.mark.parametrize("cut", [1, 3000, 30_000])
def test_a_journal_that_is_cut_off_is_said(tmp_path: Path, run: Path, cut: int) -> None:
    path = killed(database(run), tmp_path / "killed", "WAL", 20)
    wal = path.with_name("rec.db3-wal")
    wal.write_bytes(wal.read_bytes()[:-cut])
    recordings = read_bag(path)
    assert recordings[0].sample_count < COUNT
    assert "last, incomplete transaction are lost" in recordings[0].details["note"]


def test_a_journal_that_cannot_be_read_is_named(tmp_path: Path, run: Path) -> None:
    path = killed(database(run), tmp_path / "killed", "WAL", 20)
    wal = path.with_name("rec.db3-wal")
    wal.write_bytes(bytes(32) + wal.read_bytes()[32:])
    sentence = refused(path)
    assert "its journal rec.db3-wal cannot be read" in sentence
    assert "mcap" not in sentence


def test_an_uncommitted_transaction_is_undone_and_said(tmp_path: Path, run: Path) -> None:
    live, folder = database(run), tmp_path / "killed"
    folder.mkdir()
    base = sqlite3.connect(live, isolation_level=None)
    base.execute("PRAGMA cache_size=1")  # changed pages are written before the transaction ends
    base.execute("BEGIN")
    base.execute("DELETE FROM messages WHERE id > 20")
    for each in live.parent.glob("lite.db3*"):
        shutil.copy(each, folder / each.name)
    base.execute("ROLLBACK")
    base.close()
    assert (folder / "lite.db3-journal").stat().st_size > 0
    assert "the journal lite.db3-journal" in read_whole(folder / "lite.db3")


@pytest.mark.parametrize("part", [0.2, 0.5, 0.97])
def test_a_database_that_is_cut_off_is_refused_with_a_remedy_for_databases(
    run: Path, part: float
) -> None:
    path = database(run)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(part * len(whole))])
    sentence = refused(path)
    assert "lite.db3 cannot be read" in sentence
    assert "sqlite3 lite.db3 .recover" in sentence
    assert "mcap" not in sentence


# ---- folders ----


def split(bag: Path) -> Path:
    """The bag in three files."""
    folder, parts = bag.with_name("split"), messages(bag)
    folder.mkdir()
    description: dict[str, Any] = {}
    for number, first in enumerate((0, 60, 120)):
        path = bag.with_name(f"split_{number}")
        with AnyReader([bag]) as reader, Writer(path, version=9) as writer:
            made = {
                each.topic: writer.add_connection(
                    each.topic, each.msgtype, msgdef=each.msgdef.data, rihs01=each.digest
                )
                for each in reader.connections
            }
            for part in parts[first : first + 60 if number < 2 else None]:
                writer.write(made[part.topic], part.time_ns, part.data)
        (file,) = [each for each in path.iterdir() if each.name != "metadata.yaml"]
        shutil.copy(file, folder / file.name)
        found = yaml.safe_load((path / "metadata.yaml").read_text())
        found = found["rosbag2_bagfile_information"]
        if not description:
            description = found
            continue
        description["relative_file_paths"] += found["relative_file_paths"]
        for all_of, own in zip(
            description["topics_with_message_count"],
            found["topics_with_message_count"],
            strict=True,
        ):
            all_of["message_count"] += own["message_count"]
    text = yaml.safe_dump({"rosbag2_bagfile_information": description})
    (folder / "metadata.yaml").write_text(text)
    return folder


def files_of(folder: Path) -> list[Path]:
    return sorted(each for each in folder.iterdir() if each.name != "metadata.yaml")


def test_the_files_of_a_bag_are_read_together(run: Path) -> None:
    folder = split(run)
    assert read_whole(folder) == ""
    (folder / "metadata.yaml").unlink()
    assert "has no metadata.yaml: all 3 files in its folder were read" in read_whole(folder)


def test_one_of_several_files_is_said_to_be_one(run: Path) -> None:
    (read, *_) = read_bag(files_of(split(run))[0])
    assert 0 < read.sample_count < COUNT
    assert "of the 3 files of its bag was read" in read.details["note"]


@pytest.mark.parametrize("number", [0, 1, 2])
@pytest.mark.parametrize("named", [True, False])
def test_a_missing_file_of_a_bag_is_named(run: Path, named: bool, number: int) -> None:
    folder = split(run)
    lost = files_of(folder)[number]
    lost.unlink()
    if not named:
        (folder / "metadata.yaml").unlink()
        if number == 2:  # nothing in the folder tells of it
            return
    assert (lost.name if named else f"number {number} is missing") in refused(folder)


def test_a_damaged_file_of_a_bag_is_named(run: Path) -> None:
    folder = split(run)
    file = files_of(folder)[1]
    file.write_bytes(file.read_bytes()[:-500])
    assert f"{file.name} cannot be read" in refused(folder)


def test_messages_that_are_missing_are_said(run: Path) -> None:
    text = (run / "metadata.yaml").read_text()
    (run / "metadata.yaml").write_text(text.replace("message_count: 70", "message_count: 90"))
    assert f"metadata.yaml states 90 messages on {SAMPLES}, but the files hold only 70" in (
        read_whole(run)
    )


def test_several_bags_in_one_folder_are_not_mixed(tmp_path: Path, run: Path) -> None:
    (tmp_path / "many").mkdir()
    for name in ("a", "b"):
        shutil.copy(run / "run.mcap", tmp_path / "many" / f"{name}.mcap")
    assert "give one of a.mcap, b.mcap" in refused(tmp_path / "many")


@pytest.mark.parametrize("text", ["", "a: [", "rosbag2_bagfile_information: {version: 5}"])
def test_damaged_metadata_are_said(run: Path, text: str) -> None:
    (run / "metadata.yaml").write_text(text)
    assert "its metadata.yaml cannot be read; make it anew with ros2 bag reindex" in refused(run)


def test_metadata_of_an_unknown_version_are_refused(run: Path) -> None:
    text = (run / "metadata.yaml").read_text()
    (run / "metadata.yaml").write_text(text.replace("version: 9", "version: 10"))
    assert "metadata of version 10" in refused(run)


# ---- messages ----


@pytest.mark.parametrize("little", [True, False])
@pytest.mark.parametrize("frame", ["", "damper", "a"])
@pytest.mark.parametrize("counts", [(0, 0), (1, 1), (7, 7), (0, 2)])
def test_messages_are_decoded_as_the_library_does(
    little: bool, frame: str, counts: tuple[int, int]
) -> None:
    store, random = known_types(), np.random.default_rng(0)
    stamp = store.types["builtin_interfaces/msg/Time"](sec=12, nanosec=345)
    message = store.types["mr_damper_msgs/msg/MtsSamples"](
        header=store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame),
        seq=2**40,
        period=1e-3,
        displacement=random.normal(size=counts[0]),
        force=random.normal(size=counts[1]),
    )
    kind = "mr_damper_msgs/msg/MtsSamples"
    data = bytes(store.serialize_cdr(message, kind, little_endian=little))
    stamp_ns, seq, period, displacement, force = decoded_samples(data)
    assert (stamp_ns, seq, period) == (12_000_000_345, 2**40, 1e-3)
    np.testing.assert_array_equal(np.frombuffer(displacement), message.displacement)
    np.testing.assert_array_equal(np.frombuffer(force), message.force)
    for cut in range(len(data) - 3):
        with pytest.raises(ValueError, match="message"):
            decoded_samples(data[:cut])


# ---- order and stamps ----


class Rig:
    """Blocks and currents to write in any order, with any stamp."""

    def __init__(self, seed: int = 0) -> None:
        self.random = np.random.default_rng(seed)
        parts = range(0, COUNT, BLOCK)
        self.blocks = [
            (RUN.stamp_ns(k), k, RUN.displacement[k : k + BLOCK], RUN.force[k : k + BLOCK])
            for k in parts
        ]
        self.currents = [(RUN.stamp_ns(k), float(RUN.current[k])) for k in range(0, COUNT, 5)]

    def stamped(self, place: int, stamp_ns: int) -> None:
        self.blocks[place] = (stamp_ns, *self.blocks[place][1:])

    def write(self, path: Path) -> Path:
        """The bag; the recording times follow the order of the lists."""
        store, spacing = known_types(), 1_000_000
        time, header = (
            store.types[f"{name}"]
            for name in ("builtin_interfaces/msg/Time", "std_msgs/msg/Header")
        )

        def head(stamp_ns: int) -> Any:
            seconds, nanoseconds = divmod(stamp_ns, 10**9)
            return header(stamp=time(sec=seconds, nanosec=nanoseconds), frame_id="")

        kinds = {SAMPLES: "MtsSamples", CURRENT: "SupplyCurrent"}
        with Writer(path, version=9) as writer:
            made = {
                topic: writer.add_connection(topic, f"mr_damper_msgs/msg/{kind}", typestore=store)
                for topic, kind in kinds.items()
            }

            def write(topic: str, time_ns: int, stamp_ns: int, **fields: Any) -> None:
                kind = f"mr_damper_msgs/msg/{kinds[topic]}"
                message = store.types[kind](header=head(stamp_ns), **fields)
                writer.write(made[topic], time_ns, store.serialize_cdr(message, kind))

            for k, (stamp_ns, current) in enumerate(self.currents):
                write(CURRENT, RUN.start_ns + 5 * k * spacing, stamp_ns, current=current)
            for k, (stamp_ns, seq, u, f) in enumerate(self.blocks):
                fields = {"seq": seq, "period": 1e-3, "displacement": u, "force": f}
                write(SAMPLES, RUN.start_ns + 10 * k * spacing, stamp_ns, **fields)
        return path


@pytest.mark.parametrize("seed", range(5))
def test_sequence_numbers_order_the_blocks(tmp_path: Path, seed: int) -> None:
    rig = Rig(seed)
    if seed:  # blocks that come up to 0.2 s late
        late = rig.random.uniform(0.0, 20.0, len(rig.blocks)) + np.arange(len(rig.blocks))
        rig.blocks = [rig.blocks[k] for k in np.argsort(late)]
    said = "not recorded in the order" if seed else ""
    assert said in read_whole(rig.write(tmp_path / "bag"))


@pytest.mark.parametrize("seed", range(5))
def test_repeated_blocks_are_used_once_and_said(tmp_path: Path, seed: int) -> None:
    rig = Rig(seed)
    for k in sorted(rig.random.choice(len(rig.blocks), 1 + 10 * seed, replace=False))[::-1]:
        rig.blocks.insert(min(k + int(rig.random.integers(1, 8)), len(rig.blocks)), rig.blocks[k])
    count = 1 + 10 * seed
    assert f"{count} blocks ({BLOCK * count} samples) are in the bag twice" in read_whole(
        rig.write(tmp_path / "bag")
    )


def test_two_sources_with_the_same_numbers_are_refused(tmp_path: Path) -> None:
    rig = Rig()
    rig.blocks = [each for b in rig.blocks for each in (b, (b[0], b[1], b[2] + 1e-3, b[3]))]
    assert "two different blocks on /mts/samples" in refused(rig.write(tmp_path / "bag"))


@pytest.mark.parametrize("count", [1, 2, 20])
def test_a_stamp_is_not_zero_because_a_clock_has_not_come(tmp_path: Path, count: int) -> None:
    rig = Rig()
    for place in range(count):
        rig.stamped(place, 0)
    note = read_whole(rig.write(tmp_path / "bag"))
    assert f"{count} blocks have no stamp: their sequence numbers were used" in note


def test_simulated_time_begins_with_zero(tmp_path: Path) -> None:
    rig = Rig()
    rig.blocks = [(stamp - RUN.start_ns, *rest) for stamp, *rest in rig.blocks]  # type: ignore
    rig.currents = [(stamp - RUN.start_ns, value) for stamp, value in rig.currents]
    (read,) = read_bag(rig.write(tmp_path / "bag"))
    np.testing.assert_array_equal(read.force, RUN.force)
    np.testing.assert_array_equal(read.current, RUN.current)
    assert read.start_ns == 0
    assert "note" not in read.details


def test_a_current_without_stamps_follows_the_times_of_recording(tmp_path: Path) -> None:
    rig = Rig()
    rig.currents = [(0, value) for _, value in rig.currents]
    note = read_whole(rig.write(tmp_path / "bag"))
    assert "readings of the current have no stamp: their recording times were used" in note


def test_a_bag_without_any_stamp_follows_the_times_of_recording(tmp_path: Path) -> None:
    rig = Rig()
    for place in range(len(rig.blocks)):
        rig.stamped(place, 0)
    rig.currents = [(0, value) for _, value in rig.currents]
    (read,) = read_bag(rig.write(tmp_path / "bag"))
    np.testing.assert_array_equal(read.force, RUN.force[-read.sample_count :])
    # The recording times of blocks and currents differ by up to a block.
    steps = np.flatnonzero(np.diff(read.current)) + COUNT - read.sample_count
    assert abs(steps.item() - 350) <= BLOCK
    assert read.sample_count >= COUNT - BLOCK
    assert "70 blocks have no stamp" in read.details["note"]


@pytest.mark.parametrize("seed", range(5))
def test_stamps_of_few_blocks_that_contradict_the_numbers_are_not_believed(
    tmp_path: Path, seed: int
) -> None:
    rig = Rig(seed)
    places = 10 * np.arange(1, 6) + seed
    for place in places.tolist():
        off = int(rig.random.choice([-1, 1]) * 10 ** rig.random.uniform(7.5, 11.0))
        rig.stamped(place, rig.blocks[place][0] + off)
    assert "the stamps of 5 blocks contradict" in read_whole(rig.write(tmp_path / "bag"))


def test_a_pause_of_the_source_is_no_wrong_stamp(tmp_path: Path) -> None:
    rig = Rig()
    for place in range(30, 70):
        rig.stamped(place, rig.blocks[place][0] + 3_000_000_000)
    rig.currents += [(stamp + 3_000_000_000, value) for stamp, value in rig.currents]
    assert [r.sample_count for r in read_bag(rig.write(tmp_path / "bag"))] == [300, 400]


def test_lost_samples_are_counted(tmp_path: Path) -> None:
    rig = Rig()
    del rig.blocks[40:42], rig.blocks[10:20]
    one, two = read_bag(rig.write(tmp_path / "bag"))
    assert (one.sample_count, two.sample_count) == (100, 500)
    assert "120 samples are missing in the bag; of these, 20 in short gaps" in one.details["note"]


def test_a_stream_has_the_messages_in_the_order_of_recording(run: Path) -> None:
    blocks = [item for item in bag_stream(run) if isinstance(item, SampleBlock)]
    assert [block.sequence for block in blocks] == list(range(0, COUNT, BLOCK))
    np.testing.assert_array_equal(np.concatenate([b.force for b in blocks]), RUN.force)


def test_a_record_that_is_too_short_is_damage(run: Path) -> None:
    file = run / "run.mcap"
    mark = b"\x89MCAP0\r\n"
    file.write_bytes(mark + struct.pack("<BQ", 6, 3) + bytes(3) + mark)
    assert "a record is too short" in refused(run)


def test_the_progress_of_reading_is_reported_from_the_beginning(run: Path) -> None:
    heard: list[float] = []
    read_bag(run, progress=heard.append)
    assert heard[0] == 0.0
    assert heard == sorted(heard)
    assert heard[-1] <= 1.0
    assert max(heard) > 0.0
    words: list[str] = []
    measured_runs([run], tell=words.append)
    assert words[0] == "reading run: 0 %"
