"""Between messages and arrays, stamps and nanoseconds."""

from __future__ import annotations

import array
import math

import numpy as np
from builtin_interfaces.msg import Time
from mr_damper_msgs.msg import MtsSamples, SupplyCurrent
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import (
    BlockError,
    Moment,
    RigBlock,
    SampleBlock,
    check_live,
    fits_a_stamp,
)

_SECOND = 1_000_000_000


def to_stamp(nanoseconds: int) -> Time:
    """A stamp from nanoseconds since the epoch; raises ValueError where a stamp cannot hold it."""
    stamp = Time()
    set_stamp(stamp, nanoseconds)
    return stamp


def set_stamp(stamp: Time, nanoseconds: int) -> None:
    """Set a stamp to nanoseconds since the epoch; ValueError as for :func:`to_stamp`."""
    if not fits_a_stamp(nanoseconds):
        raise ValueError(f"{nanoseconds} ns is not a time that a stamp can hold")
    stamp.sec, stamp.nanosec = divmod(nanoseconds, _SECOND)


def to_nanoseconds(stamp: Time) -> int:
    """Nanoseconds since the epoch from a stamp."""
    return int(stamp.sec) * _SECOND + int(stamp.nanosec)


def header(nanoseconds: int, frame_id: str) -> Header:
    """A header with this stamp."""
    return Header(stamp=to_stamp(nanoseconds), frame_id=frame_id)


def to_field(values: Array) -> array.array[float]:
    """A value for a ``float64[]`` field; about 200 times faster than assigning the ndarray."""
    return array.array("d", np.ascontiguousarray(values, dtype=np.float64).tobytes())


def from_field(field: array.array[float]) -> Array:
    """The values of a ``float64[]`` field, without copying; read-only use is expected."""
    return np.frombuffer(field, dtype=np.float64)


def samples_message(block: SampleBlock | RigBlock, frame_id: str) -> MtsSamples:
    """The message of a block, whatever a rig's instruments say."""
    return MtsSamples(
        header=header(block.start_ns, frame_id),
        seq=block.sequence,
        period=block.period,
        displacement=to_field(block.displacement),
        force=to_field(block.force),
    )


def sample_block(message: MtsSamples) -> SampleBlock:
    """The block in a message; raises BlockError, with a sentence, where it cannot be used."""
    block = SampleBlock(
        start_ns=to_nanoseconds(message.header.stamp),
        sequence=message.seq,
        period=message.period,
        displacement=from_field(message.displacement),
        force=from_field(message.force),
    )
    check_live(block)
    if not fits_a_stamp(block.end_ns):
        raise BlockError(
            "the block ends after the last time that a stamp can hold, in January 2038: is the "
            "clock of its source right?"
        )
    return block


def current_message(stamp_ns: int, current: float, frame_id: str) -> SupplyCurrent:
    """The message of one value of the supply current [A]."""
    return SupplyCurrent(header=header(stamp_ns, frame_id), current=current)


SUSPENSION_TOPIC = "suspension/motion"

BODY, WHEEL, SUSPENSION, TYRE = "body", "wheel", "suspension", "tyre"
"""Joints of the state that tells how a suspension moves."""


def suspension_message(now: Moment, stamped: Header) -> JointState:
    """The motion of a suspension as the state of its joints; NaN where one has no such value."""
    return JointState(
        header=stamped,
        name=[BODY, WHEEL, SUSPENSION, TYRE],
        position=[math.nan, math.nan, now.apart, now.tyre],
        velocity=[now.body, now.wheel, now.extension, math.nan],
    )


def suspension_moment(message: JointState, acceleration: float) -> Moment:
    """What a message says of a suspension, whose body has this acceleration [m/s²].

    Raises ValueError, in a sentence, where body or wheel have no velocity.
    """
    velocity = dict(zip(message.name, message.velocity, strict=False))
    position = dict(zip(message.name, message.position, strict=False))
    missing = [name for name in (BODY, WHEEL) if not math.isfinite(velocity.get(name, math.nan))]
    if missing:
        raise ValueError(f"the motion has no velocity of the joint {' and '.join(missing)}")
    return Moment(
        velocity[BODY],
        velocity[WHEEL],
        acceleration,
        position.get(SUSPENSION, math.nan),
        position.get(TYRE, math.nan),
    )
