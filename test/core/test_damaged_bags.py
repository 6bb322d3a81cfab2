"""Bags are written with checksums; changed or unbounded files are rejected."""

import struct
import tracemalloc
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard

from benchmarks.hostile import checksum_places
from mr_damper_ros.io.bag_files import BagError, BagFiles
from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.io.bag_writer import write_bag
from mr_damper_ros.signals.recording import Recording

CHUNK = 0x06


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    time = np.arange(300) * 1e-3
    rows = 1e-3 * np.sin(20.0 * time), 1e3 * time, np.ones(300)
    write_bag(tmp_path / "bag", Recording("bag", 1_700_000_000_000_000_000, 1e-3, *rows))
    return tmp_path / "bag"


def test_every_flipped_bit_is_noticed(bag: Path) -> None:
    file = bag / "bag.mcap"
    whole = file.read_bytes()
    rng = np.random.default_rng(0)
    positions = {
        *range(40),
        *range(len(whole) - 60, len(whole)),
        *rng.integers(len(whole), size=300),
    }
    missed = []
    for position in sorted(map(int, positions)):
        changed = bytearray(whole)
        changed[position] ^= 1 << int(rng.integers(8))
        file.write_bytes(changed)
        try:
            read_bag(bag)
        except BagError:
            continue
        missed.append(position)
    assert missed == []


def test_a_file_without_checksums_is_read(bag: Path) -> None:
    file = bag / "bag.mcap"
    without = bytearray(file.read_bytes())
    for place in checksum_places(without):
        without[place : place + 4] = bytes(4)
    file.write_bytes(bytes(without))
    assert read_bag(bag)[0].sample_count == 300


def test_a_damaged_definition_without_checksums_is_said(bag: Path) -> None:
    file = bag / "bag.mcap"
    whole = bytearray(file.read_bytes().replace(b"float64 period", b"float64 perjod"))
    for place in checksum_places(whole):
        whole[place : place + 4] = bytes(4)
    file.write_bytes(bytes(whole))
    with pytest.raises(BagError, match="is damaged"):
        read_bag(bag)


PACKERS = {"zstd": zstandard.compress, "lz4": lz4.frame.compress}


def packed(file: Path, content: bytes, size: int, by: str = "zstd") -> None:
    """Replace the file by one with a single chunk whose stated unpacked size is ``size``."""
    stored, name = PACKERS[by](content), by.encode()
    chunk = struct.pack("<QQQII", 0, 0, size, 0, len(name)) + name
    chunk += struct.pack("<Q", len(stored)) + stored
    magic = b"\x89MCAP0\r\n"
    end = struct.pack("<BQI", 0x0F, 4, 0) + struct.pack("<BQQQI", 0x02, 20, 0, 0, 0)
    file.write_bytes(magic + struct.pack("<BQ", CHUNK, len(chunk)) + chunk + end + magic)


def filler(size: int) -> bytes:
    """A record of this size [B] that holds no message."""
    return struct.pack("<BQ", 0x80, size - 9) + bytes(size - 9)


def open_and_close(bag: Path, most: int | None) -> None:
    BagFiles(bag, most).close()


def test_what_unpacks_to_too_much_is_refused_before_it_does(bag: Path) -> None:
    packed(bag / "bag.mcap", filler(3_000_000), 3_000_000)
    with pytest.raises(BagError, match="the bag 'bag' is too large: it unpacks to more than 2 MB"):
        open_and_close(bag, 2_000_000)


@pytest.mark.parametrize("by", PACKERS)
def test_a_chunk_that_unpacks_to_more_than_it_says_is_refused(bag: Path, by: str) -> None:
    packed(bag / "bag.mcap", filler(300_000_000), 1000, by)
    tracemalloc.start()
    with pytest.raises(BagError, match="a chunk does not unpack to its stated size"):
        open_and_close(bag, 2_000_000)
    # The check never unpacks more than the stated size.
    assert tracemalloc.get_traced_memory()[1] < 30_000_000
    tracemalloc.stop()


@pytest.mark.parametrize("by", PACKERS)
@pytest.mark.parametrize("size", [3_000_001, 2_999_999])
def test_the_size_of_a_chunk_is_the_one_it_says(bag: Path, size: int, by: str) -> None:
    packed(bag / "bag.mcap", filler(3_000_000), 3_000_000, by)
    open_and_close(bag, None)
    packed(bag / "bag.mcap", filler(3_000_000), size, by)
    with pytest.raises(BagError, match="a chunk does not unpack to its stated size"):
        open_and_close(bag, None)


def test_a_bag_with_more_samples_than_allowed_is_refused(bag: Path) -> None:
    assert read_bag(bag, maximum_samples=300)[0].sample_count == 300
    with pytest.raises(BagError, match="the bag 'bag' is too large"):
        read_bag(bag, maximum_samples=299)


def test_metadata_beyond_reason_are_refused(bag: Path) -> None:
    with (bag / "metadata.yaml").open("a") as file:
        file.write("# " + "x" * 10_000_000)
    with pytest.raises(BagError, match="more than 10 MB"):
        read_bag(bag)
