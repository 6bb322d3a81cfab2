"""Samples one by one become blocks without a gap in them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mr_damper_ros.rig.rig_block import RigBlock

_LARGEST = 1e9
"""No press moves so many metres or pulls so many newtons."""


class Measured(NamedTuple):
    """What was measured at one time [m, N, A, °C]; NaN where there is no such channel."""

    displacement: float
    force: float
    current: float = math.nan
    temperature: float = math.nan

    @property
    def possible(self) -> bool:
        """Whether displacement and force are numbers, and such as there can be."""
        return abs(self.displacement) < _LARGEST and abs(self.force) < _LARGEST


class BlockMaker:
    """Cuts blocks of ``size`` samples; shorter ones end where a sample is missing."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._first = (0, 0, 1.0)
        self._begun: list[Measured] = []
        self._made: list[RigBlock] = []
        self.last_ns = 0
        """Stamp of the last sample."""

    def add(self, index: int, stamp_ns: int, period: float, measured: Measured) -> None:
        """Take in a sample by its number, its stamp [ns] and the time [s] to the next."""
        first, _, begun_period = self._first
        if self._begun and (index != first + len(self._begun) or period != begun_period):
            self.cut()
        if not self._begun:
            self._first = (index, stamp_ns, period)
        self._begun.append(measured)
        self.last_ns = stamp_ns
        if len(self._begun) == self._size:
            self.cut()

    def cut(self) -> None:
        """What has begun is a block now."""
        if not self._begun:
            return
        displacement, force, current, temperature = np.array(self._begun, dtype=np.float64).T.copy()
        index, start_ns, period = self._first
        self._begun = []
        self._made.append(
            RigBlock(start_ns, index, period, displacement, force, current, temperature)
        )

    def take(self) -> list[RigBlock]:
        """The blocks that are ready; one without samples where none is."""
        made, self._made = self._made, []
        if made:
            return made
        none = np.empty(0)
        return [RigBlock(self.last_ns, 0, 1.0, none, none, none, none)]
