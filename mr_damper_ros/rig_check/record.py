"""Received signals of a rig, kinds of findings, and the skew between force and displacement.

After a reversal, the damper force crosses zero with a delay. One part is the hysteresis, a fraction
of the cycle (v_h is proportional to the peak velocity). The other part is the skew of the channels,
a constant time. Motion at one frequency cannot separate these parts. At several frequencies, the
delay is a linear function of the cycle length, and the skew is its intercept.

A constant lag in the damper itself, as from a compliant mount or fluid, counts as skew.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from mr_damper_ros.kinematics.motion import SavitzkyGolay
from mr_damper_ros.signals.arrays import NORMAL_MEDIAN, Array
from mr_damper_ros.signals.blocks import NANOSECONDS

_BRIDGED = 0.1
"""Longest gap [s] that is interpolated for the check."""


@dataclass(frozen=True, eq=False)
class ReceivedBlock:
    """A block as received; ``arrival_ns`` is a time of a steady clock, -1 if unknown."""

    start_ns: int
    sequence: int
    period: float
    displacement: Array
    force: Array
    arrival_ns: int = -1


@dataclass(eq=False)
class RigRecord:
    """Blocks in the order of arrival, and stamped currents [A]: measured and commanded."""

    blocks: list[ReceivedBlock] = field(default_factory=list)
    measured: list[tuple[int, float]] = field(default_factory=list)
    commanded: list[tuple[int, float]] = field(default_factory=list)
    unusable: int = 0
    """Number of messages without samples or period, or with unequal lengths."""
    saturated: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Number of clipped samples omitted by the source, by channel: first and last report."""

    def left_out(self, channel: str) -> int:
        """Number of clipped samples that the source omitted during the check."""
        first, last = self.saturated.get(channel, (0, 0))
        return max(last - first, 0)

    @property
    def period(self) -> float:
        """The most frequent stated sample period [s]; NaN without blocks."""
        if not self.blocks:
            return math.nan
        return float(np.median([block.period for block in self.blocks]))

    @property
    def sample_count(self) -> int:
        """Number of received samples."""
        return sum(block.force.size for block in self.blocks)

    def stretch(self) -> tuple[Array, Array]:
        """Displacement and force of the longest part without a long gap, each of shape (n,).

        Gaps of up to a tenth of a second are interpolated linearly.
        """
        rows: list[Array] = []
        parts: list[list[Array]] = []
        expected = None
        for block in self.blocks:
            missing = None if expected is None else block.sequence - expected
            expected = block.sequence + block.force.size
            here = np.stack([block.displacement, block.force])
            if missing is None or not 0 <= missing * block.period <= _BRIDGED:
                rows = []
                parts.append(rows)
            elif missing:
                last, place = rows[-1][:, -1:], np.arange(1.0, missing + 1.0) / (missing + 1.0)
                rows.append(last + (here[:, :1] - last) * place)
            rows.append(here)
        joined = [np.concatenate(part, axis=1) for part in parts]
        longest = max(joined, key=lambda part: part.shape[1], default=np.empty((2, 0)))
        return longest[0], longest[1]

    def stamps(self) -> tuple[Array, Array]:
        """Index of the first sample of each block, and its stamp [s] since the first block."""
        first = self.blocks[0].start_ns
        numbers = np.array([block.sequence for block in self.blocks], dtype=np.float64)
        times = np.array([(b.start_ns - first) / NANOSECONDS for b in self.blocks])
        return numbers, times


@dataclass(frozen=True)
class RigFinding:
    """A fault of ``channel`` (empty: of the stream), and its remedy."""

    trouble: Trouble
    sentence: str
    channel: str = ""


