"""Opens bags, after a check of their files."""

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
    """An error in reading or writing a bag; the message says what to change."""


_BYTES_PER_SAMPLE = 100
"""Size [B] of a message with a single sample; blocks need less per sample."""

_LARGEST_METADATA = 10_000_000
"""Largest size of metadata.yaml [B]."""


def check_bag_files(path: Path, maximum_samples: int | None) -> None:
    """Check that the files of a bag are readable and undamaged.

    ``path`` is a folder or a single file. Raises BagError if a file is not a regular file, because
    reading it may never end; if a checksum is wrong; or if the unpacked data exceed the size of
    ``maximum_samples`` (None: no limit).
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
        # The library reports broken links itself, and does not enter folders.
        if entry.exists() and not entry.is_dir():
            yield entry


@contextmanager
def failures_in_words(name: str) -> Iterator[None]:
    """Convert the exceptions of the library to a BagError about the bag ``name``."""
    # For damaged data, the library raises exceptions of many kinds.
    try:
        yield
    except BagError:
        raise
    except Exception as error:
        told = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
        raise BagError(
            f"the bag '{name}' is damaged or incomplete: record it again, or repair it with "
            f"'mcap recover' ({told})"
        ) from error


def _check_mcap(name: str, file: Path, maximum_samples: int | None) -> None:
    limit = None if maximum_samples is None else _BYTES_PER_SAMPLE * maximum_samples
    try:
        check_mcap(file, limit)
    except OversizedError as error:
        raise BagError(
            f"the bag '{name}' is too large: {error}; split it with ros2 bag convert"
        ) from error


class OpenBag:
    """An open bag; exceptions of the library become a BagError."""

    def __init__(self, name: str, reader: AnyReader) -> None:
        self.name = name
        self.reader = reader
        custom = reader.readers[0].storage.metadata.custom if reader.is2 else None
        self.details: dict[str, str] = {str(k): str(v) for k, v in (custom or {}).items()}

    def topic(self, wanted: str, message_type: str, *, required: bool = True) -> str:
        """Name of the topic in the bag, in any namespace.

        Returns an empty string if the topic is missing and not required; otherwise raises BagError.
        """
        types = {connection.topic: connection.msgtype for connection in self.reader.connections}
        found = [wanted] if wanted in types else sorted(t for t in types if t.endswith(wanted))
        if len(found) > 1:
            if not required:
                return ""
            raise BagError(
                f"the bag '{self.name}' has several topics that end in {wanted} "
                f"({', '.join(found)}): make a bag with the topics of one rig by ros2 bag convert"
            )
        if found and types[found[0]] == message_type:
            return found[0]
        if not required:
            return ""
        if found:
            raise BagError(
                f"the topic {found[0]} in the bag '{self.name}' has the type {types[found[0]]}, "
                f"not {message_type}: record that type, or convert a text or MAT file to a bag "
                "with ros2 run mr_damper_ros import_record"
            )
        listed = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(types.items())) or "none"
        raise BagError(
            f"the bag '{self.name}' has no topic {wanted} in any namespace with the type "
            f"{message_type}: record it; the topics of the bag are {listed}"
        )

    def decoded(self, topics: set[str]) -> Iterator[tuple[str, Any]]:
        """Topic and message of all messages on these topics, in recording order."""
        connections = [c for c in self.reader.connections if c.topic in topics]
        with failures_in_words(self.name):
            for connection, _, data in self.reader.messages(connections=connections):
                yield connection.topic, self.reader.deserialize(data, connection.msgtype)


@contextmanager
def opened_bag(
    path: str | Path, maximum_samples: int | None = MAXIMUM_SAMPLES
) -> Iterator[OpenBag]:
    """Open the folder of a bag or its single file.

    Raises BagError if the bag is missing, damaged, empty, or larger than ``maximum_samples`` need
    (None: no limit).
    """
    path = Path(path)
    # The folder of a single file also holds the metadata of the bag.
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
