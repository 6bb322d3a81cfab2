"""Faults of an emulated rig: in the machine, in the instruments, and on the way."""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np

from mr_damper_ros.emulation.motions import EnvelopedMotion, Excitation, Kinematics, WarpedMotion
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.signals.rig_block import RigBlock

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
    :data:`mr_damper_ros.emulation.faults.KINDS`. It may remember samples: each rig copies
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


_CHANGE = 0.1
"""Time [s] that the machine takes to change its motion."""


class ForceLoss(Fault):
    """The damper has lost oil, or its seal leaks."""

    name = "force_loss"
    meaning = "the damper's force is so many times what it was (a leak)"
    unit = "1"
    usual = 0.5

    def resisted(self, time: Array, motion: Kinematics, force: Array) -> Array:
        """Force [N]."""
        return np.where(self.active(time), self.amount, 1.0) * force


class Wear(Fault):
    """The damper gets weaker, evenly from the beginning to the end, and stays so."""

    name = "wear"
    meaning = "the damper's force changes evenly to so many times what it was, and stays there"
    unit = "1"
    usual = 0.7

    def resisted(self, time: Array, motion: Kinematics, force: Array) -> Array:
        """Force [N]."""
        if math.isinf(self.end):
            return force
        return np.interp(time, (self.begin, self.end), (1.0, self.amount)) * force


class Friction(Fault):
    """Something rubs."""

    name = "friction"
    meaning = "so much dry friction besides the damper"
    unit = "N"
    usual = 200.0
    _SLOW = 1e-3

    def resisted(self, time: Array, motion: Kinematics, force: Array) -> Array:
        """Force [N]."""
        rubbing = self.amount * np.tanh(motion.velocity / self._SLOW)
        return force + np.where(self.active(time), rubbing, 0.0)


class Spring(Fault):
    """Something elastic got in between."""

    name = "spring"
    meaning = "a spring of so much stiffness beside the damper"
    unit = "N/m"
    usual = 1e5

    def resisted(self, time: Array, motion: Kinematics, force: Array) -> Array:
        """Force [N]."""
        return force + np.where(self.active(time), self.amount * motion.displacement, 0.0)


class EndStop(Fault):
    """The piston hits the end of its stroke."""

    name = "end_stop"
    meaning = "beyond this displacement to either side a stop of 1 kN/mm"
    unit = "m"
    usual = 0.004
    least = 0.0
    _STIFFNESS = 1e6

    def resisted(self, time: Array, motion: Kinematics, force: Array) -> Array:
        """Force [N]."""
        u = motion.displacement
        beyond = u - np.clip(u, -self.amount, self.amount)
        return force + np.where(self.active(time), self._STIFFNESS * beyond, 0.0)


class Backlash(Fault):
    """The clevis has play: after each reversal the rod follows only when that is used up."""

    name = "backlash"
    meaning = "so much play between machine and rod: no force until it is used up"
    unit = "m"
    usual = 0.5e-3
    least = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._rod = math.nan

    def resisted(self, time: Array, motion: Kinematics, force: Array) -> Array:
        """Force [N]."""
        there = self.active(time)
        if not there.any():
            return force
        result = force.copy()
        half = 0.5 * self.amount
        for place in np.flatnonzero(there):
            u = float(motion.displacement[place])
            rod = u if math.isnan(self._rod) else min(max(self._rod, u - half), u + half)
            if rod == self._rod:
                result[place] = 0.0
            self._rod = rod
        return result


class CoilFactor(Fault):
    """The coil gets another current than the supply reports: a short, a broken wire."""

    name = "coil_factor"
    meaning = "the coil gets so many times the current that the supply reports (0: a broken wire)"
    unit = "1"
    usual = 0.0

    def energised(self, time: Array, current: Array) -> Array:
        """Current [A] in the coil."""
        return np.where(self.active(time), self.amount, 1.0) * current


class CoilOffset(Fault):
    """The coil gets more than the supply reports."""

    name = "coil_offset"
    meaning = "the coil gets so much more current than the supply reports"
    unit = "A"
    usual = 0.1

    def energised(self, time: Array, current: Array) -> Array:
        """Current [A] in the coil."""
        return current + np.where(self.active(time), self.amount, 0.0)


class Amplitude(Fault):
    """The machine moves by another amplitude."""

    name = "amplitude"
    meaning = "the motion is so many times what it was"
    unit = "1"
    usual = 0.1

    def moved(self, excitation: Excitation) -> Excitation:
        """The motion made larger or smaller, smoothly within a tenth of a second."""
        return EnvelopedMotion(excitation, self.amount, self.begin, self.end, _CHANGE)


class Tempo(Fault):
    """The machine moves faster or slower, or stands still where it is."""

    name = "tempo"
    meaning = "the motion goes on so many times as fast; 0: the machine stands still"
    unit = "1"
    usual = 0.0
    least = 0.0

    def moved(self, excitation: Excitation) -> Excitation:
        """The motion faster or slower, smoothly within a tenth of a second."""
        return WarpedMotion(excitation, self.amount, self.begin, self.end, _CHANGE)


