"""A recorded bag as a source."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from mr_damper_ros.rig.rig_block import RigBlock
from mr_damper_ros.rig.sources.recorded_blocks import checked, recorded_blocks
from mr_damper_ros.rig.sources.source import Source, StreamSettings
from mr_damper_ros.settings.option_table import ParameterTable, option
from mr_damper_ros.signals.recording import Recording


@dataclass(frozen=True)
class BagOptions(ParameterTable):
    """The bag of ``source: bag``."""

    bag: str = option(
        "", "Path of the bag of source: bag, a folder or a single file.", read_only=True
    )

    def objection(self) -> str:
        """Say that the path is missing."""
        if not self.bag:
            return "source is bag, but no bag is given: set the parameter bag to the path of one"
        return ""


class BagSource(Source):
    """The recordings in a bag, one after the other."""

    options = BagOptions
    prefix = ""

    def __init__(self, settings: BagOptions, stream: StreamSettings) -> None:
        super().__init__(settings, stream)
        self._recordings: Sequence[Recording] = ()

    def open(self) -> list[str]:
        """Read the bag."""
        from mr_damper_ros.io.bag_reader import read_bag

        self._recordings = read_bag(self.settings.bag)
        return checked(self._recordings)

    def blocks(self, start_ns: int) -> Iterator[RigBlock]:
        """The samples of all recordings."""
        return recorded_blocks(self._recordings, self.stream, start_ns)

    def close(self) -> None:
        """Forget the recordings."""
        self._recordings = ()
