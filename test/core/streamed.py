"""A source of samples, run as the bridge runs it, until a condition holds."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from waiting import PATIENCE

from mr_damper_ros.rig.sources import SOURCES
from mr_damper_ros.rig.sources.source import Source, StreamSettings
from mr_damper_ros.settings.option_table import build
from mr_damper_ros.signals.blocks import RigBlock

START = 1_700_000_000_000_000_000


def source_of(name: str, block_size: int = 10, **options: Any) -> Source:
    """A source by its name, with the given options."""
    kind = SOURCES[name]
    return kind(build(kind.options, options), StreamSettings(block_size))


class Streamed:
    """The blocks with samples that an open source has produced so far."""

    def __init__(self, name: str, **options: Any) -> None:
        self.source = source_of(name, **options)
        assert self.source.settings.objection() == ""
        self.source.open()
        self._blocks = self.source.blocks(START)
        self.blocks: list[RigBlock] = []
        self._deadline = time.monotonic() + PATIENCE

    def until(self, done: Callable[[], object]) -> None:
        """Take blocks until a condition holds; fails after the deadline."""
        while not done():
            assert time.monotonic() < self._deadline, self.source.state()
            block = next(self._blocks)
            if block.sample_count:
                self.blocks.append(block)

    @property
    def fault(self) -> str:
        found = self.source.state().finding
        return "" if found is None else found.sentence

    @property
    def samples(self) -> int:
        return sum(block.sample_count for block in self.blocks)

    def joined(self, name: str) -> np.ndarray:
        """A channel over all samples, shape (n,)."""
        parts = [getattr(block, name) for block in self.blocks]
        return np.concatenate([np.empty(0), *parts])

    def numbers(self) -> np.ndarray:
        """Numbers of all samples, shape (n,)."""
        parts = [block.sequence + np.arange(block.sample_count) for block in self.blocks]
        return np.concatenate([np.empty(0, dtype=int), *parts])