_OUTAGE = 0.02
"""Length [s] of one of several short outages."""

_SPIKES = 5.0
"""Spikes per second."""

_MAINS = 50.0
"""Frequency [Hz] of the hum."""


class SensorFault(Fault):
    """A fault of one instrument, of any of the channels."""

    channels = CHANNELS


class Gain(SensorFault):
    """The instrument shows so many times what is there."""

    name = "gain"
    meaning = "so many times the right value; -1 reverses the sign, 0 is a lost signal"
    unit = "1"
    usual = 10.0

    def measured(self, time: Array, values: Array, period: float) -> Array:
        """What the instrument says."""
        return np.where(self.active(time), self.amount, 1.0) * values


class Offset(SensorFault):
    """The zero of the instrument has jumped."""

    name = "offset"
    meaning = "so much more than the right value"
    unit = "channel"

    def measured(self, time: Array, values: Array, period: float) -> Array:
        """What the instrument says."""
        return values + np.where(self.active(time), self.amount, 0.0)


class Creep(SensorFault):
    """The zero of the instrument creeps away."""

    name = "creep"
    meaning = "the zero moves by so much a second"
    unit = "channel/s"

    def measured(self, time: Array, values: Array, period: float) -> Array:
        """What the instrument says."""
        return values + self.amount * np.where(self.active(time), time - self.begin, 0.0)


class Stuck(SensorFault):
    """The instrument keeps showing what it showed when it broke."""

    name = "stuck"
    meaning = "the last value before the beginning, again and again"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._last = 0.0

    def measured(self, time: Array, values: Array, period: float) -> Array:
        """What the instrument says."""
        there = self.active(time)
        before = values[~there & (time < self.begin)]
        if before.size:
            self._last = float(before[-1])
        return np.where(there, self._last, values)


class Dropouts(SensorFault):
    """A loose contact."""

    name = "dropouts"
    meaning = "so many times a second, at random, zero for 20 ms"
    unit = "1/s"
    usual = 2.0
    least = 0.0
    _INSTEAD = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._until = -math.inf

    def measured(self, time: Array, values: Array, period: float) -> Array:
        """What the instrument says."""
        begins = self.active(time) & (self.rng.random(time.size) < self.amount * period)
        since = np.where(begins, time, -math.inf)
        until = np.maximum.accumulate(np.maximum(since + _OUTAGE, self._until))
        self._until = float(until[-1])
        return np.where(time < until, self._INSTEAD, values)


class NotNumbers(Dropouts):
    """The converter has no value to give."""

    name = "nan"
    meaning = "so many times a second, at random, no number for 20 ms"
    _INSTEAD = math.nan


class Missing(SensorFault):
    """The instrument is off."""

    name = "missing"
    meaning = "no number at all; a current or a temperature is then not published"

    def measured(self, time: Array, values: Array, period: float) -> Array:
        """What the instrument says."""
        return np.where(self.active(time), math.nan, values)


class Spikes(SensorFault):
    """Disturbances by a switch or a radio."""

    name = "spikes"
    meaning = "five times a second, at random, one sample is off by so much to either side"
    unit = "channel"

    def measured(self, time: Array, values: Array, period: float) -> Array:
        """What the instrument says."""
        drawn = self.rng.random((2, time.size))
        hit = self.active(time) & (drawn[0] < _SPIKES * period)
        return values + np.where(hit, self.amount * np.sign(drawn[1] - 0.5), 0.0)


class Noise(SensorFault):
    """More noise than there was."""

    name = "noise"
    meaning = "white noise of this standard deviation besides"
    unit = "channel"
    least = 0.0

    def measured(self, time: Array, values: Array, period: float) -> Array:
        """What the instrument says."""
        noise = self.rng.standard_normal(time.size)
        return values + np.where(self.active(time), self.amount * noise, 0.0)


class Hum(SensorFault):
    """The mains are heard."""

    name = "hum"
    meaning = "a sine of 50 Hz and this amplitude besides"
    unit = "channel"

    def measured(self, time: Array, values: Array, period: float) -> Array:
        """What the instrument says."""
        sine = np.sin(2.0 * np.pi * _MAINS * time)
        return values + np.where(self.active(time), self.amount * sine, 0.0)


class Clip(SensorFault):
    """The amplifier is at its end."""

    name = "clip"
    meaning = "no value beyond this one, to either side"
    unit = "channel"
    least = 0.0

    def measured(self, time: Array, values: Array, period: float) -> Array:
        """What the instrument says."""
        clipped = np.clip(values, -self.amount, self.amount)
        return np.where(self.active(time), clipped, values)


