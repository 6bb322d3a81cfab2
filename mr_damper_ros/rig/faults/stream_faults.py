"""Faults on the way: blocks are lost, late, doubled, or stamped wrongly."""

from __future__ import annotations

from dataclasses import replace

from mr_damper_ros.rig.faults.fault import Fault
from mr_damper_ros.rig.rig_block import RigBlock
from mr_damper_ros.signals.blocks import NANOSECONDS


class LostBlocks(Fault):
    """The network loses some."""

    name = "lost_blocks"
    meaning = "this part of the blocks, at random, never comes; 1: an outage"
    unit = "1"
    usual = 0.05
    least = 0.0

    def delivered(self, blocks: list[RigBlock]) -> list[RigBlock]:
        """The blocks that come."""
        return [b for b in blocks if self.rng.random() >= self.amount or not self.concerns(b)]


class DoubledBlocks(Fault):
    """The network sends some twice."""

    name = "doubled_blocks"
    meaning = "this part of the blocks, at random, comes twice"
    unit = "1"
    usual = 0.1
    least = 0.0

    def delivered(self, blocks: list[RigBlock]) -> list[RigBlock]:
        """The blocks that come."""
        result = []
        for block in blocks:
            result.append(block)
            if self.rng.random() < self.amount and self.concerns(block):
                result.append(block)
        return result


class ReorderedBlocks(Fault):
    """Some overtake others."""

    name = "reordered_blocks"
    meaning = "this part of the blocks, at random, comes after the next one"
    unit = "1"
    usual = 0.1
    least = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._held: list[RigBlock] = []

    def delivered(self, blocks: list[RigBlock]) -> list[RigBlock]:
        """The blocks that come now."""
        result = []
        for block in blocks:
            if not self._held and self.rng.random() < self.amount and self.concerns(block):
                self._held = [block]
                continue
            result += [block, *self._held]
            self._held = []
        return result


class LateBlocks(Fault):
    """The network stalls now and then."""

    name = "late_blocks"
    meaning = "for so long nothing comes, then all at once; again a second later"
    unit = "s"
    usual = 0.3
    least = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._held: list[RigBlock] = []

    def delivered(self, blocks: list[RigBlock]) -> list[RigBlock]:
        """The blocks that come now."""
        result = []
        for block in blocks:
            since = block.sequence * block.period - self.begin
            if self.concerns(block) and since % 1.0 < self.amount:
                self._held.append(block)
                continue
            result += [*self._held, block]
            self._held = []
        return result


class RepeatedBuffer(Fault):
    """The converter's buffer is sent again and again, under new stamps."""

    name = "repeated_buffer"
    meaning = "the samples of the last block before, again and again under new stamps"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._last: RigBlock | None = None

    def rewired(self, block: RigBlock) -> RigBlock:
        """The block with the samples of that one."""
        if not self.concerns(block):
            self._last = block
            return block
        last = self._last
        if last is None or last.sample_count != block.sample_count:
            return block
        return replace(block, displacement=last.displacement, force=last.force)


class StampJitter(Fault):
    """Stamps are those of a busy computer."""

    name = "stamp_jitter"
    meaning = "each block's stamp is off by up to this part of a sample period to either side"
    unit = "1"
    usual = 0.3
    least = 0.0

    def labelled(self, block: RigBlock) -> RigBlock:
        """The block with its stamp."""
        off = self.amount * (2.0 * self.rng.random() - 1.0) * block.period
        return _ahead(block, off)


class ClockJump(Fault):
    """The clock of samples and supply was set."""

    name = "clock_jump"
    meaning = "all stamps are so much later (negative: earlier)"
    unit = "s"
    usual = 60.0

    def labelled(self, block: RigBlock) -> RigBlock:
        """The block with its stamp."""
        return _ahead(block, self.amount)


class ClockDrift(Fault):
    """The clock of the samples is not the one that it was."""

    name = "clock_drift"
    meaning = "the stamps gain so much a second"
    unit = "s/s"
    usual = 1e-4

    def labelled(self, block: RigBlock) -> RigBlock:
        """The block with its stamp."""
        return _ahead(block, self.amount * (block.sequence * block.period - self.begin))


class WrongPeriod(Fault):
    """The stated time between two samples is wrong; stamps are right."""

    name = "wrong_period"
    meaning = "the period is stated as so many times what it is; the stamps are right"
    unit = "1"
    usual = 2.0
    least = 1e-6

    def labelled(self, block: RigBlock) -> RigBlock:
        """The block with its period."""
        return replace(block, period=block.period * self.amount)


class RecountedBlocks(Fault):
    """The source was started again."""

    name = "recount"
    meaning = "the samples are counted from zero again"

    def labelled(self, block: RigBlock) -> RigBlock:
        """The block with its number."""
        return replace(block, sequence=block.sequence - round(self.begin / block.period))


class SupplyClock(Fault):
    """The supply is stamped by another clock."""

    name = "supply_clock"
    meaning = "the stamps of the current are so much later than those of the samples"
    unit = "s"
    usual = 2.0

    def labelled(self, block: RigBlock) -> RigBlock:
        """The block with the lead of the supply's clock."""
        return replace(block, supply_ahead_ns=round(self.amount * NANOSECONDS))


def _ahead(block: RigBlock, seconds: float) -> RigBlock:
    """The block stamped so much later."""
    shift = round(seconds * NANOSECONDS)
    return replace(block, start_ns=block.start_ns + shift, ahead_ns=block.ahead_ns + shift)
