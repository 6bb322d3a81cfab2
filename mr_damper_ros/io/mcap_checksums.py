"""Checksums of an MCAP file: added to what the library has written, checked before it reads.

See https://mcap.dev/spec: a file is a row of records, each an operation code (one byte), its
length (eight bytes) and its content. Three kinds of checksum (CRC-32; zero: none) guard each chunk
of messages, the data section, and the summary at the end. The library writes none, and checks
those of the chunks alone.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple
from zlib import crc32

_MAGIC = b"\x89MCAP0\r\n"
_CHUNK, _DATA_END, _FOOTER = 0x06, 0x0F, 0x02
_HEAD = struct.Struct("<BQ")
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


class _Guarded(NamedTuple):
    """The bytes from ``start`` to ``stop``, whose checksum stands at ``place``."""

    what: str
    place: int
    start: int
    stop: int


def add_checksums(path: Path) -> None:
    """Add the checksums to a file whose chunks are not compressed, and which has a summary."""
    with path.open("r+b") as file:
        for guarded in _guarded(file, list(_records(file))):
            crc = _crc(file, guarded)
            file.seek(guarded.place)
            file.write(crc.to_bytes(4, "little"))


def check_mcap(path: Path, maximum_bytes: int | None = None) -> None:
    """Check that a file says to unpack to no more than so many bytes, and its checksums.

    Those of compressed chunks are left to the library. Raises ChecksumError and OversizedError,
    and others where the file is damaged otherwise.
    """
    with path.open("rb") as file:
        records = list(_records(file))
        unpacked = sum(_number(file, r.start + 16, 8) for r in records if r.operation == _CHUNK)
        if maximum_bytes is not None and unpacked > maximum_bytes:
            raise OversizedError(f"it unpacks to more than {maximum_bytes // 1_000_000} MB")
        for guarded in _guarded(file, records):
            expected = _number(file, guarded.place, 4)
            if expected and expected != _crc(file, guarded):
                raise ChecksumError(f"the checksum of {guarded.what} is wrong")


def _guarded(file: BinaryIO, records: list[_Record]) -> Iterator[_Guarded]:
    """What has checksums, in the order in which they are written: each guards those before it."""
    for record in records:
        if record.operation == _CHUNK and _number(file, record.start + 28, 4) == 0:
            end = record.start + record.length
            yield _Guarded("a chunk", record.start + 24, record.start + 40, end)
    data_end = [record.start for record in records if record.operation == _DATA_END]
    footer = [record.start for record in records if record.operation == _FOOTER]
    if len(data_end) != 1 or len(footer) != 1:
        raise ChecksumError("it has no end")
    yield _Guarded("its data section", data_end[0], 0, data_end[0] - _HEAD.size)
    begin = _number(file, footer[0], 8) or footer[0] - _HEAD.size
    yield _Guarded("its summary", footer[0] + 16, begin, footer[0] + 16)


def _records(file: BinaryIO) -> Iterator[_Record]:
    end = file.seek(0, 2)
    file.seek(0)
    if file.read(len(_MAGIC)) != _MAGIC:
        raise ChecksumError("it does not begin as an MCAP file")
    position = len(_MAGIC)
    while position < end - len(_MAGIC):
        file.seek(position)
        operation, length = _HEAD.unpack(file.read(_HEAD.size))
        start = position + _HEAD.size
        if start + length > end:
            raise ChecksumError("it ends within a record")
        yield _Record(operation, start, length)
        position = start + length


def _crc(file: BinaryIO, guarded: _Guarded) -> int:
    crc, left = 0, guarded.stop - guarded.start
    file.seek(guarded.start)
    while left > 0:
        piece = file.read(min(_PIECE, left))
        if not piece:
            raise ChecksumError("it is cut off")
        crc = crc32(piece, crc)
        left -= len(piece)
    return crc


def _number(file: BinaryIO, position: int, size: int) -> int:
    file.seek(position)
    return int.from_bytes(file.read(size), "little")
