"""Quality of service of the topics, and that users may override it.

Each function makes a new profile: rclpy changes a profile in place when it applies an override.
"""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

STREAM_DEPTH = 1000
"""Messages that a stream may be behind: ten seconds at 1 kHz in blocks of ten."""


def stream(depth: int = STREAM_DEPTH) -> QoSProfile:
    """A stream of messages of which none should be lost."""
    return QoSProfile(
        reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=depth
    )


def lossless() -> QoSProfile:
    """For a subscriber that must take every message, however fast they come.

    With "keep all" the middleware stops acknowledging once a few thousand messages wait, so that
    a sender which waits for acknowledgements (:mod:`mr_damper_ros.nodes.pacing`) goes exactly as
    fast as its slowest such subscriber.
    """
    return QoSProfile(reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_ALL)


def latched() -> QoSProfile:
    """A value of which late subscribers get the last one."""
    return QoSProfile(
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
        history=HistoryPolicy.KEEP_LAST,
        depth=1,
    )


def overridable() -> QoSOverridingOptions:
    """Lets users set ``qos_overrides.<topic>.<publisher|subscription>.<policy>`` at the start."""
    return QoSOverridingOptions(
        [QoSPolicyKind.RELIABILITY, QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH]
    )
