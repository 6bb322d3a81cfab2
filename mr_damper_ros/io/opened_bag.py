"""A bag that is open for reading; whatever the library finds wrong becomes a sentence."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader

from mr_damper_ros.io.bag_files import check_bag_files, failures_in_words
from mr_damper_ros.io.bag_streams import BagError
from mr_damper_ros.io.raw_table import MAXIMUM_SAMPLES


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
