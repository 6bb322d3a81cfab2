"""Checksums of an MCAP file: added after writing, and checked before reading.

See https://mcap.dev/spec. A file is a sequence of records; each has an operation code (one byte),
its length (eight bytes) and its content. Each chunk of messages, the data section and the summary
at the end have a checksum (CRC-32; zero means none). The library writes no checksums, and checks
only the checksums of chunks.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from zlib import crc32

from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

if sys.version_info >= (3, 14):
    from compression.zstd import ZstdDecompressor
else:
    from backports.zstd import ZstdDecompressor

_MAGIC = b"\x89MCAP0\r\n"
_CHUNK, _DATA_END, _FOOTER = 0x06, 0x0F, 0x02
_HEAD = struct.Struct("<BQ")
_PIECE = 1 << 20


class ChecksumError(ValueError):
    """A file is damaged."""


class OversizedError(ValueError):
    """The unpacked size of a file exceeds the limit."""


class _Record(NamedTuple):
    """A record whose content has ``length`` bytes from the position ``start``."""

    operation: int
    start: int
    length: int


class _Guarded(NamedTuple):
    """The bytes from ``start`` to ``stop``, whose checksum is at the position ``place``."""

    what: str
    place: int
    start: int
    stop: int


def add_checksums(path: Path) -> None:
    """Add the checksums to a file with uncompressed chunks and a summary."""
    with path.open("r+b") as file:
        for guarded in _guarded(file, list(_records(file))):
            crc = _crc(file, guarded)
            file.seek(guarded.place)
            file.write(crc.to_bytes(4, "little"))


def check_mcap(path: Path, maximum_bytes: int | None = None) -> None:
    """Check the checksums of a file and its unpacked size, which compressed chunks may misstate.

    The library itself checks the checksums of compressed chunks. Raises OversizedError if the
    unpacked size exceeds ``maximum_bytes``, ChecksumError if a checksum or a size is wrong, and
    other exceptions for other damage.
    """
    with path.open("rb") as file:
        records = list(_records(file))
        chunks = [record for record in records if record.operation == _CHUNK]
        unpacked = sum(_number(file, chunk.start + 16, 8) for chunk in chunks)
        if maximum_bytes is not None and unpacked > maximum_bytes:
            raise OversizedError(f"it unpacks to more than {maximum_bytes // 1_000_000} MB")
        for guarded in _guarded(file, records):
            expected = _number(file, guarded.place, 4)
            if expected and expected != _crc(file, guarded):
                raise ChecksumError(f"the checksum of {guarded.what} is wrong")
        for chunk in chunks:
            _check_size(file, chunk)


def _check_size(file: BinaryIO, chunk: _Record) -> None:
    """Raise ChecksumError if a compressed chunk does not unpack to its stated size."""
    name_size = _number(file, chunk.start + 28, 4)
    if name_size == 0:
        return
    left = _number(file, chunk.start + 16, 8)
    file.seek(chunk.start + 32)
    unpackers = {b"lz4": LZ4FrameDecompressor, b"zstd": ZstdDecompressor}
    unpacker: Any = unpackers[file.read(name_size)]()
    packed = file.read(int.from_bytes(file.read(8), "little"))
    # A chunk is unpacked in pieces, so that it needs little memory, whatever its size.
    while not unpacker.eof and left >= 0:
        piece = unpacker.decompress(packed, max_length=_PIECE)
        if not piece and not packed:
            break
        left -= len(piece)
        packed = b""
    if left != 0 or not unpacker.eof or unpacker.unused_data:
        raise ChecksumError("a chunk does not unpack to its stated size")


def _guarded(file: BinaryIO, records: list[_Record]) -> Iterator[_Guarded]:
    """The protected parts in writing order; later checksums cover earlier ones."""
    for record in records:
        if record.operation == _CHUNK and _number(file, record.start + 28, 4) == 0:
            end = record.start + record.length
            yield _Guarded("a chunk", record.start + 24, record.start + 40, end)
    data_end = [record.start for record in records if record.operation == _DATA_END]
    footer = [record.start for record in records if record.operation == _FOOTER]
    if len(data_end) != 1 or len(footer) != 1:
        raise ChecksumError("its end is missing")
    yield _Guarded("its data section", data_end[0], 0, data_end[0] - _HEAD.size)
    begin = _number(file, footer[0], 8) or footer[0] - _HEAD.size
    yield _Guarded("its summary", footer[0] + 16, begin, footer[0] + 16)


def _records(file: BinaryIO) -> Iterator[_Record]:
    end = file.seek(0, 2)
    file.seek(0)
    if file.read(len(_MAGIC)) != _MAGIC:
        raise ChecksumError("it does not begin like an MCAP file")
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
