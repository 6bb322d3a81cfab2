"""What every fault of an emulated rig has, and where it can act."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np

from mr_damper_ros.rig.excitation import Excitation, Kinematics
from mr_damper_ros.rig.rig_block import RigBlock
from mr_damper_ros.signals.arrays import Array

CHANNELS = ("displacement", "force", "current", "temperature")
"""What a rig measures, as :class:`RigBlock` names it."""

_ROUNDING = 1e-9
"""A sample that falls on the beginning already has the fault, whatever the rounding [s]."""


class FaultError(ValueError):
    """A fault that cannot be had; the message says what to change."""


@dataclass(eq=False)
class Fault:
    """Something that is wrong from ``begin`` to ``end`` [s] since the rig started.

    ``channel`` is the one of ``channels`` that it affects, empty for a fault that has none.
    ``value`` says how much, in the unit that ``unit`` names; None stands for ``usual``. A fault is
    a subclass that overrides the one method of where it acts, and a line in
    :data:`mr_damper_ros.rig.faults.fault_text.KINDS`. It may remember samples: each rig copies
    its own.

    Raises FaultError where the channel is none of its own, the value is not finite or out of
    range, or the end is not after the beginning.
    """

    name: ClassVar[str]
    meaning: ClassVar[str]
    """What happens, for the documentation, in a few words."""

    channels: ClassVar[tuple[str, ...]] = ()
    unit: ClassVar[str] = ""
    """Unit of the value; empty for a fault without one, "channel" for that of the channel."""

    usual: ClassVar[float] = 1.0
    least: ClassVar[float] = -math.inf

    value: float | None = None
    begin: float = 0.0
    end: float = math.inf
    channel: str = ""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.channel not in (self.channels or ("",)):
            raise FaultError(
                f"the fault '{self.name}' cannot have the channel '{self.channel}': it has "
                + (" or ".join(self.channels) or "none")
            )
        if self.value is None:
            self.value = self.usual
        if not (math.isfinite(self.value) and self.value >= self.least):
            raise FaultError(
                f"the value of the fault '{self.name}' is {self.value}: it must be finite"
                + ("" if math.isinf(self.least) else f" and at least {self.least:g}")
            )
        if not 0.0 <= self.begin < self.end:
            raise FaultError(
                f"the fault '{self.name}' is from {self.begin:g} to {self.end:g} s: it must begin "
                "at 0 or later, and end after that"
            )
        self.rng = np.random.default_rng(self.seed)

    @property
    def amount(self) -> float:
        """The value."""
        assert self.value is not None
        return self.value

    def active(self, time: Array) -> np.ndarray:
        """Mask (n,) of the times [s] at which it is there."""
        return np.asarray((time >= self.begin - _ROUNDING) & (time < self.end - _ROUNDING))

    def concerns(self, block: RigBlock) -> bool:
        """Whether it is there at the first sample of a block that is not yet labelled."""
        return bool(self.active(np.array([block.sequence * block.period]))[0])

    # --- in the machine ------------------------------------------------------------------------

    def moved(self, excitation: Excitation) -> Excitation:
        """The motion that the machine makes instead."""
        return excitation

    def energised(self, time: Array, current: Array) -> Array:
        """Current [A] in the coil, shape (n,), where the supply says ``current``."""
        return current

    def resisted(self, time: Array, motion: Kinematics, force: Array) -> Array:
        """Force [N] between rod and load cell, shape (n,), where the damper's is ``force``."""
        return force

    # --- in the instruments --------------------------------------------------------------------

    def measured(self, time: Array, values: Array, period: float) -> Array:
        """What the instrument of the channel says, shape (n,), where it should say ``values``.

        Samples are ``period`` [s] apart.
        """
        return values

    def rewired(self, block: RigBlock) -> RigBlock:
        """What a block holds instead, where the fault concerns more than one channel."""
        return block

    # --- on the way ----------------------------------------------------------------------------

    def delivered(self, blocks: list[RigBlock]) -> list[RigBlock]:
        """The blocks that are sent now, where these should be."""
        return blocks

    def labelled(self, block: RigBlock) -> RigBlock:
        """The block with the stamp, the period and the number that it is sent with."""
        return block


class Delivery(NamedTuple):
    """A block as it is sent, and the number of its first sample in the rig's own count."""

    block: RigBlock
    first: int


class Instruments:
    """What measures a rig and sends the samples, with its faults in the order given."""

    def __init__(self, faults: Sequence[Fault] = ()) -> None:
        self._faults = deepcopy(list(faults))

    def read(self, block: RigBlock) -> list[Delivery]:
        """What is sent once the rig has made a block: none, or one, or several."""
        time = (block.sequence + np.arange(block.sample_count, dtype=np.float64)) * block.period
        for fault in self._faults:
            if fault.channel in CHANNELS:
                right: Array = getattr(block, fault.channel)
                said: dict[str, Any] = {fault.channel: fault.measured(time, right, block.period)}
                block = replace(block, **said)
            block = fault.rewired(block)
        blocks = [block]
        for fault in self._faults:
            blocks = fault.delivered(blocks)
        deliveries = []
        for made in blocks:
            sent = made
            for fault in self._faults:
                if fault.concerns(made):
                    sent = fault.labelled(sent)
            deliveries.append(Delivery(sent, made.sequence))
        return deliveries
