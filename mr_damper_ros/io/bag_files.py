"""The files of a bag, MCAP or SQLite, and the messages in them; needs rosbags, but not ROS.

The files are checked and read as a whole. What a damaged or interrupted recording has lost is
refused, or said in :attr:`BagFiles.notes`.
"""

from __future__ import annotations

import os
import re
import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from heapq import heappop, heappush
from io import BytesIO
from itertools import count
from pathlib import Path, PurePath
from typing import Any, BinaryIO
from urllib.parse import quote
from zlib import crc32

import yaml
from lz4.frame import LZ4FrameFile
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag2.metadata import parse_qos
from zstandard import ZstdDecompressor, ZstdError

from mr_damper_ros.processes.files import irregularity

METADATA = "metadata.yaml"
_ENDINGS = (".mcap", ".db3")

_NEWEST_METADATA = 9
"""Newest version of metadata.yaml whose fields are known."""

_LARGEST_METADATA = 10_000_000
"""Largest size of metadata.yaml [B]."""


class BagError(ValueError):
    """An error in reading or writing a bag; the message says what to change."""


class DamageError(ValueError):
    """A file of a bag is damaged; the message gives the reason."""


class UnknownFormatError(ValueError):
    """A file of a bag has a form that is not known; the message names it."""


_NO_SPAN = 2**63, 0
"""First and last recording time [ns] of no messages."""

Progress = Callable[[float], None]
"""Receives the fraction of the work that is done."""

Message = tuple[int, int, bytes]
"""Recording time [ns], channel in its file, and serialised message."""


@dataclass
class _Channel:
    """A topic in a file; ``ext`` is the serialisation and the quality of service."""

    topic: str
    kind: str
    definition: MessageDefinition
    digest: str
    ext: ConnectionExtRosbag2
    messages: int = 0


_FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
}


def _definition(encoding: str, text: str) -> MessageDefinition:
    """A message definition; of an unknown language, none."""
    kind = _FORMATS.get(encoding, MessageDefinitionFormat.NONE)
    return MessageDefinition(kind, text if encoding in _FORMATS else "")


def _quality(profiles: Any) -> list[Any]:
    """Quality of service; empty if the bag states none that is known."""
    with suppress(Exception):  # of a topic that perhaps no one needs
        return list(parse_qos(profiles))
    return []


# ---- MCAP ----------------------------------------------------------------------------------------

_MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 1, 2, 3, 4, 5, 6, 0x0F
_RECORD = struct.Struct("<BQ")
_STAMPS = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQI")

_AFTER_SUMMARY = 12
"""Size [B] of the summary's checksum and the mark at the end of an MCAP file."""

_LARGEST_PIECE = 1 << 20
"""Size [B] up to which messages outside chunks are read at once."""


@dataclass
class _Piece:
    """Records that follow each other in a file: a chunk, or messages outside chunks."""

    offset: int
    size: int
    is_chunk: bool
    first_ns: int


