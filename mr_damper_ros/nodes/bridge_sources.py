"""The sources of samples that a bridge has: those of the package, topics, and others' own.

Another package adds a source by an entry point of the group ``mr_damper_ros.sources``: its name is
the one that the parameter ``source`` then takes, and it leads to a subclass of
:class:`mr_damper_ros.rig.sources.source.Source`.
"""

from __future__ import annotations

import sys
from importlib.metadata import entry_points
from typing import Any

from rclpy.node import Node

from mr_damper_ros.nodes.topic_source import TopicSource
from mr_damper_ros.rig.sources import SOURCES
from mr_damper_ros.rig.sources.source import Source, StreamSettings

GROUP = "mr_damper_ros.sources"


def _others() -> dict[str, type[Source]]:
    """The sources of other packages; one that cannot be loaded is told, and is not there."""
    found: dict[str, type[Source]] = {}
    for point in entry_points(group=GROUP):
        try:
            kind = point.load()
        except Exception as error:  # another's package: the bridge works without it
            print(f"the source {point.name} cannot be loaded: {error}", file=sys.stderr)
            continue
        if not (isinstance(kind, type) and issubclass(kind, Source)):
            print(f"the source {point.name} is no Source: {point.value}", file=sys.stderr)
            continue
        found[point.name] = kind
    return found


ALL_SOURCES: dict[str, type[Source]] = {**SOURCES, "topics": TopicSource, **_others()}
"""By the name that the parameter ``source`` has for each."""


def source_of(name: str, settings: Any, stream: StreamSettings, node: Node) -> Source:
    """The source of a name, for a bridge."""
    kind = ALL_SOURCES[name]
    if issubclass(kind, TopicSource):
        return kind(settings, stream, node)
    return kind(settings, stream)
