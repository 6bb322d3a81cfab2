"""Checksums of an MCAP file: added to what the library has written, checked before it reads.

See https://mcap.dev/spec: a file is a row of records, each an operation code (one byte), its
length (eight bytes) and its content. Three kinds of checksum (CRC-32; zero: none) guard each chunk
of messages, the data section, and the summary at the end. The library writes none, and checks
those of the chunks alone; it unpacks a chunk to whatever size that has.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple
from zlib import crc32

_MAGIC = b"\x89MCAP0\r\n"
_CHUNK, _DATA_END, _FOOTER = 0x06, 0x0F, 0x02
_HEAD = 9
"""Bytes of a record before its content."""

_CHUNK_HEAD = struct.Struct("<QQQII")
"""First and last time, size and checksum of the unpacked content, length of the next field."""

_PIECE = 1 << 20


class ChecksumError(ValueError):
    """The bytes of a file are not those that were written."""


class OversizedError(ValueError):
    """The file unpacks to more than is allowed."""


class _Record(NamedTuple):
    """A record whose content of ``length`` bytes begins at ``start``."""

    operation: int
    start: int
    length: int


def add_checksums(path: Path) -> None:
    """Add the checksums to a file whose chunks are not compressed, and which has a summary."""
    with path.open("r+b") as file:
        records = list(_records(file))
        for record in records:
            if record.operation == _CHUNK:
                head = _ChunkHead.read(file, record)
                _write(file, record.start + 24, crc32(file.read(head.stored)))
        data_end, footer = _ends(records)
        _write(file, data_end.start, _crc(file, 0, data_end.start - _HEAD))
        _write(file, footer.start + 16, _summary_crc(file, footer))


def check_mcap(path: Path, maximum_bytes: int | None = None) -> None:
    """Check the checksums that a file has, and that it unpacks to no more than so many bytes.

    Raises ChecksumError and OversizedError, and others where the file is damaged otherwise.
    """
    unpacked = 0
    with path.open("rb") as file:
        records = list(_records(file))
        for record in records:
            if record.operation != _CHUNK:
                continue
            head = _ChunkHead.read(file, record)
            unpacked += head.size
            if maximum_bytes is not None and unpacked > maximum_bytes:
                raise OversizedError(f"it unpacks to more than {maximum_bytes // 1_000_000} MB")
            _check_chunk(file, head)
        data_end, footer = _ends(records)
        expected = _number(file, data_end.start)
        if expected and expected != _crc(file, 0, data_end.start - _HEAD):
            raise ChecksumError("the checksum of its data section is wrong")
        expected = _number(file, footer.start + 16)
        if expected and expected != _summary_crc(file, footer):
            raise ChecksumError("the checksum of its summary is wrong")


class _ChunkHead(NamedTuple):
    """Unpacked ``size`` and checksum, compression, and number of ``stored`` bytes that follow."""

    size: int
    crc: int
    compression: str
    stored: int

    @classmethod
    def read(cls, file: BinaryIO, record: _Record) -> _ChunkHead:
        """Read the head; the file is then at the stored bytes."""
        file.seek(record.start)
        _, _, size, crc, name_length = _CHUNK_HEAD.unpack(file.read(_CHUNK_HEAD.size))
        compression = file.read(min(name_length, 100)).decode()
        (stored,) = struct.unpack("<Q", file.read(8))
        if file.tell() + stored != record.start + record.length:
            raise ChecksumError("a chunk does not have the length that it says")
        return cls(size, crc, compression, stored)


def _check_chunk(file: BinaryIO, head: _ChunkHead) -> None:
    unpack = _unpacker(head.compression)
    data, crc, size = file.read(head.stored), 0, 0
    while piece := unpack(data, _PIECE):
        data = b""
        size += len(piece)
        crc = crc32(piece, crc)
        if size > head.size:
            break
    if size != head.size or (head.crc and crc != head.crc):
        raise ChecksumError("the size or the checksum of a chunk is wrong")


def _unpacker(compression: str) -> Callable[[bytes, int], bytes]:
    """Gives the unpacked content of what it is given in pieces, b"" at the end."""
    if compression == "zstd":
        from backports.zstd import ZstdDecompressor

        zstd = ZstdDecompressor()
        return lambda data, size: b"" if zstd.eof else zstd.decompress(data, size)
    if compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        lz4 = LZ4FrameDecompressor()
        return lambda data, size: b"" if lz4.eof else lz4.decompress(data, size)
    return lambda data, size: data


def _records(file: BinaryIO) -> Iterator[_Record]:
    end = file.seek(0, 2)
    file.seek(0)
    if file.read(len(_MAGIC)) != _MAGIC:
        raise ChecksumError("it does not begin as an MCAP file")
    position = len(_MAGIC)
    while position < end - len(_MAGIC):
        file.seek(position)
        operation, length = struct.unpack("<BQ", file.read(_HEAD))
        start = position + _HEAD
        if start + length > end:
            raise ChecksumError("it ends within a record")
        yield _Record(operation, start, length)
        position = start + length


def _ends(records: list[_Record]) -> tuple[_Record, _Record]:
    """The records that end the data section and the summary."""
    data_end = [record for record in records if record.operation == _DATA_END]
    footer = [record for record in records if record.operation == _FOOTER]
    if len(data_end) != 1 or len(footer) != 1:
        raise ChecksumError("it has no end")
    return data_end[0], footer[0]


def _summary_crc(file: BinaryIO, footer: _Record) -> int:
    file.seek(footer.start)
    (start,) = struct.unpack("<Q", file.read(8))
    return _crc(file, start or footer.start - _HEAD, footer.start + 16)


def _crc(file: BinaryIO, start: int, stop: int) -> int:
    crc = 0
    file.seek(start)
    while start < stop:
        piece = file.read(min(_PIECE, stop - start))
        if not piece:
            raise ChecksumError("it is cut off")
        crc = crc32(piece, crc)
        start += len(piece)
    return crc


def _number(file: BinaryIO, position: int) -> int:
    file.seek(position)
    return int.from_bytes(file.read(4), "little")


def _write(file: BinaryIO, position: int, number: int) -> None:
    file.seek(position)
    file.write(number.to_bytes(4, "little"))