class McapFile:
    """An MCAP file, checked as a whole: its checksums, and the sizes of its chunks.

    ``most`` is the largest size [B] of its unpacked messages (None: no limit). ``progress``
    receives the fraction that has been checked. Raises DamageError, and OverflowError if the
    messages are larger.
    """

    def __init__(self, path: Path, most: int | None, progress: Progress | None = None) -> None:
        self.channels: dict[int, _Channel] = {}
        self.span_ns = _NO_SPAN
        self._progress = progress
        self._schemas: dict[int, tuple[str, MessageDefinition]] = {}
        self._pieces: list[_Piece] = []
        self._in_order = True
        self._left = most
        self._file: BinaryIO = path.open("rb")
        try:
            self._scan(path.stat().st_size)
        except struct.error:
            self.close()
            raise DamageError("a record is too short") from None
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def messages(self, channels: Iterable[int]) -> Iterator[Message]:
        """The messages of some channels, ordered by their recording times."""
        wanted = frozenset(channels)
        if self._in_order:
            for piece in self._pieces:
                yield from self._messages_of(piece, wanted)
            return
        # A message waits until no later piece can hold an earlier one.
        waiting: list[tuple[int, int, Message]] = []
        number = count()
        for piece in sorted(self._pieces, key=lambda piece: piece.first_ns):
            while waiting and waiting[0][0] < piece.first_ns:
                yield heappop(waiting)[2]
            for message in self._messages_of(piece, wanted):
                heappush(waiting, (message[0], next(number), message))
        while waiting:
            yield heappop(waiting)[2]

    def _messages_of(self, piece: _Piece, wanted: frozenset[int]) -> Iterator[Message]:
        self._file.seek(piece.offset)
        data = self._file.read(piece.size)
        data = _unpacked(data) if piece.is_chunk else data
        for kind, start, end in _records(data):
            if kind == _MESSAGE:
                channel, _, time_ns, _ = _STAMPS.unpack_from(data, start)
                if channel in wanted:
                    yield time_ns, channel, data[start + _STAMPS.size : end]

    def _scan(self, size: int) -> None:
        """Read the whole file once."""
        file = self._file
        if file.read(len(_MAGIC)) != _MAGIC:
            raise DamageError("it does not begin as an MCAP file")
        checksum, ended, summary, summary_checksum = crc32(_MAGIC), False, 0, 0
        while (head := file.read(_RECORD.size)) and head != _MAGIC:
            if len(head) < _RECORD.size:
                raise DamageError("it ends within a record")
            kind, length = _RECORD.unpack(head)
            offset = file.tell()
            if length > size - offset:
                raise DamageError("it ends within a record")
            data = file.read(length)
            if kind == _DATA_END:
                (stated,) = struct.unpack_from("<I", data)
                if stated and stated != checksum:
                    raise DamageError("the checksum of its data is wrong")
                ended = True
            elif kind == _FOOTER:
                summary, _, summary_checksum = struct.unpack_from("<QQI", data)
                break
            if self._progress is not None and kind == _CHUNK:
                self._progress(offset / size)
            if not ended:
                checksum = crc32(data, crc32(head, checksum))
                self._take(kind, data, offset)
        if not ended:
            raise DamageError("the end of its data is missing")
        if file.read(len(_MAGIC)) != _MAGIC:
            raise DamageError("its end is missing")
        if summary and summary_checksum:
            file.seek(min(summary, size))
            if crc32(file.read()[:-_AFTER_SUMMARY]) != summary_checksum:
                raise DamageError("the checksum of its summary is wrong")

    def _take(self, kind: int, data: bytes, offset: int) -> None:
        """A record outside the chunks, whose content begins at the offset."""
        if kind == _CHUNK:
            _, _, length, _ = _CHUNK_HEAD.unpack_from(data)
            self._reserve(length)
            unpacked = _unpacked(data)
            piece = _Piece(offset, len(data), True, 2**64)
            for inner, start, end in _records(unpacked):
                if inner == _MESSAGE:
                    self._count(unpacked, start, piece)
                else:
                    self._describe(inner, unpacked[start:end])
            self._pieces.append(piece)
        elif kind == _MESSAGE:
            self._reserve(len(data))
            begin = offset - _RECORD.size
            last = self._pieces[-1] if self._pieces else None
            if last is None or last.is_chunk or last.size > _LARGEST_PIECE:
                last = _Piece(begin, 0, False, 2**64)
                self._pieces.append(last)
            last.size = offset + len(data) - last.offset
            self._count(data, 0, last)
        else:
            self._describe(kind, data)

    def _reserve(self, length: int) -> None:
        if self._left is not None:
            self._left -= length
            if self._left < 0:
                raise OverflowError

    def _count(self, data: bytes, start: int, piece: _Piece) -> None:
        channel, _, time_ns, _ = _STAMPS.unpack_from(data, start)
        if channel not in self.channels or time_ns >= 2**63:
            raise DamageError("a message has no channel, or an impossible time")
        self.channels[channel].messages += 1
        first, last = self.span_ns
        self._in_order = self._in_order and time_ns >= last
        self.span_ns = min(first, time_ns), max(last, time_ns)
        piece.first_ns = min(piece.first_ns, time_ns)

    def _describe(self, kind: int, data: bytes) -> None:
        """A record that describes messages."""
        if kind == _SCHEMA:
            (number,) = struct.unpack_from("<H", data)
            (name, encoding, text), _ = _texts(data, 2, 3)
            self._schemas[number] = name, _definition(encoding, text)
        elif kind == _CHANNEL:
            number, schema = struct.unpack_from("<HH", data)
            (topic, encoding), place = _texts(data, 4, 2)
            (length,) = struct.unpack_from("<I", data, place)
            pairs, place, end = {}, place + 4, place + 4 + length
            while place < end:
                (key, value), place = _texts(data, place, 2)
                pairs[key] = value
            name, definition = self._schemas.get(schema, ("", _definition("", "")))
            quality = _quality(pairs.get("offered_qos_profiles", ""))
            digest = pairs.get("topic_type_hash", "")
            ext = ConnectionExtRosbag2(encoding, quality)
            # A channel may be described again in every chunk.
            self.channels.setdefault(number, _Channel(topic, name, definition, digest, ext))