class Trouble(Enum):
    """Kinds of findings, with the templates of their sentences."""

    SILENT = (
        "no samples arrive on mts/samples: start the bridge or your driver, and publish reliably"
    )
    UNUSABLE = (
        "{count} messages cannot be used: each needs a period above 0, and as many displacements "
        "as forces"
    )
    NOT_FINITE = "{count} values of the {channel} are not finite"
    STUCK = "the {channel} does not change at all: is its sensor connected?"
    AT_REST = "the {channel} reaches only ±{half:.3g} {unit}: does the machine move?"
    SWAPPED = "the displacement is less smooth than the force: are the two channels exchanged?"
    INVERTED = (
        "the force is not dissipative: reverse the sign of force or displacement; extension and "
        "tension are positive"
    )
    UNIT = "the {channel} reaches ±{half:.3g} {unit}{only}: is it in {other}?"
    OFFSET = (
        "the force is centred on {middle:.3g} N instead of zero: zero the load cell with the rod "
        "free"
    )
    SKEW = (
        "the {late} lags the {early} by {skew:.2f} ± {error:.2f} ms: is the cause a filter, a "
        "multiplexer, or a compliant mount? Set the bridge's force_lateness to {lateness:.5f}"
    )
    NOISE = (
        "the {channel} has {noise:.3g} {unit} of noise ({share:.1%} of its standard deviation): "
        "check shielding, earth and filters"
    )
    HUM = "the {channel} has {size:.3g} {unit} of hum at {mains:g} Hz: check shielding and earth"
    CLIPPED = "the {channel} is clipped{how}: choose a larger range or a smaller motion"
    COARSE = (
        "the {channel} is quantised in steps of {step:.3g} {unit}: choose a smaller range or more "
        "bits"
    )
    SPIKES = (
        "{count} samples of the {channel} are outliers: is there a loose plug or a disturbance?"
    )
    RATE = (
        "by the stamps the sample period is {measured:.4g} ms ({rate:.4g} Hz), but the messages "
        "state {stated:.4g} ms: set the right period in the driver"
    )
    JITTER = (
        "the stamps jitter by {jitter:.2g} ms ({share:.0%} of a period): stamp by the count of the "
        "samples, not by their arrival (doc/time.md)"
    )
    LOST = (
        "{count} samples of {whole} ({share:.2%}) were lost: check the network, send larger "
        "blocks, and use deeper queues"
    )
    REPEATED = "{count} blocks arrived twice or out of order: does only one node publish them?"
    RESTARTED = (
        "count or stamps of the samples jumped {count} times: was the source restarted, or its "
        "clock set, during the check?"
    )
    BURSTS = (
        "the stream paused {count} times for up to {pause:.2g} s and then caught up: check the "
        "network and the load of the sender"
    )
    NO_CURRENT = "no current arrives on supply/current: start the supply or your driver"
    CURRENT = (
        "the measured current deviates by {off:+.3g} A from the command: check the limits of the "
        "supply, its voltage and the wires to the coil"
    )
    CURRENT_CLOCK = (
        "the current is stamped {ahead:.3g} s {direction} than the samples: synchronise the clocks"
    )

    def found(self, channel: str = "", **figures: object) -> RigFinding:
        """The finding of this kind, of a channel or of the stream."""
        return RigFinding(self, self.value.format(channel=channel, **figures), channel)


_FEWEST = 8
"""Smallest number of reversals for the regression."""

_SMOOTHED = 40.0
"""The half-width of the smoothing is the median cycle divided by this."""

_SMALL = 0.25
"""Fraction of the 90 % quantile of the speed that must be reached between two reversals."""

_CROSSING_PART = 0.25
"""Fraction of a cycle around a reversal in which the force must cross zero."""

_CYCLE_RATIO = 1.3
"""Smallest ratio of the longest to the shortest cycle for the regression."""

_OUTLIER = 4.0

_LAW_ERROR = 4e-4
"""Additional standard error [s], because hysteresis is not exactly a fraction of the cycle. It is
the error of the skew for emulated dampers without skew."""

_PAST_CYCLES, _EQUAL_CYCLES = 4, 0.05
"""Number of past cycles that affect the hysteresis, and their largest relative difference."""


@dataclass(frozen=True)
class ChannelLag:
    """``skew`` [s], its standard error, and the total ``lag`` [s] at a typical reversal."""

    skew: float = math.nan
    standard_error: float = math.inf
    lag: float = math.nan

    @property
    def determined(self) -> bool:
        """Whether the skew is known to half a millisecond."""
        return self.standard_error <= 5e-4


