"""A bag that is open for reading: its files are looked at before the library reads them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader

from mr_damper_ros.io.columns import MAXIMUM_SAMPLES
from mr_damper_ros.io.mcap_checksums import OversizedError, check_mcap
from mr_damper_ros.processes.files import irregularity

MTS_TOPIC = "/mts/samples"
CURRENT_TOPIC = "/supply/current"
TEMPERATURE_TOPIC = "/temperature"

SAMPLES_TYPE = "mr_damper_msgs/msg/MtsSamples"
CURRENT_TYPE = "mr_damper_msgs/msg/SupplyCurrent"
TEMPERATURE_TYPE = "sensor_msgs/msg/Temperature"


class BagError(ValueError):
    """A bag that cannot be read or written; the message says what to change."""


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


class OpenBag:
    """A bag that is open; failures of the library become sentences."""

    def __init__(self, name: str, reader: AnyReader) -> None:
        self.name = name
        self._reader = reader
        custom = reader.readers[0].storage.metadata.custom if reader.is2 else None
        self.details: dict[str, str] = {str(k): str(v) for k, v in (custom or {}).items()}

    def topic(self, wanted: str, message_type: str, *, required: bool = True) -> str:
        """Name of the topic in the bag; empty where it is missing and not required."""
        types = {connection.topic: connection.msgtype for connection in self._reader.connections}
        found = [wanted] if wanted in types else sorted(t for t in types if t.endswith(wanted))
        if len(found) > 1:
            if not required:
                return ""
            raise BagError(
                f"the bag '{self.name}' has several topics that end in {wanted} "
                f"({', '.join(found)}): make a bag of the topics of one rig with ros2 bag convert"
            )
        if found and types[found[0]] == message_type:
            return found[0]
        if not required:
            return ""
        if found:
            raise BagError(
                f"the topic {found[0]} in the bag '{self.name}' carries {types[found[0]]}, "
                f"not {message_type}: record that type, or make a bag of a text or MAT file with "
                "ros2 run mr_damper_ros import_record"
            )
        listed = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(types.items())) or "none"
        raise BagError(
            f"the bag '{self.name}' has no topic {wanted}, in whatever namespace, with "
            f"{message_type}: record it; its topics are {listed}"
        )

    def decoded(self, topics: set[str]) -> Iterator[tuple[str, Any]]:
        """Topic and message of all messages on these topics, in the order of recording."""
        connections = [c for c in self._reader.connections if c.topic in topics]
        with failures_in_words(self.name):
            for connection, _, data in self._reader.messages(connections=connections):
                yield connection.topic, self._reader.deserialize(data, connection.msgtype)


@contextmanager
def opened_bag(path: str | Path, maximum_samples: int = MAXIMUM_SAMPLES) -> Iterator[OpenBag]:
    """Open a bag's folder or its single file; raises BagError, in one sentence.

    Its checksums are checked, and whether it unpacks to more than so many samples need.
    """
    path = Path(path)
    # Under its folder a file comes with the metadata of the bag.
    if (
        path.suffix in (".mcap", ".db3")
        and path.is_file()
        and (path.parent / "metadata.yaml").is_file()
        and len(list(path.parent.glob(f"*{path.suffix}"))) == 1
    ):
        path = path.parent
    name = Path(os.path.abspath(path)).name.removesuffix(".mcap").removesuffix(".db3")
    if not path.exists():
        raise BagError(f"there is no bag at {path}")
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise BagError(
            f"{path} is not a bag: give the folder that holds metadata.yaml, or the .mcap file"
        )
    if path.is_file() and path.suffix not in (".mcap", ".db3"):
        raise BagError(
            f"{path} is not a bag: give a bag's folder or its .mcap or .db3 file; "
            "import_record makes a bag from a text, CSV or MAT file"
        )
    check_bag_files(path, maximum_samples)
    with failures_in_words(name):
        reader = AnyReader([path])
        reader.open()
    try:
        if reader.message_count == 0:
            raise BagError(f"the bag '{name}' holds no messages")
        with failures_in_words(name):
            bag = OpenBag(name, reader)
        yield bag
    finally:
        reader.close()
