"""Checksums of an MCAP file: added after writing, and checked before reading.

See https://mcap.dev/spec. A file is a sequence of records; each has an operation code (one byte),
its length (eight bytes) and its content. The data section and the summary at the end have a
checksum (CRC-32; zero means none). The library writes no checksums, and checks only those that each
chunk of messages may have in addition.
"""

from __future__ import annotations

import struct
import sys
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
_HEAD = struct.Struct("<BQ")
_CHUNK = 0x06
_END_OF_DATA = _HEAD.pack(0x0F, 4)
_FOOTER_SIZE = 20
_PIECE = 1 << 20


class OversizedError(ValueError):
    """The unpacked size of a file exceeds the limit."""


def add_checksums(path: Path) -> None:
    """Add the checksums to a file."""
    with path.open("r+b") as file:
        for _, place, start, stop in _sections(file):
            crc = _crc(file, start, stop)
            file.seek(place)
            file.write(crc.to_bytes(4, "little"))


def check_mcap(path: Path, maximum_bytes: int | None = None) -> None:
    """Check the checksums of a file and its unpacked size, which compressed chunks may misstate.

    Raises OversizedError if the unpacked size exceeds ``maximum_bytes``, ValueError if a
    checksum or a size is wrong, and other exceptions for other damage.
    """
    with path.open("rb") as file:
        chunks = list(_chunks(file))
        unpacked = sum(_number(file, start + 16, 8) for start in chunks)
        if maximum_bytes is not None and unpacked > maximum_bytes:
            raise OversizedError(f"it unpacks to more than {maximum_bytes // 1_000_000} MB")
        for what, place, start, stop in _sections(file):
            expected = _number(file, place, 4)
            if expected and expected != _crc(file, start, stop):
                raise ValueError(f"the checksum of its {what} is wrong")
        for start in chunks:
            _check_size(file, start)


def _chunks(file: BinaryIO) -> Iterator[int]:
    """The position of the content of each chunk."""
    end = file.seek(0, 2) - len(_MAGIC)
    position = len(_MAGIC)
    while position < end:
        file.seek(position)
        operation, length = _HEAD.unpack(file.read(_HEAD.size))
        start, position = position + _HEAD.size, position + _HEAD.size + length
        if operation == _CHUNK:
            yield start
    if position != end:
        raise ValueError("it ends within a record")


def _sections(file: BinaryIO) -> Iterator[tuple[str, int, int, int]]:
    """Each protected section: name, position of its checksum, start and stop of its bytes.

    The record that ends the data directly precedes the summary or, without a summary, the footer.
    """
    footer = file.seek(0, 2) - len(_MAGIC) - _FOOTER_SIZE
    summary = _number(file, footer, 8) or footer - _HEAD.size
    end = summary - len(_END_OF_DATA) - 4
    file.seek(max(end, 0))
    if file.read(len(_END_OF_DATA)) != _END_OF_DATA:
        raise ValueError("the end of its data is missing")
    yield "data section", summary - 4, 0, end
    yield "summary", footer + 16, summary, footer + 16


def _check_size(file: BinaryIO, start: int) -> None:
    """Raise ValueError if a compressed chunk does not unpack to its stated size."""
    file.seek(start + 16)
    left, _, name_size = struct.unpack("<QII", file.read(16))
    if name_size == 0:
        return
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
        raise ValueError("a chunk does not unpack to its stated size")


def _crc(file: BinaryIO, start: int, stop: int) -> int:
    crc = 0
    file.seek(start)
    while start < stop:
        piece = file.read(min(_PIECE, stop - start))
        if not piece:
            raise ValueError("it is cut off")
        crc, start = crc32(piece, crc), start + len(piece)
    return crc


def _number(file: BinaryIO, position: int, size: int) -> int:
    file.seek(position)
    return int.from_bytes(file.read(size), "little")
