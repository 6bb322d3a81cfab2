"""Checks of the signals of a rig: findings in words, and a recommended first motion."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from mr_damper_ros.kinematics.motion import SavitzkyGolay
from mr_damper_ros.signals.arrays import NORMAL_MEDIAN, Array, white_noise
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.screening import clipped_at

_BRIDGED = 0.1
"""Longest gap [s] that is interpolated for the check."""


@dataclass(frozen=True, eq=False)
class ReceivedBlock:
    """A block as received; ``arrival_ns`` is a time of a steady clock."""

    start_ns: int
    sequence: int
    period: float
    displacement: Array
    force: Array
    arrival_ns: int


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

    @property
    def period(self) -> float:
        """The median of the stated sample periods [s]; NaN without blocks."""
        return float(np.median([block.period for block in self.blocks] or math.nan))

    @property
    def sample_count(self) -> int:
        """Number of received samples."""
        return sum(block.force.size for block in self.blocks)

    def stretch(self) -> tuple[Array, Array]:
        """Displacement and force of the longest part without a long gap, each of shape (n,).

        Gaps of up to a tenth of a second are interpolated linearly.
        """
        numbers = np.concatenate([b.sequence + np.arange(b.force.size) for b in self.blocks])
        missing = np.diff(numbers) - 1
        cuts = np.flatnonzero((missing < 0) | (missing * self.period > _BRIDGED)) + 1
        part = max(np.split(np.arange(numbers.size), cuts), key=len)
        places = numbers[part]
        grid = np.arange(places[0], places[-1] + 1)
        displacement = np.concatenate([block.displacement for block in self.blocks])[part]
        force = np.concatenate([block.force for block in self.blocks])[part]
        return np.interp(grid, places, displacement), np.interp(grid, places, force)


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

_FAR = 4.0

_LAW_ERROR = 4e-4
"""Additional standard error [s], because hysteresis is not exactly a fraction of the cycle. It is
the error of the skew for emulated dampers without skew."""

_PAST_CYCLES, _EQUAL_CYCLES = 4, 0.05
"""Number of past cycles that affect the hysteresis, and their largest relative difference."""


_UNKNOWN = (math.nan, math.inf)


def motion_frequency(displacement: Array, period: float) -> float:
    """Approximate frequency [Hz] of a motion (n,), 0 if it cannot be estimated."""
    coarse = max(round(5e-3 / period), 1)
    means = displacement[: displacement.size // coarse * coarse].reshape(-1, coarse).mean(axis=1)
    if means.size < 3 or np.std(means) == 0.0:
        return 0.0
    velocity = float(np.std(np.diff(means))) / (coarse * period)
    return velocity / (2.0 * math.pi * float(np.std(means)))


def channel_skew(displacement: Array, force: Array, period: float) -> tuple[float, float]:
    """How much later than the displacement (n,) the force (n,) is measured [s], and the error [s].

    After a reversal, the damper force crosses zero with a delay. One part is the hysteresis, a
    fraction of the cycle (v_h is proportional to the peak velocity). The other part is the skew of
    the channels, a constant time. At several frequencies, the delay is a linear function of the
    cycle length, and the skew is its intercept; one frequency cannot separate them. A constant lag
    in the damper itself, as from a compliant mount or fluid, counts as skew. A skew that cannot be
    estimated is NaN, with an infinite standard error.
    """
    frequency = motion_frequency(displacement, period)
    half = max(round(1.0 / (_SMOOTHED * frequency * period)), 3) if frequency else 3
    if displacement.size < 8 * half + 4:
        return _UNKNOWN
    smooth = SavitzkyGolay(2 * half + 1, 3)
    velocity = smooth.derivative(displacement, 1, period)
    turns, direction = _reversals(velocity, _SMALL * float(np.quantile(np.abs(velocity), 0.9)))
    if turns.size < 2 * _FEWEST:
        return _UNKNOWN
    zeros, rising = _reversals(smooth.derivative(force - _extent(force)[0]), 0.0)
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
    return _intercept(lags, cycles) if lags.size >= _FEWEST else _UNKNOWN


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


def _intercept(lags: Array, cycles: Array) -> tuple[float, float]:
    """Lag (n,) at a cycle of length 0 [s], and its standard error; errors grow with length (n,)."""
    if np.quantile(cycles, 0.9) < _CYCLE_RATIO * np.quantile(cycles, 0.1):
        return _UNKNOWN
    rates, parts = 1.0 / cycles, lags / cycles
    kept = np.ones(parts.size, dtype=bool)
    for _ in range(3):
        line, covariance = np.polyfit(rates[kept], parts[kept], 1, cov=True)
        rest = np.abs(parts - np.polyval(line, rates))
        kept = rest <= _FAR * max(float(np.median(rest)) / NORMAL_MEDIAN, 1e-6)
        if np.count_nonzero(kept) < _FEWEST:
            return _UNKNOWN
    return float(line[0]), math.sqrt(float(covariance[0, 0]) + _LAW_ERROR**2)


_COARSE = 0.02
"""Smallest step, in standard deviations of the channel, that counts as coarse quantisation."""

_NOISY = {"displacement": (0.002, 1e-5), "force": (0.03, 10.0)}
"""Limits of white noise, in standard deviations of the channel and in its unit. Noise is excessive
if it exceeds both, because without current the force is small."""

_OUTLIER, _JUMP = 12.0, 0.1
"""An outlier deviates from its neighbours by this multiple of the noise or this part of the range,
whichever is larger."""

_MAINS = (50.0, 60.0)
_MAINS_BAND, _COMPARISON_BAND = 0.5, 6.0
"""Half-widths [Hz] of the band around a mains frequency and of the band for comparison."""

_HARMONICS = 2.2
"""Half-width of the band for comparison, in multiples of the motion frequency. The odd harmonics
are two multiples apart."""

_HUM_RATIO, _HUM_PARTS = 3.0, {"displacement": 1e-3, "force": 5e-3}
"""A spectral line is hum if it exceeds this multiple of its neighbours, and this fraction of the
channel's standard deviation."""


