"""Quality of service of the topics, and that users may override it.

Each function makes a new profile: rclpy changes a profile in place when it applies an override.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

STREAM_DEPTH = 1000
"""Messages that a stream may be behind: ten seconds at 1 kHz in blocks of ten."""


OVERRIDES = "qos_overrides."
"""Beginning of the names of the parameters that override quality of service."""

_OVERRIDABLE: dict[QoSPolicyKind, tuple[str, ...]] = {
    QoSPolicyKind.RELIABILITY: ("reliable", "best_effort", "system_default"),
    QoSPolicyKind.HISTORY: ("keep_last", "keep_all", "system_default"),
    QoSPolicyKind.DEPTH: (),
}
"""What may be overridden, and the values that it may have; a depth is a number."""


def stream(depth: int = STREAM_DEPTH) -> QoSProfile:
    """A stream of messages of which none should be lost."""
    return QoSProfile(
        reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=depth
    )


def lossless() -> QoSProfile:
    """For a subscriber that must take every message, however fast they come.

    Also for a service: by default ten requests wait, and those beyond are never answered.
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


def heard(publisher: Publisher) -> bool:
    """Whether anybody subscribes: a message for nobody costs as much as any other."""
    return publisher.get_subscription_count() > 0


def publisher(node: Node, kind: type, topic: str, profile: QoSProfile | None = None) -> Publisher:
    """A publisher, of a stream unless a profile is given, whose quality users may override.

    They set ``qos_overrides.<topic>.publisher.<policy>`` at the start.
    """
    return node.create_publisher(
        kind, topic, profile or stream(), qos_overriding_options=_overridable()
    )


def subscription(
    node: Node,
    kind: type,
    topic: str,
    take: Callable[[Any], None],
    profile: QoSProfile | None = None,
) -> Subscription:
    """A subscription, as :func:`publisher`."""
    return node.create_subscription(
        kind, topic, take, profile or stream(), qos_overriding_options=_overridable()
    )


def publishing_nodes(node: Node, topic: str) -> list[str]:
    """Fully qualified name of the node of each publisher of a topic."""
    return sorted(
        f"{found.node_namespace.rstrip('/')}/{found.node_name}"
        for found in node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    )


def _overridable() -> QoSOverridingOptions:
    return QoSOverridingOptions(list(_OVERRIDABLE))


def objection(name: str, value: object) -> str:
    """Why quality of service cannot be overridden so, in a sentence; empty where it can.

    rclpy tells this in a traceback, or not at all.
    """
    choices = {kind.name.lower(): values for kind, values in _OVERRIDABLE.items()}
    *_, entity, policy = ("", *name.split("."))
    if entity not in ("publisher", "subscription") or policy not in choices:
        return (
            f"{name} overrides nothing: write {OVERRIDES}<topic>.<publisher or subscription>."
            f"<{', '.join(choices)}>"
        )
    if choices[policy] and str(value).lower() not in choices[policy]:
        return f"{name} must be one of {', '.join(choices[policy])}, not {value!r}"
    if not choices[policy] and (type(value) is not int or value < 1):
        return f"{name} must be an integer of at least 1, not {value!r}"
    return ""