class Coarse(SensorFault):
    """The converter has lost bits."""

    name = "coarse"
    meaning = "rounded to whole multiples of so much"
    unit = "channel"
    least = 1e-12

    def measured(self, time: Array, values: Array, period: float) -> Array:
        """What the instrument says."""
        rounded = np.round(values / self.amount) * self.amount
        return np.where(self.active(time), rounded, values)


class Delay(SensorFault):
    """The channel comes late, under the stamps of the others."""

    name = "delay"
    meaning = "the value of so long before"
    unit = "s"
    usual = 0.05
    least = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._past: deque[float] = deque()

    def measured(self, time: Array, values: Array, period: float) -> Array:
        """What the instrument says."""
        count = round(self.amount / period)
        known = np.concatenate([self._past, values])
        late = known[np.maximum(np.arange(values.size) + len(self._past) - count, 0)]
        self._past = deque(known[max(known.size - count, 0) :].tolist())
        return np.where(self.active(time), late, values)


class Sluggish(SensorFault):
    """A filter that nobody knows of."""

    name = "sluggish"
    meaning = "a first-order low-pass filter of this time constant"
    unit = "s"
    usual = 0.05
    least = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._filtered = math.nan

    def measured(self, time: Array, values: Array, period: float) -> Array:
        """What the instrument says."""
        result = values.copy()
        part = period / (self.amount + period)
        for place in np.flatnonzero(self.active(time)):
            value = float(values[place])
            if math.isnan(self._filtered):
                self._filtered = value
            self._filtered += part * (value - self._filtered)
            result[place] = self._filtered
        return result


class Swapped(Fault):
    """Two plugs were exchanged."""

    name = "swapped"
    meaning = "the force comes as displacement, in millimetres for kilonewtons, and the reverse"
    _METRES_PER_NEWTON = 1e-6

    def rewired(self, block: RigBlock) -> RigBlock:
        """The block with both exchanged."""
        if not self.concerns(block):
            return block
        return replace(
            block,
            displacement=block.force * self._METRES_PER_NEWTON,
            force=block.displacement / self._METRES_PER_NEWTON,
        )


class Crosstalk(Fault):
    """The current is heard in the load cell."""

    name = "crosstalk"
    meaning = "so much more force for each ampere of the coil"
    unit = "N/A"
    usual = 100.0

    def rewired(self, block: RigBlock) -> RigBlock:
        """The block with what leaks into its force."""
        if not self.concerns(block):
            return block
        return replace(block, force=block.force + self.amount * block.current)


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


KINDS: tuple[type[Fault], ...] = (
    *(ForceLoss, Wear, Friction, Spring, EndStop, Backlash, CoilFactor, CoilOffset),
    *(Amplitude, Tempo),
    *(Gain, Offset, Creep, Stuck, Dropouts, NotNumbers, Missing, Spikes, Noise, Hum, Clip, Coarse),
    *(Delay, Sluggish, Swapped, Crosstalk),
    *(LostBlocks, DoubledBlocks, ReorderedBlocks, LateBlocks, RepeatedBuffer),
    *(StampJitter, ClockJump, ClockDrift, WrongPeriod, RecountedBlocks, SupplyClock),
)
"""Every kind of fault: a new one is a class and an entry here."""

FAULTS: dict[str, tuple[type[Fault], str]] = {
    f"{channel}_{kind.name}" if channel else kind.name: (kind, channel)
    for kind in KINDS
    for channel in kind.channels or ("",)
}
"""Kind and channel by the name in a text, such as ``force_gain``."""

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?"
_TEXT = re.compile(
    rf"(?P<name>[a-z_]+)(?::(?P<value>{_NUMBER}))?"
    rf"(?:@(?P<begin>{_NUMBER})(?:-(?P<end>{_NUMBER}))?)?",
    re.IGNORECASE,
)


def fault_of(text: str, seed: int = 0) -> Fault:
    """The fault of a text ``name[:value][@begin[-end]]``; times in seconds since the start.

    Without a value it has its usual one; without times it is there all the time, without an end
    for ever. Raises FaultError, with one sentence.
    """
    match = _TEXT.fullmatch(text.strip())
    if match is None:
        raise FaultError(
            f"the fault '{text}' cannot be read: give name[:value][@begin[-end]], such as "
            "force_gain:10@20-30"
        )
    name = match["name"].lower()
    if name not in FAULTS:
        raise FaultError(f"the fault '{name}' is unknown: the faults are {', '.join(FAULTS)}")
    kind, channel = FAULTS[name]
    if match["value"] is not None and not kind.unit:
        raise FaultError(f"the fault '{name}' takes no value: remove ':{match['value']}'")
    times = {key: float(match[key]) for key in ("begin", "end") if match[key] is not None}
    value = None if match["value"] is None else float(match["value"])
    return kind(value, channel=channel, seed=seed, **times)


def faults_of(texts: Sequence[str], seed: int = 0) -> list[Fault]:
    """The faults of several texts, each with a seed of its own; raises FaultError."""
    return [fault_of(text, seed=seed + place) for place, text in enumerate(texts)]
