"""What the bridge asks of a source of samples. Nothing here, and in no source, knows ROS."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from mr_damper_ros.rig.commander import CurrentCommander, MotionCommander
from mr_damper_ros.settings.option_table import ParameterTable
from mr_damper_ros.signals.blocks import RigBlock


@dataclass(frozen=True)
class StreamSettings:
    """``block_size`` samples come in a block; a recording begins again at its end to ``loop``."""

    block_size: int
    loop: bool = False


class SourceState(NamedTuple):
    """How a live source is: what is wrong with it, in a sentence (empty: nothing), and figures."""

    fault: str
    values: Mapping[str, object]


class Source(ABC):
    """Samples of displacement, force, current and temperature, block by block.

    A source is a class in a file of this folder and a line in ``SOURCES``. What only it needs,
    such as the library of a device, is imported in :meth:`open`. Its options are those of the
    bridge, with ``prefix`` before their names.

    ``settings`` is a table of type ``options``; the bridge puts another one in its place when an
    option changes while it runs.
    """

    options: ClassVar[type[ParameterTable]]
    """Its options; ``objection`` of the table says what the source lacks to be opened."""

    prefix: ClassVar[str]

    live: ClassVar[bool] = False
    """Whether the samples are measured right now, and stamped: they are sent as they come."""

    suspended: ClassVar[bool] = False
    """Whether its damper is in a suspension, whose motion the blocks tell too."""

    commander: CurrentCommander | None = None
    """Takes commands of the current, in a source that has a supply of its own, while it is open."""

    mover: MotionCommander | None = None
    """Takes commands of the motion, in a source that moves as it is told, while it is open."""

    def __init__(self, settings: Any, stream: StreamSettings) -> None:
        self.settings = settings
        self.stream = stream

    @abstractmethod
    def open(self) -> list[str]:
        """Read the file, connect to the device. Returns what was found, in sentences for a log.

        Raises ValueError or OSError, with a sentence that says what to change.
        """

    @abstractmethod
    def blocks(self, start_ns: int) -> Iterator[RigBlock]:
        """The blocks from the beginning, sample 0 stamped ``start_ns`` [ns], until there are none.

        Called each time that streaming starts, in an open source. The bridge holds back a block
        whose time has not come. A source that has to wait for a device gives a block without
        samples every tenth of a second or so, so that streaming can be ended meanwhile.
        """

    def state(self) -> SourceState:
        """How it is, about once a second, while it is open."""
        return SourceState("", {})

    @abstractmethod
    def close(self) -> None:
        """Let the file or the device go; it may be opened again."""
