"""The interface of a source of samples for the bridge. Sources are independent of ROS."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from mr_damper_ros.data_check.findings import Finding
from mr_damper_ros.data_check.stream_watch import StreamWatch
from mr_damper_ros.rig.commander import CurrentCommander, MotionCommander
from mr_damper_ros.settings.option_table import ParameterTable
from mr_damper_ros.signals.blocks import RigBlock


@dataclass(frozen=True)
class StreamSettings:
    """``block_size``: number of samples per block; ``loop``: whether a recording repeats."""

    block_size: int
    loop: bool = False


class SourceState(NamedTuple):
    """State of a source: a ``finding`` (None without a fault), values, and what it is doing."""

    finding: Finding | None
    values: Mapping[str, object]
    doing: str = ""


class Source(ABC):
    """Samples of displacement, force, current and temperature, block by block.

    A source is a class in a module of this folder and an entry in ``SOURCES``. Only :meth:`open`
    imports special libraries, such as the driver of a device. The options of a source are
    parameters of the bridge, with ``prefix`` before their names. ``settings`` is a table of type
    ``options``; the bridge replaces it when an option changes at run time.
    """

    options: ClassVar[type[ParameterTable]]
    """Table of the options; its ``objection`` returns why the source cannot be opened."""

    prefix: ClassVar[str]

    live: ClassVar[bool] = False
    """Whether the samples are measured live and stamped, and sent as they arrive."""

    suspended: ClassVar[bool] = False
    """Whether the damper is in a suspension; the blocks then contain the suspension state."""

    commander: CurrentCommander | None = None
    """Takes commands of the current while the source is open; None if it has no supply."""

    watch: StreamWatch | None = None
    """Watch of a live source, which the bridge tells what it has published."""

    mover: MotionCommander | None = None
    """Takes commands of the motion while the source is open; None if it takes no commands."""

    def __init__(self, settings: Any, stream: StreamSettings) -> None:
        self.settings = settings
        self.stream = stream

    @abstractmethod
    def open(self) -> list[str]:
        """Read the file or connect to the device; returns sentences about it for the log.

        Raises ValueError or OSError, with a sentence that says what to change.
        """

    @abstractmethod
    def blocks(self, start_ns: int) -> Iterator[RigBlock]:
        """Yield the blocks from the beginning; sample 0 has the stamp ``start_ns`` [ns].

        The bridge calls it for an open source each time that streaming starts, and sends each block
        when it is due. A source that waits for a device yields a block without samples about every
        0.1 s, so that streaming can be stopped.
        """

    def state(self) -> SourceState:
        """The state of the open source; the bridge calls this about once a second."""
        return SourceState(None, {})

    @abstractmethod
    def close(self) -> None:
        """Release the file or the device; the source may be opened again."""