def channel_findings(
    name: str, unit: str, values: Array, period: float, frequency: float
) -> Iterator[RigFinding]:
    """Findings on the values (n,) of a channel; the motion has about this frequency [Hz]."""
    spread, noise = float(np.std(values)), white_noise(values)
    step = coarse_step(values)
    if step:
        yield Trouble.COARSE.found(name, step=step, unit=unit)
    else:
        clipped = [f"{limit:.4g}" for limit in clipped_at(values)]
        if clipped:
            yield Trouble.CLIPPED.found(name, how=f" at {' and '.join(clipped)}")
        part, least = _NOISY[name]
        if noise > max(part * spread, least):
            yield Trouble.NOISE.found(name, noise=noise, unit=unit, share=noise / spread)
    middle = np.median(np.stack([values[:-2], values[1:-1], values[2:]]), axis=0)
    wild = np.abs(values[1:-1] - middle) > max(_OUTLIER * noise, 2.0 * _JUMP * _extent(values)[1])
    if wild.any():
        yield Trouble.SPIKES.found(name, count=np.count_nonzero(wild))
        return
    reach = max(_COMPARISON_BAND, _HARMONICS * frequency)
    for mains in _MAINS:
        amplitude, beside = _line_at(mains, reach, values, period)
        if amplitude > max(_HUM_RATIO * beside, _HUM_PARTS[name] * spread):
            yield Trouble.HUM.found(name, size=amplitude, unit=unit, mains=mains)


def coarse_step(values: Array) -> float:
    """The quantisation step if it is coarse, otherwise 0."""
    steps = np.abs(np.diff(values))
    steps = steps[steps > 1e-9 * float(np.ptp(values))]
    step = float(steps.min()) if steps.size else 0.0
    return step if step > _COARSE * float(np.std(values)) else 0.0


def _line_at(mains: float, reach: float, values: Array, period: float) -> tuple[float, float]:
    """Amplitudes of the lines at and beside the mains frequency; 0 if they are not resolved."""
    if mains + reach > 0.5 / period or values.size * period < 2.0 / _MAINS_BAND:
        return 0.0, 0.0
    weights = np.hanning(values.size)
    lines = np.abs(np.fft.rfft((values - values.mean()) * weights)) * 2.0 / weights.sum()
    away = np.abs(np.fft.rfftfreq(values.size, period) - mains)
    beside = lines[(away > 2.0 * _MAINS_BAND) & (away <= reach)]
    return float(lines[away <= _MAINS_BAND].max()), float(beside.max())