def _records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Kind, start and end of the content of each record."""
    place, size, head = 0, len(data), _RECORD.size
    while place < size:
        kind, length = _RECORD.unpack_from(data, place)
        place += head
        if length > size - place:
            raise DamageError("a record exceeds its chunk")
        yield kind, place, place + length
        place += length


def _texts(data: bytes, place: int, count: int) -> tuple[list[str], int]:
    """Successive texts, each preceded by its length, and their end.

    A definition may be in a language of bytes; its text is then of no use.
    """
    found = []
    for _ in range(count):
        (length,) = struct.unpack_from("<I", data, place)
        if length > len(data) - place - 4:
            raise DamageError("a record is too short")
        found.append(data[place + 4 : place + 4 + length].decode(errors="replace"))
        place += 4 + length
    return found, place


def _unpacked(chunk: bytes) -> bytes:
    """The records in a chunk; raises DamageError if its size or its checksum is wrong."""
    _, _, length, checksum = _CHUNK_HEAD.unpack_from(chunk)
    (compression,), place = _texts(chunk, _CHUNK_HEAD.size, 1)
    data = chunk[place + 8 :]
    if compression == "zstd":
        unpacker: Any = ZstdDecompressor().stream_reader(data, read_across_frames=True)
    elif compression == "lz4":
        unpacker = LZ4FrameFile(BytesIO(data))
    elif compression:
        raise UnknownFormatError(f"its chunks are compressed with '{compression}'")
    else:
        unpacker = BytesIO(data)
    try:
        # Never more is unpacked than the stated size.
        unpacked: bytes = unpacker.read(length + 1)
    except (ZstdError, RuntimeError, EOFError):
        raise DamageError("a chunk cannot be unpacked") from None
    if len(unpacked) != length:
        raise DamageError("a chunk does not unpack to its stated size")
    if checksum and crc32(unpacked) != checksum:
        raise DamageError("the checksum of a chunk is wrong")
    return unpacked


# ---- SQLite --------------------------------------------------------------------------------------

_JOURNALS = ("-wal", "-journal")
_WAL_HEAD, _FRAME_HEAD = 32, 24


class SqliteFile:
    """An SQLite file; the journal of an interrupted recording is read from a copy in ``folder``.

    ``notes`` say what a journal added or lost. Raises DamageError.
    """

    def __init__(self, path: Path, folder: Callable[[], Path]) -> None:
        self.channels: dict[int, _Channel] = {}
        self.span_ns = _NO_SPAN
        self.notes: list[str] = []
        self._base: sqlite3.Connection | None = None
        journals = [_with_ending(path, ending) for ending in _JOURNALS]
        journals = [each for each in journals if each.is_file() and each.stat().st_size]
        try:
            _check_length(path)
            if journals:
                self._base = self._with_journals(path, journals, folder())
            else:
                # Opened in this way, nothing is written to the folder of the bag.
                self._base = _connected(path, "mode=ro&immutable=1")
            self._describe()
        except sqlite3.Error:
            self.close()
            raise DamageError(f"{path.name} is not a sound SQLite file") from None
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        if self._base is not None:
            self._base.close()

    def messages(self, channels: Iterable[int]) -> Iterator[Message]:
        """The messages of some channels, ordered by their recording times."""
        assert self._base is not None
        listed = ",".join(str(int(each)) for each in channels)
        try:
            yield from self._base.execute(
                f"SELECT timestamp, topic_id, data FROM messages WHERE topic_id IN ({listed}) "
                "ORDER BY timestamp, id"
            )
        except sqlite3.Error:
            raise DamageError("a part of its messages cannot be read") from None

    def _with_journals(self, path: Path, journals: list[Path], folder: Path) -> sqlite3.Connection:
        """Open a copy, in which SQLite completes or undoes the last transactions."""
        copy = Path(shutil.copy(path, folder / path.name))
        for each in journals:
            shutil.copy(each, folder)
        base = _connected(copy, "mode=rw")
        wal, rollback = (_with_ending(path, ending) for ending in _JOURNALS)
        if wal in journals:
            self.notes.append(_state_of_wal(base, wal))
        if rollback in journals:
            base.execute("SELECT count(*) FROM sqlite_master")
            # SQLite deletes the copy of the journal once it has undone the transaction.
            if not _with_ending(copy, _JOURNALS[1]).exists():
                self.notes.append(
                    f"the journal {rollback.name} of an interrupted recording was read, too: the "
                    "messages of the last, incomplete transaction are lost"
                )
        return base

    def _describe(self) -> None:
        base = self._base
        assert base is not None
        base.text_factory = lambda text: text.decode(errors="replace")
        fields = {row[1] for row in base.execute("PRAGMA table_info(topics)")}
        if not fields or not list(base.execute("PRAGMA table_info(messages)")):
            raise DamageError("it lacks the tables of a bag")
        definitions: dict[str, MessageDefinition] = {}
        if list(base.execute("PRAGMA table_info(message_definitions)")):
            for kind, encoding, text in base.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            ):
                definitions[kind] = _definition(encoding, text)
        optional = ("offered_qos_profiles", "type_description_hash")
        chosen = ", ".join(each if each in fields else "''" for each in optional)
        for number, topic, kind, encoding, quality, digest in base.execute(
            f"SELECT id, name, type, serialization_format, {chosen} FROM topics ORDER BY id"
        ):
            definition = definitions.get(kind, _definition("", ""))
            ext = ConnectionExtRosbag2(encoding, _quality(quality))
            self.channels[number] = _Channel(topic, kind, definition, digest, ext)
        for number, messages, first, last in base.execute(
            "SELECT topic_id, count(*), min(timestamp), max(timestamp) FROM messages "
            "GROUP BY topic_id"
        ):
            if number not in self.channels:
                raise DamageError("messages have no topic")
            self.channels[number].messages = messages
            self.span_ns = min(self.span_ns[0], first), max(self.span_ns[1], last)


def _with_ending(path: Path, ending: str) -> Path:
    return path.with_name(path.name + ending)


def _connected(path: Path, options: str) -> sqlite3.Connection:
    # A node opens a bag in one thread, and plays it in another.
    address = f"file:{quote(os.path.abspath(path))}?{options}"
    return sqlite3.connect(address, uri=True, check_same_thread=False)


def _check_length(path: Path) -> None:
    """Raise DamageError if the file has fewer pages than it states."""
    with path.open("rb") as file:
        head = file.read(100)
    if not head.startswith(b"SQLite format 3\0") or len(head) < 100:
        raise DamageError("it does not begin as an SQLite file")
    page, changed, pages, valid_for = (
        int.from_bytes(head[a:b], "big") for a, b in ((16, 18), (24, 28), (28, 32), (92, 96))
    )
    page = 65536 if page == 1 else page
    if changed == valid_for and path.stat().st_size < page * pages:
        raise DamageError("it is cut off")


def _state_of_wal(base: sqlite3.Connection, wal: Path) -> str:
    """Read the journal into the database; returns what it held, in words. Raises DamageError."""
    with wal.open("rb") as file:
        head = file.read(_WAL_HEAD)
        _, _, used = base.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
        frame = _FRAME_HEAD + int.from_bytes(head[8:12], "big")
        held = wal.stat().st_size - _WAL_HEAD
        if used <= 0 and held > 0:
            raise DamageError(f"its journal {wal.name} cannot be read")
        file.seek(_WAL_HEAD + used * frame)
        following = file.read(_FRAME_HEAD)
    said = f"the journal {wal.name} of an interrupted recording was read, too"
    # Frames that the journal has overwritten have another salt.
    if held > used * frame and following[8:16] in (b"", head[16:24]):
        said += ": the messages of its last, incomplete transaction are lost"
    return said


# ---- a bag ---------------------------------------------------------------------------------------


@contextmanager
def damage_in_words(bag: str, file: Path) -> Iterator[None]:
    """Convert damage of a file, and unknown forms, to a BagError about the bag."""
    try:
        yield
    except UnknownFormatError as error:
        raise BagError(
            f"the bag '{bag}' cannot be read: {file.name} has an unknown form ({error}); convert "
            "the bag with ros2 bag convert"
        ) from error
    except DamageError as error:
        remedy = "repair it with 'mcap recover'"
        if file.suffix == ".db3":
            remedy = f"save what is left with sqlite3 {file.name} .recover"
        raise BagError(
            f"the bag '{bag}' is damaged or incomplete: {file.name} cannot be read ({error}); "
            f"record it again, or {remedy}"
        ) from error


class BagFiles:
    """An open bag: a folder, or one of its files.

    ``connections`` are its topics, ``custom`` its own data in metadata.yaml, and ``notes`` say what
    is missing. ``progress`` receives the fraction of the files that has been checked. Raises
    BagError if the bag is damaged, or its messages have more than ``most`` bytes (None: no limit).
    """

    def __init__(
        self, path: Path, most: int | None = None, progress: Progress | None = None
    ) -> None:
        self.name = Path(os.path.abspath(path)).name
        for ending in _ENDINGS:
            self.name = self.name.removesuffix(ending)
        self.notes: list[str] = []
        self.custom: dict[str, str] = {}
        self.connections: list[Connection] = []
        self._stated: dict[str, int] = {}
        self._digests: dict[tuple[str, str], str] = {}
        self._compression = ""
        self._most = most
        self._files: list[tuple[Path, McapFile | SqliteFile]] = []
        self._stack = ExitStack()
        try:
            files = self._find(path)
            for number, file in enumerate(files):

                def checked(fraction: float, number: int = number) -> None:
                    if progress is not None:
                        progress((number + fraction) / len(files))

                checked(0.0)
                self._open(file, checked)
            self._join()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> BagFiles:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all files."""
        self._stack.close()

    @property
    def message_count(self) -> int:
        """Number of messages."""
        return sum(connection.msgcount for connection in self.connections)

    @property
    def duration(self) -> int:
        """Time [ns] from the first to the last message, by their recording times."""
        spans = [file.span_ns for _, file in self._files]
        first, last = min(each[0] for each in spans), max(each[1] for each in spans)
        return max(last - first, 0)

    def messages(
        self, connections: Iterable[Connection]
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Connection, recording time [ns] and content of the messages, file by file.

        Within a file, the recording times order the messages. Raises BagError.
        """
        wanted = {(each.topic, each.msgtype): each for each in connections}
        unpack = ZstdDecompressor().decompress if self._compression == "message" else None
        for path, file in self._files:
            found = {
                number: wanted[channel.topic, channel.kind]
                for number, channel in file.channels.items()
                if (channel.topic, channel.kind) in wanted
            }
            with damage_in_words(self.name, path):
                for time_ns, number, data in file.messages(found):
                    try:
                        yield found[number], time_ns, unpack(data) if unpack else data
                    except ZstdError:
                        raise DamageError("a message cannot be unpacked") from None

    def lacking(self, topics: Iterable[str]) -> list[str]:
        """What these topics lack of the messages that metadata.yaml states, in words."""
        return [
            f"{METADATA} states {self._stated[each.topic]} messages on {each.topic}, but the files "
            f"hold only {each.msgcount}: the others are lost"
            for each in self.connections
            if each.topic in topics and self._stated.get(each.topic, 0) > each.msgcount
        ]

    # ---- opening

    def _find(self, path: Path) -> list[Path]:
        """The files of the bag, in their order."""
        folder = path if path.is_dir() else path.parent
        stated = self._read_metadata(folder / METADATA) if (folder / METADATA).is_file() else []
        if not path.is_dir():
            if stated and path.name not in stated:
                self._stated, self.custom, self._compression = {}, {}, ""
            elif len(stated) > 1:
                self._stated = {}
                self.notes.append(
                    f"only {path.name} of the {len(stated)} files of its bag was read: give the "
                    "folder to read all"
                )
            elif stated and len(_bag_files(folder)) == 1:
                # The folder of a single file has the name of the bag.
                self.name = Path(os.path.abspath(folder)).name
            return [path]
        if not (folder / METADATA).is_file():
            return self._without_metadata(folder)
        missing = [name for name in stated if not (folder / name).exists()]
        if missing or not stated:
            raise BagError(
                f"the bag '{self.name}' is incomplete: {METADATA} names "
                f"{', '.join(missing) or 'no file'}"
                f"{', which the folder does not hold: add it' if missing else ''}; or make "
                f"{METADATA} anew with ros2 bag reindex"
            )
        more = [file.name for file in _bag_files(folder) if file.name not in stated]
        if more:
            self.notes.append(
                f"{METADATA} does not name {', '.join(more)}, which was not read: make {METADATA} "
                "anew with ros2 bag reindex"
            )
        return [folder / name for name in stated]

    def _without_metadata(self, folder: Path) -> list[Path]:
        """The only file in a folder, or the numbered files of one bag."""
        files = _bag_files(folder)
        numbered = sorted(
            (int(found[2]), found[1], file)
            for file in files
            if (found := re.fullmatch(r"(.*)_(\d+)", file.stem))
        )
        if len(files) > 1:
            numbers, stems = [each[0] for each in numbered], {each[1] for each in numbered}
            if len(numbers) < len(files) or len(stems) > 1 or len({f.suffix for f in files}) > 1:
                raise BagError(
                    f"{folder} has no {METADATA}, and several files: give one of "
                    f"{', '.join(file.name for file in files)}, or make {METADATA} with ros2 bag "
                    "reindex"
                )
            if numbers != list(range(len(numbers))):
                missing = next(k for k, each in enumerate([*numbers, -1]) if k != each)
                raise BagError(
                    f"the bag '{self.name}' is incomplete: it has no {METADATA}, and its file "
                    f"with the number {missing} is missing; add it, or give the single files"
                )
            files = [each[2] for each in numbered]
        self.notes.append(
            f"the bag has no {METADATA}: all {len(files)} files in its folder were read"
            if len(files) > 1
            else f"the bag has no {METADATA}: {files[0].name} was read"
        )
        return files

    def _read_metadata(self, file: Path) -> list[str]:
        """Names of the files; raises BagError."""
        if file.stat().st_size > _LARGEST_METADATA:
            raise BagError(
                f"the bag '{self.name}' cannot be read: its {METADATA} has more than "
                f"{_LARGEST_METADATA // 1_000_000} MB"
            )
        try:
            loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
            found = yaml.load(file.read_bytes(), loader)["rosbag2_bagfile_information"]
            version = int(found["version"])
            names = [PurePath(name).name for name in found["relative_file_paths"]]
            for each in found["topics_with_message_count"]:
                topic, described = each["topic_metadata"]["name"], each["topic_metadata"]
                self._stated[topic] = self._stated.get(topic, 0) + int(each["message_count"])
                digest = str(described.get("type_description_hash") or "")
                self._digests[topic, described["type"]] = digest
            self._compression = str(found.get("compression_mode") or "").lower()
            packing = str(found.get("compression_format") or "")
            custom = found.get("custom_data") or {}
            self.custom = {str(key): str(value) for key, value in custom.items()}
        except (
            yaml.YAMLError,
            LookupError,
            TypeError,
            ValueError,
            AttributeError,
            RecursionError,
        ):
            raise BagError(
                f"the bag '{self.name}' is damaged: its {METADATA} cannot be read; make it anew "
                "with ros2 bag reindex"
            ) from None
        if version > _NEWEST_METADATA:
            raise BagError(
                f"the bag '{self.name}' has metadata of version {version}, and versions up to "
                f"{_NEWEST_METADATA} are known: convert it with ros2 bag convert"
            )
        if self._compression not in ("", "none") and packing != "zstd":
            raise BagError(
                f"the bag '{self.name}' is compressed with '{packing}', and only zstd is known: "
                "convert it with ros2 bag convert"
            )
        return names

    def _open(self, path: Path, progress: Progress) -> None:
        kind = irregularity(path)
        if kind:
            raise BagError(f"the bag '{self.name}' cannot be read: {path.name} is {kind}")
        if self._compression == "file" and path.suffix == ".zstd":
            path = self._unpack(path)
        if path.suffix not in _ENDINGS:
            raise BagError(
                f"the bag '{self.name}' has the file {path.name}: only MCAP and SQLite (.db3) are "
                "known; convert it with ros2 bag convert"
            )
        file: McapFile | SqliteFile
        with damage_in_words(self.name, path):
            if path.suffix == ".mcap":
                try:
                    file = McapFile(path, self._most, progress)
                except OverflowError:
                    raise self._too_large() from None
            else:
                file = SqliteFile(path, self._folder)
                self.notes += file.notes
        self._stack.callback(file.close)
        self._files.append((path, file))

    def _folder(self) -> Path:
        """A temporary folder."""
        made = tempfile.TemporaryDirectory(prefix="mr_damper_")
        return Path(self._stack.enter_context(made))

    def _unpack(self, path: Path) -> Path:
        """The content of a compressed file, in a temporary folder."""
        unpacked = self._folder() / path.stem
        with path.open("rb") as packed, unpacked.open("wb") as out:
            reader = ZstdDecompressor().stream_reader(packed, read_across_frames=True)
            with damage_in_words(self.name, path):
                try:
                    while piece := reader.read(_LARGEST_PIECE):
                        out.write(piece)
                        if self._most is not None and out.tell() > self._most:
                            raise self._too_large()
                except ZstdError:
                    raise DamageError("it cannot be unpacked") from None
        return unpacked

    def _too_large(self) -> BagError:
        return BagError(
            f"the bag '{self.name}' is too large: it unpacks to more than "
            f"{(self._most or 0) // 1_000_000} MB; split it with ros2 bag convert"
        )

    def _join(self) -> None:
        """The topics of all files."""
        found: dict[tuple[str, str], _Channel] = {}
        counts: dict[tuple[str, str], int] = {}
        for channel in (each for _, file in self._files for each in file.channels.values()):
            key = channel.topic, channel.kind
            counts[key] = counts.get(key, 0) + channel.messages
            if key not in found or not found[key].definition.data:
                found[key] = channel
        self.connections = [
            Connection(
                number,
                channel.topic,
                channel.kind,
                channel.definition,
                channel.digest or self._digests.get(key, ""),
                counts[key],
                channel.ext,
                self,
            )
            for number, (key, channel) in enumerate(found.items(), start=1)
        ]


def _bag_files(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix in _ENDINGS and file.is_file())


def is_bag(path: Path) -> bool:
    """Whether a path is the folder of a bag, or one of its files."""
    if path.is_dir():
        return (path / METADATA).is_file() or bool(_bag_files(path))
    return path.suffix in _ENDINGS