def motion_frequency(displacement: Array, period: float) -> float:
    """Approximate frequency [Hz] of a motion (n,), 0 if it cannot be estimated."""
    coarse = max(round(5e-3 / period), 1)
    means = displacement[: displacement.size // coarse * coarse].reshape(-1, coarse).mean(axis=1)
    if means.size < 3 or np.std(means) == 0.0:
        return 0.0
    velocity = float(np.std(np.diff(means))) / (coarse * period)
    return velocity / (2.0 * math.pi * float(np.std(means)))


def channel_lag(displacement: Array, force: Array, period: float) -> ChannelLag:
    """The lag of the force from samples (n,) at ``period`` [s]; NaN if it cannot be estimated."""
    frequency = motion_frequency(displacement, period)
    half = max(round(1.0 / (_SMOOTHED * frequency * period)), 3) if frequency else 3
    if displacement.size < 8 * half + 4:
        return ChannelLag()
    smooth = SavitzkyGolay(2 * half + 1, 3)
    velocity = smooth.derivative(displacement, 1, period)
    turns, direction = _reversals(velocity, _SMALL * float(np.quantile(np.abs(velocity), 0.9)))
    if turns.size < 2 * _FEWEST:
        return ChannelLag()
    middle = 0.5 * (np.quantile(force, 0.99) + np.quantile(force, 0.01))
    zeros, rising = _reversals(smooth.derivative(force - middle), 0.0)
    cycles = turns[2:] - turns[:-2]
    lags = np.full(cycles.size, math.nan)
    for k, (turn, cycle) in enumerate(zip(turns[1:-1], cycles, strict=True)):
        # Only crossings in the direction of the motion count.
        near = zeros[(np.abs(zeros - turn) < _CROSSING_PART * cycle) & (rising == direction[k + 1])]
        if near.size:
            lags[k] = np.median(near) - turn
    # An offset of the force shifts alternate reversals in opposite directions.
    pairs = np.stack([lags, cycles], axis=1)[: lags.size // 2 * 2].reshape(-1, 2, 2).mean(axis=1)
    lags, cycles = period * pairs[np.isfinite(pairs[:, 0]) & _steady(pairs[:, 1])].T
    return _line(lags, cycles) if lags.size >= _FEWEST else ChannelLag()


def _reversals(values: Array, least: float) -> tuple[Array, Array]:
    """Interpolated zero crossings [samples] between values above ``least``, and their directions.

    A direction is 1 if the values rise, and -1 if they fall.
    """
    large = np.flatnonzero(np.abs(values) > least)
    change = np.flatnonzero(np.diff(np.sign(values[large])))
    before, after = large[change], large[change + 1]
    steps = values[after] - values[before]
    return before - (after - before) * values[before] / steps, np.sign(steps)


def _steady(cycles: Array) -> np.ndarray:
    """Mask (n,) of the cycles that follow several equal cycles.

    The hysteresis depends on the peak velocity of the previous cycles, not on the present one.
    """
    steady = np.ones(cycles.size, dtype=bool)
    for back in range(1, _PAST_CYCLES + 1):
        steady[:back] = False
        steady[back:] &= np.abs(cycles[back:] / cycles[:-back] - 1.0) < _EQUAL_CYCLES
    return steady


def _line(lags: Array, cycles: Array) -> ChannelLag:
    """Regression of the lags (n,) on the cycle lengths (n,) [s]; errors grow with length."""
    unknown = ChannelLag(lag=float(np.median(lags)))
    if np.quantile(cycles, 0.9) < _CYCLE_RATIO * np.quantile(cycles, 0.1):
        return unknown
    columns = np.stack([1.0 / cycles, np.ones(cycles.size)], axis=1)
    parts = lags / cycles
    kept = np.ones(parts.size, dtype=bool)
    for _ in range(3):
        weights = np.linalg.lstsq(columns[kept], parts[kept], rcond=None)[0]
        rest = parts - columns @ weights
        kept = np.abs(rest) <= _OUTLIER * max(float(np.median(np.abs(rest))) / NORMAL_MEDIAN, 1e-6)
        if np.count_nonzero(kept) < _FEWEST:
            return unknown
    variance = float(np.sum(rest[kept] ** 2)) / (np.count_nonzero(kept) - 2)
    covariance = variance * np.linalg.inv(columns[kept].T @ columns[kept])
    error = math.sqrt(float(covariance[0, 0]) + _LAW_ERROR**2)
    return ChannelLag(float(weights[0]), error, unknown.lag)