_RATE = 0.003
"""Largest relative error of the sample period that the tolerance of clocks can explain."""

_JITTER = 0.1
"""Tolerated stamp jitter in sample periods (doc/time.md)."""

_PAUSE = 0.1
"""Delay of a block [s] above which the stream counts as paused."""

_COUNT_TOLERANCE = 2.0
"""Tolerated duration [s] of lost samples beyond reported omissions; reports come once a second."""

_CURRENT_OFF, _SETTLING = 0.05, 1.0
"""Tolerated deviation [A] of the measured current from a command older than this time [s]."""

_CURRENT_AHEAD = 0.5
"""Difference [s] between the newest stamps of current and samples above which the clocks differ."""


def stream_findings(record: RigRecord) -> Iterator[RigFinding]:
    """Findings on the blocks of a non-empty record."""
    yield from _count_findings(record)
    first_ns = record.blocks[0].start_ns
    numbers = np.array([block.sequence for block in record.blocks], dtype=np.float64)
    times = np.array([(block.start_ns - first_ns) / NANOSECONDS for block in record.blocks])
    later = np.diff(numbers) > 0
    steps, counts = np.diff(times)[later], np.diff(numbers)[later]
    if counts.size >= 8 and numbers[-1] > numbers[0]:
        period, stated = float(np.median(steps / counts)), record.period
        if abs(period / stated - 1.0) > _RATE:
            yield Trouble.RATE.found(measured=1e3 * period, rate=1.0 / period, stated=1e3 * stated)
        # A line fitted to the whole record would not follow a step of the clock.
        off = steps - period * counts
        jitter = float(np.std(off[np.abs(off) < 1.0])) / math.sqrt(2.0)
        if jitter > _JITTER * period:
            yield Trouble.JITTER.found(jitter=1e3 * jitter, share=jitter / period)
    if len(record.blocks) > 2:
        longest = max(block.force.size * block.period for block in record.blocks)
        pauses = np.diff([block.arrival_ns for block in record.blocks]) / NANOSECONDS
        # A gap in the stamps, or the length of a block, is not a pause.
        held_up = pauses[pauses - np.clip(np.diff(times), longest, None) > _PAUSE]
        if held_up.size > 1:
            yield Trouble.BURSTS.found(count=held_up.size, pause=held_up.max())


def _count_findings(record: RigRecord) -> Iterator[RigFinding]:
    lost = repeated = restarts = 0
    expected, due_ns = record.blocks[0].sequence, record.blocks[0].start_ns
    for block in record.blocks:
        missing, late = block.sequence - expected, (block.start_ns - due_ns) / NANOSECONDS
        end = block.sequence + block.force.size
        if missing < 0 and -1.0 < late <= 0.0 and end <= expected:
            repeated += 1
            continue
        lost += max(missing, 0)
        restarts += missing < 0 or (missing == 0 and abs(late) > 1.0)
        expected = end
        due_ns = block.start_ns + round(block.force.size * block.period * NANOSECONDS)
    if repeated:
        # A block that arrives after its successor was first counted as missing.
        lost = max(lost - repeated * round(np.median([b.force.size for b in record.blocks])), 0)
        yield Trouble.REPEATED.found(count=repeated)
    channels = ("displacement", "force")
    saturated = {name: record.saturated[name] for name in channels if name in record.saturated}
    omitted = {name: last - first for name, (first, last) in saturated.items() if last > first}
    for name, count in omitted.items():
        yield Trouble.CLIPPED.found(name, how=f", and its source omitted {count} samples")
    known = sum(omitted.values())
    if lost and not (known and (lost - known) * record.period < _COUNT_TOLERANCE):
        whole = lost + record.sample_count
        yield Trouble.LOST.found(count=lost, whole=whole, share=lost / whole)
    if restarts:
        yield Trouble.RESTARTED.found(count=restarts)


