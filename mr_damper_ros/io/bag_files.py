"""The files of a bag, looked at before the library reads them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mr_damper_ros.io.bag_streams import BagError
from mr_damper_ros.io.mcap_checksums import OversizedError, check_mcap
from mr_damper_ros.io.regular_files import irregularity

_BYTES_PER_SAMPLE = 100
"""Of a message with a single sample; blocks take less."""

_LARGEST_METADATA = 10_000_000
"""Bytes of metadata.yaml."""


def check_bag_files(path: Path, maximum_samples: int | None) -> None:
    """Check that a bag, a folder or a single file, can be read and is as it was written.

    Raises BagError, in one sentence: for what is no regular file, whose reading may never end, a
    checksum that is wrong, and data that unpack to more than so many samples need (None: whatever
    they unpack to).
    """
    for file in _files(path):
        kind = irregularity(file)
        if kind:
            raise BagError(f"the bag '{path.name}' cannot be read: {file.name} is {kind}")
        if file.name == "metadata.yaml" and file.stat().st_size > _LARGEST_METADATA:
            raise BagError(
                f"the bag '{path.name}' cannot be read: its metadata.yaml has more than "
                f"{_LARGEST_METADATA // 1_000_000} MB"
            )
        if file.suffix == ".mcap":
            with failures_in_words(path.name):
                _check_mcap(path.name, file, maximum_samples)


def _files(path: Path) -> Iterator[Path]:
    if not path.is_dir():
        yield path
        return
    for entry in sorted(path.iterdir()):
        # A link to nowhere is for the library to miss; folders it does not enter.
        if entry.exists() and not entry.is_dir():
            yield entry


@contextmanager
def failures_in_words(name: str) -> Iterator[None]:
    """Make a BagError of whatever else goes wrong with a bag of this name."""
    # Damaged bytes surface in the library as exceptions of many kinds.
    try:
        yield
    except BagError:
        raise
    except Exception as error:
        raise BagError(
            f"the bag '{name}' is damaged or was cut off while it was written: record it again "
            f"or mend it with 'mcap recover' ({_first_line(error)})"
        ) from error


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")


def _check_mcap(name: str, file: Path, maximum_samples: int | None) -> None:
    limit = None if maximum_samples is None else _BYTES_PER_SAMPLE * maximum_samples
    try:
        check_mcap(file, limit)
    except OversizedError as error:
        raise BagError(
            f"the bag '{name}' is too large: {error}; make bags of parts of it with "
            "ros2 bag convert"
        ) from error
