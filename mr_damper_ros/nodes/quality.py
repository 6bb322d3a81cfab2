"""Quality of service of the topics, and its overrides by the user.

Each function makes a new profile: rclpy changes a profile in place when it applies an override. By
default, rclpy's profiles are reliable, volatile, and keep the last messages.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

STREAM_DEPTH = 1000
"""Queue length of a stream: ten seconds at 1 kHz in blocks of ten."""


OVERRIDES = "qos_overrides."
"""Prefix of the parameters that override quality of service."""

_OVERRIDABLE: dict[QoSPolicyKind, tuple[str, ...]] = {
    QoSPolicyKind.RELIABILITY: ("reliable", "best_effort", "system_default"),
    QoSPolicyKind.HISTORY: ("keep_last", "keep_all", "system_default"),
    QoSPolicyKind.DEPTH: (),
}
"""Policies that may be overridden, and their allowed values; a depth is a number."""


_PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
"""If one of them is set, the user has chosen a profile; Fast DDS of Jazzy reads the first."""


def use_profile() -> None:
    """Let Fast DDS read the profile of this package, unless the user has chosen one.

    Fast DDS reads it when the first context of the process is initialised.
    """
    if not any(map(os.environ.get, _PROFILES)):
        with suppress(PackageNotFoundError):
            share = get_package_share_directory("mr_damper_ros")
            os.environ[_PROFILES[0]] = str(Path(share, "config", "fastdds.xml"))


def stream(depth: int = STREAM_DEPTH) -> QoSProfile:
    """Reliable, for a stream of messages; a full queue drops its oldest messages."""
    return QoSProfile(depth=depth)


def newest() -> QoSProfile:
    """Reliable, for a stream of which only the newest messages matter."""
    return stream(10)


def lossless() -> QoSProfile:
    """Reliable, for a subscriber that must receive every message at any rate.

    Also for a service, because the default queue holds ten requests, and further requests are never
    answered. With "keep all" the middleware stops acknowledging once a few thousand messages wait.
    A sender that waits for acknowledgements (:mod:`mr_damper_ros.nodes.pacing`) therefore sends
    exactly as fast as its slowest such subscriber receives.
    """
    return QoSProfile(history=HistoryPolicy.KEEP_ALL)


def latched() -> QoSProfile:
    """Reliable, for a value whose last message is also sent to late subscribers."""
    return QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def publisher(node: Node, kind: type, topic: str, profile: QoSProfile | None = None) -> Publisher:
    """A publisher, by default of a stream, whose quality of service users may override.

    The parameters are ``qos_overrides.<topic>.publisher.<policy>``, given at the start.
    """
    options = QoSOverridingOptions(_OVERRIDABLE)
    return node.create_publisher(kind, topic, profile or stream(), qos_overriding_options=options)


def subscription(
    node: Node,
    kind: type,
    topic: str,
    take: Callable[[Any], None],
    profile: QoSProfile | None = None,
) -> Subscription:
    """A subscription whose quality of service users may override, as for :func:`publisher`."""
    options = QoSOverridingOptions(_OVERRIDABLE)
    return node.create_subscription(
        kind, topic, take, profile or stream(), qos_overriding_options=options
    )


def publishing_nodes(node: Node, topic: str) -> list[str]:
    """Fully qualified name of the node of each publisher of a topic."""
    return sorted(
        f"{found.node_namespace.rstrip('/')}/{found.node_name}"
        for found in node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    )


def objection(name: str, value: object) -> str:
    """Reason why an override of quality of service is invalid, as a sentence; empty if valid.

    rclpy reports invalid overrides in a traceback, or not at all.
    """
    choices = {kind.name.lower(): values for kind, values in _OVERRIDABLE.items()}
    *_, entity, policy = ("", *name.split("."))
    if entity not in ("publisher", "subscription") or policy not in choices:
        return (
            f"{name} is not an override: write {OVERRIDES}<topic>.<publisher or subscription>."
            f"<{', '.join(choices)}>"
        )
    if choices[policy] and str(value).lower() not in choices[policy]:
        return f"{name} must be one of {', '.join(choices[policy])}, not {value!r}"
    if not choices[policy] and (type(value) is not int or value < 1):
        return f"{name} must be an integer of at least 1, not {value!r}"
    return ""