def current_findings(record: RigRecord) -> Iterator[RigFinding]:
    """Findings on the current."""
    if not record.measured:
        yield Trouble.NO_CURRENT.found("current")
        return
    stamps = np.array([stamp for stamp, _ in record.measured], dtype=np.int64)
    values = np.array([value for _, value in record.measured])
    if not np.isfinite(values).all():
        yield Trouble.NOT_FINITE.found("current", count=np.count_nonzero(~np.isfinite(values)))
        return
    if record.blocks:
        last = record.blocks[-1]
        end_ns = last.start_ns + round(last.force.size * last.period * NANOSECONDS)
        ahead = (int(stamps.max()) - end_ns) / NANOSECONDS
        usual = float(np.median(np.diff(np.sort(stamps)))) / NANOSECONDS if stamps.size > 1 else 0.0
        if abs(ahead) > _CURRENT_AHEAD + 2.0 * usual:
            direction = "later" if ahead > 0.0 else "earlier"
            yield Trouble.CURRENT_CLOCK.found("current", ahead=abs(ahead), direction=direction)
    yield from _command_findings(record, stamps, values)


def _command_findings(
    record: RigRecord, stamps: np.ndarray, values: np.ndarray
) -> Iterator[RigFinding]:
    if not record.commanded:
        return
    told = np.array([stamp for stamp, _ in record.commanded], dtype=np.int64)
    wanted = np.array([value for _, value in record.commanded])
    changed = np.diff(wanted, prepend=np.nan) != 0.0
    since = told[np.maximum.accumulate(np.where(changed, np.arange(told.size), 0))]
    place = np.searchsorted(told, stamps, side="right") - 1
    # Commands must be recent, and unchanged for long enough that the supply has followed.
    fresh = (place >= 0) & (stamps - told[place] < _SETTLING * NANOSECONDS)
    off = (values - wanted[place])[fresh & (stamps - since[place] > _SETTLING * NANOSECONDS)]
    if off.size and float(np.median(np.abs(off))) > _CURRENT_OFF:
        yield Trouble.CURRENT.found("current", off=float(np.median(off)))


_ENOUGH = 200
"""Smallest number of contiguous samples for checks of the channels."""

_DISPLACEMENT, _FORCE = (5e-5, 0.5), (2.0, 5e5)
"""Plausible half ranges [m] and [N] of a damper in a press; others indicate a wrong unit."""

_OFFSET = 0.25
"""Largest mean force, relative to half the range, that gas pressure explains."""

_EXCHANGED_RATIO = 0.9
"""A machine moves smoothly and a damper force reverses sharply, so the force has the larger steps.
"""

_SKEW, _SURE, _DETERMINED = 3e-4, 3.0, 5e-4
"""Smallest skew [s] that is reported, its smallest ratio to the standard error, and the largest
standard error [s] of a known skew."""

_USUAL = 2e-3
"""Usual amplitude [m] of the first motion."""


@dataclass(frozen=True)
class RigCheck:
    """``findings`` (empty: no fault), and the recommended first motion."""

    findings: tuple[RigFinding, ...]
    advice: str

    def __str__(self) -> str:
        lines = [f"- {finding.sentence}" for finding in self.findings]
        return "\n".join([*(lines or ["No fault found in the signals."]), "", self.advice])


def check_rig(record: RigRecord) -> RigCheck:
    """Check the received signals of a rig, ideally 30 s of motion at several frequencies."""
    found = [Trouble.UNUSABLE.found(count=record.unusable)] if record.unusable else []
    if not record.blocks:
        return RigCheck((*found, Trouble.SILENT.found(), *current_findings(record)), "")
    found += stream_findings(record)
    displacement, force = record.stretch()
    channels = {"displacement": displacement, "force": force}
    missing = {n: int(np.count_nonzero(~np.isfinite(values))) for n, values in channels.items()}
    found += [Trouble.NOT_FINITE.found(n, count=count) for n, count in missing.items() if count]
    if not any(missing.values()) and displacement.size >= _ENOUGH:
        found += _signal_findings(displacement, force, record.period)
    found += current_findings(record)
    return RigCheck(tuple(found), _advice(displacement, record.period))


