"""Faults of the instruments: what they say is not what is there."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np

from mr_damper_ros.rig.faults.fault import CHANNELS, Fault
from mr_damper_ros.rig.rig_block import RigBlock
from mr_damper_ros.signals.arrays import Array

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
