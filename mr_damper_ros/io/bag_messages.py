"""The types of the messages in a bag, and their decoding; needs rosbags, but not ROS."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from mr_damper_ros.io.bag_files import BagError, DamageError
from mr_damper_ros.signals.blocks import NANOSECONDS

SAMPLES = "mr_damper_msgs/msg/MtsSamples"
CURRENT = "mr_damper_msgs/msg/SupplyCurrent"
TEMPERATURE = "sensor_msgs/msg/Temperature"


def _message_folder() -> Path:
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    folders = [Path(prefix) / "share" / "mr_damper_msgs" / "msg" for prefix in prefixes if prefix]
    here = Path(__file__).resolve()
    folders += [here.parent / "msg", here.parents[2] / "msg_defs" / "msg"]  # of a wheel, of a clone
    for folder in folders:
        if (folder / "MtsSamples.msg").is_file():
            return folder
    raise BagError(
        "the message definitions of mr_damper_msgs are not installed: "
        "source the setup file of the workspace that holds mr_damper_msgs"
    )


@lru_cache(maxsize=1)
def known_types() -> Any:
    """The types of ROS 2 Jazzy and of this package."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for path in sorted(_message_folder().glob("*.msg")):
        message_type = f"mr_damper_msgs/msg/{path.stem}"
        store.register(get_types_from_msg(path.read_text(encoding="utf-8"), message_type))
    return store


def _stated_types(connection: Connection) -> dict[str, Any]:
    """The types that the bag defines for a topic, empty if it does not; raises DamageError."""
    kind, text = connection.msgdef
    try:
        if kind is MessageDefinitionFormat.NONE:
            return {}
        if kind is MessageDefinitionFormat.MSG:
            return dict(get_types_from_msg(text, connection.msgtype))
        found: dict[str, Any] = {}
        # Several files of a definition are separated by such lines.
        for part in text.split("=" * 80 + "\n"):
            found.update(get_types_from_idl(part.split("\n", 1)[1] if part[:4] == "IDL:" else part))
        return found
    except Exception:  # the parsers raise exceptions of many kinds
        raise DamageError(f"the definition of {connection.msgtype} cannot be read") from None


def _is_other_version(store: Any, connection: Connection) -> bool:
    kind, digest = connection.msgtype, connection.digest
    return bool(digest and kind in store.fielddefs and digest != store.hash_rihs01(kind))


def decoder(connection: Connection) -> Callable[[bytes], Any]:
    """A function that decodes the messages of a topic, with the definition of the bag or our own.

    It returns :class:`Samples` and :class:`Reading` for the streams of a rig, and raises
    DamageError for a damaged message. Raises DamageError for a damaged definition, and BagError if
    there is none.
    """
    if connection.ext.serialization_format != "cdr":
        raise BagError(
            f"the messages on {connection.topic} are serialised as "
            f"'{connection.ext.serialization_format}', and only cdr is known: convert the bag with "
            "ros2 bag convert"
        )
    store, kind, stated = known_types(), connection.msgtype, _stated_types(connection)
    if stated and any(stated[each] != store.fielddefs.get(each) for each in stated):
        store = get_typestore(Stores.EMPTY)
        store.register(stated)
    elif not stated and _is_other_version(store, connection):
        raise BagError(
            f"the bag holds no definition of {kind}, and was recorded with another version of it: "
            "convert it where it was recorded, with ros2 bag convert"
        )
    if kind not in store.fielddefs:
        raise BagError(
            f"the bag holds no definition of {kind}, the type of {connection.topic}: record it "
            "with ROS 2 Jazzy, or convert it there with ros2 bag convert"
        )
    if store is known_types() and kind in _LAYOUTS:
        return _LAYOUTS[kind]
    converted = _CONVERTED.get(kind, lambda message: message)

    def decode(data: bytes) -> Any:
        try:
            return converted(store.deserialize_cdr(data, kind))
        except AttributeError:
            raise DamageError(f"its definition of {kind} lacks a field") from None
        except Exception:  # the library raises exceptions of many kinds
            raise DamageError(f"a message on {connection.topic} cannot be decoded") from None

    return decode