def _signal_findings(displacement: Array, force: Array, period: float) -> Iterator[RigFinding]:
    channels = (("displacement", "m", displacement), ("force", "N", force))
    still = [Trouble.STUCK.found(name) for name, _, values in channels if np.ptp(values) == 0.0]
    at_rest = _extent(displacement)[1] < _DISPLACEMENT[0]
    if still:
        yield from still
        return
    if not at_rest and _exchanged(displacement, force):
        yield Trouble.SWAPPED.found()
        return
    yield from _unit_findings(displacement, force, at_rest=at_rest)
    if at_rest:
        return
    frequency, clipped = motion_frequency(displacement, period), False
    for name, unit, values in channels:
        for finding in channel_findings(name, unit, values, period, frequency):
            clipped = clipped or finding.trouble is Trouble.CLIPPED
            yield finding
    work = np.diff(displacement) @ (force[1:] + force[:-1] - 2.0 * force.mean())
    if work < 0.0:
        yield Trouble.INVERTED.found()
    skew, error = channel_skew(displacement, math.copysign(1.0, work) * force, period)
    if not clipped and error <= _DETERMINED and abs(skew) > max(_SKEW, _SURE * error):
        late, early = ("force", "displacement") if skew > 0.0 else ("displacement", "force")
        size, doubt = 1e3 * abs(skew), 1e3 * error
        yield Trouble.SKEW.found(late=late, early=early, skew=size, error=doubt, lateness=skew)


def _unit_findings(displacement: Array, force: Array, *, at_rest: bool) -> Iterator[RigFinding]:
    for name, unit, other, values, (low, high) in (
        ("displacement", "m", "millimetres", displacement, _DISPLACEMENT),
        ("force", "N", "kilonewtons", force, _FORCE),
    ):
        middle, half = _extent(values)
        if half < low and name == "displacement":
            yield Trouble.AT_REST.found(name, half=half, unit=unit)
        elif not low <= half <= high:
            only = " only" if half < low else ""
            yield Trouble.UNIT.found(name, half=half, unit=unit, only=only, other=other)
    # The centre between the extremes, because a mean over incomplete cycles would be biased.
    if not at_rest and abs(middle) > _OFFSET * half:
        yield Trouble.OFFSET.found("force", middle=middle)


def _extent(values: Array) -> tuple[float, float]:
    """Centre and half the range of the values without rare outliers."""
    low, high = np.quantile(values, (0.01, 0.99))
    return 0.5 * float(high + low), 0.5 * float(high - low)


def _exchanged(displacement: Array, force: Array) -> bool:
    """Whether the channels are exchanged: the displacement is rough and noisy for its size."""
    if coarse_step(displacement):
        return False  # coarse quantisation is also rough
    (rough, noisy), (force_rough, force_noisy) = map(_roughness, (displacement, force))
    return rough * _EXCHANGED_RATIO > force_rough and noisy > force_noisy


def _roughness(values: Array) -> tuple[float, float]:
    """Steps between samples without noise, and noise, relative to the standard deviation."""
    noise, spread = white_noise(values), float(np.std(values))
    steps = float(np.mean(np.diff(values) ** 2)) - 2.0 * noise**2
    return math.sqrt(max(steps, 0.0)) / spread, noise / spread


def _advice(displacement: Array, period: float) -> str:
    """Recommended first amplitude and frequency, from noise and sample rate."""
    if displacement.size < _ENOUGH or not np.isfinite(displacement).all():
        return ""
    smallest = max(500.0 * white_noise(displacement), 1e-4)
    fastest = 1.0 / (200.0 * period)
    frequency = min(1.0, fastest)
    return (
        f"Begin with a sine of ±{1e3 * max(smallest, _USUAL):.2g} mm at {frequency:.2g} Hz without "
        "current, then with half and with all of the current, then at "
        f"{min(2.0 * frequency, fastest):.2g} Hz. Amplitudes from ±{1e3 * smallest:.2g} mm are "
        f"well above the noise; up to {fastest:.3g} Hz a cycle has at least 200 samples."
    )
