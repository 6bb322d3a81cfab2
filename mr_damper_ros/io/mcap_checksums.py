"""Checksums of an MCAP file: added after writing, and checked before reading.

See https://mcap.dev/spec. A file is a sequence of records; each has an operation code (one byte),
its length (eight bytes) and its content. Each chunk of messages, the data section and the summary
at the end have a checksum (CRC-32; zero means none). The library writes no checksums, and checks
only the checksums of chunks.
"""

from __future__ import annotations

import struct
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO
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


_Records = dict[int, list[tuple[int, int]]]
"""Start and stop of the content of each record, by operation code."""


def add_checksums(path: Path) -> None:
    """Add the checksums to a file with uncompressed chunks and a summary."""
    with path.open("r+b") as file:
        for _, place, start, stop in _guarded(file, _records(file)):
            crc = _crc(file, start, stop)
            file.seek(place)
            file.write(crc.to_bytes(4, "little"))


def check_mcap(path: Path, maximum_bytes: int | None = None) -> None:
    """Check the checksums of a file and its unpacked size, which compressed chunks may misstate.

    The library itself checks the checksums of compressed chunks. Raises OversizedError if the
    unpacked size exceeds ``maximum_bytes``, ChecksumError if a checksum or a size is wrong, and
    other exceptions for other damage.
    """
    with path.open("rb") as file:
        records = _records(file)
        unpacked = sum(_number(file, start + 16, 8) for start, _ in records[_CHUNK])
        if maximum_bytes is not None and unpacked > maximum_bytes:
            raise OversizedError(f"it unpacks to more than {maximum_bytes // 1_000_000} MB")
        for what, place, start, stop in _guarded(file, records):
            expected = _number(file, place, 4)
            if expected and expected != _crc(file, start, stop):
                raise ChecksumError(f"the checksum of {what} is wrong")
        for start, _ in records[_CHUNK]:
            _check_size(file, start)


def _check_size(file: BinaryIO, start: int) -> None:
    """Raise ChecksumError if a compressed chunk does not unpack to its stated size."""
    name_size = _number(file, start + 28, 4)
    if name_size == 0:
        return
    left = _number(file, start + 16, 8)
    file.seek(start + 32)
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


def _guarded(file: BinaryIO, records: _Records) -> Iterator[tuple[str, int, int, int]]:
    """The protected parts in writing order, because later checksums cover earlier ones.

    Each is a name, the position of the checksum, and the start and stop of the protected bytes.
    """
    for start, stop in records[_CHUNK]:
        if _number(file, start + 28, 4) == 0:
            yield "a chunk", start + 24, start + 40, stop
    if len(records[_DATA_END]) != 1 or len(records[_FOOTER]) != 1:
        raise ChecksumError("its end is missing")
    (data_end, _), (footer, _) = *records[_DATA_END], *records[_FOOTER]
    yield "its data section", data_end, 0, data_end - _HEAD.size
    begin = _number(file, footer, 8) or footer - _HEAD.size
    yield "its summary", footer + 16, begin, footer + 16


def _records(file: BinaryIO) -> _Records:
    end = file.seek(0, 2)
    file.seek(0)
    if file.read(len(_MAGIC)) != _MAGIC:
        raise ChecksumError("it does not begin like an MCAP file")
    records: _Records = defaultdict(list)
    position = len(_MAGIC)
    while position < end - len(_MAGIC):
        file.seek(position)
        operation, length = _HEAD.unpack(file.read(_HEAD.size))
        start, position = position + _HEAD.size, position + _HEAD.size + length
        if position > end:
            raise ChecksumError("it ends within a record")
        records[operation].append((start, position))
    return records


def _crc(file: BinaryIO, start: int, stop: int) -> int:
    crc, left = 0, stop - start
    file.seek(start)
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