# ---- the layout of our own messages --------------------------------------------------------------


class Samples(NamedTuple):
    """A block of samples; the numbers are bytes of doubles in the order of this machine."""

    stamp_ns: int
    seq: int
    period: float
    displacement: bytes
    force: bytes


class Reading(NamedTuple):
    """A stamped number."""

    stamp_ns: int
    value: float


_HEAD = {order: struct.Struct(f"{order}iII") for order in "<>"}
_BLOCK = {order: struct.Struct(f"{order}QdI") for order in "<>"}
_COUNT = {order: struct.Struct(f"{order}I") for order in "<>"}
_NUMBER = {order: struct.Struct(f"{order}d") for order in "<>"}

_PADDING = 3
"""Largest number of bytes after a message, which fill its last word."""


def _header(data: bytes) -> tuple[str, int, int]:
    """Byte order, stamp [ns], and position of the next number of eight bytes."""
    if data[0] != 0 or data[1] > 1:
        raise DamageError("a message is not serialised as CDR")
    order = "<" if data[1] else ">"
    seconds, nanoseconds, length = _HEAD[order].unpack_from(data, 4)
    # Numbers are aligned to their size, counted from the fourth byte.
    return order, seconds * NANOSECONDS + nanoseconds, 4 + ((12 + length + 7) & ~7)


def _doubles(data: bytes, order: str, place: int, count: int) -> tuple[bytes, int]:
    """The bytes of ``count`` numbers, and their end."""
    if not count:
        return b"", place
    start = 4 + ((place + 3) & ~7)
    end = start + 8 * count
    numbers = data[start:end]
    if order != _NATIVE:
        numbers = np.frombuffer(numbers, f"{order}f8").astype("=f8").tobytes()
    return numbers, end


_NATIVE = "<" if np.little_endian else ">"


def decoded_samples(data: bytes) -> Samples:
    """Decode a message of samples; raises DamageError."""
    try:
        order, stamp_ns, place = _header(data)
        seq, period, count = _BLOCK[order].unpack_from(data, place)
        displacement, place = _doubles(data, order, place + 20, count)
        (count,) = _COUNT[order].unpack_from(data, place)
        force, place = _doubles(data, order, place + 4, count)
    except (struct.error, IndexError, ValueError):
        raise DamageError("a message is too short") from None
    if not 0 <= len(data) - place <= _PADDING:
        raise DamageError("the length of a message is wrong")
    return Samples(stamp_ns, seq, period, displacement, force)


def _decoded_reading(data: bytes, numbers: int) -> Reading:
    """Decode a message of a header and ``numbers`` numbers, the first of which is the value."""
    try:
        order, stamp_ns, place = _header(data)
        (value,) = _NUMBER[order].unpack_from(data, place)
    except (struct.error, IndexError):
        raise DamageError("a message is too short") from None
    if not 0 <= len(data) - place - 8 * numbers <= _PADDING:
        raise DamageError("the length of a message is wrong")
    return Reading(stamp_ns, value)


_LAYOUTS: dict[str, Callable[[bytes], Any]] = {
    SAMPLES: decoded_samples,
    CURRENT: lambda data: _decoded_reading(data, 1),
    TEMPERATURE: lambda data: _decoded_reading(data, 2),
}

_CONVERTED: dict[str, Callable[[Any], Any]] = {
    SAMPLES: lambda m: Samples(
        stamp_of(m), int(m.seq), float(m.period), _bytes(m.displacement), _bytes(m.force)
    ),
    CURRENT: lambda m: Reading(stamp_of(m), float(m.current)),
    TEMPERATURE: lambda m: Reading(stamp_of(m), float(m.temperature)),
}


def _bytes(numbers: Any) -> bytes:
    return np.asarray(numbers, dtype=np.float64).tobytes()


def stamp_of(message: Any) -> int:
    """The stamp of a decoded message [ns]."""
    stamp = message.header.stamp
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)
