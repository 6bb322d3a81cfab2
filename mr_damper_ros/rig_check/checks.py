"""Checks of the signals of a rig: findings in words, and a recommended first motion."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.rig_check.record import (
    ChannelLag,
    RigFinding,
    RigRecord,
    Trouble,
    channel_lag,
    motion_frequency,
)
from mr_damper_ros.signals.arrays import Array, white_noise
from mr_damper_ros.signals.blocks import NANOSECONDS

_CLIPPED_PART, _CLIPPED_IN_A_ROW = 0.01, 5
"""Smallest fraction of samples, and number in a row, at the extreme value of a clipped channel."""

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
        limits = values.min(), values.max()
        clipped = [f"{limit:.4g}" for limit in limits if _clips(values, limit)]
        if clipped:
            yield Trouble.CLIPPED.found(name, how=f" at {' and '.join(clipped)}")
        part, least = _NOISY[name]
        if noise > max(part * spread, least):
            yield Trouble.NOISE.found(name, noise=noise, unit=unit, share=noise / spread)
    middle = np.median(np.stack([values[:-2], values[1:-1], values[2:]]), axis=0)
    wild = np.abs(values[1:-1] - middle) > max(_OUTLIER * noise, 2.0 * _JUMP * _half_range(values))
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


def _clips(values: Array, limit: float) -> bool:
    """Whether many values, and several in a row, are exactly at this limit."""
    there = values == limit
    in_a_row = np.convolve(there, np.ones(_CLIPPED_IN_A_ROW), "valid").max() >= _CLIPPED_IN_A_ROW
    return bool(in_a_row and there.mean() >= _CLIPPED_PART)


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
    numbers, times = record.stamps()
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
    arrivals = np.array([block.arrival_ns for block in record.blocks], dtype=np.float64)
    if (arrivals >= 0.0).all() and arrivals.size > 2:
        longest = max(block.force.size * block.period for block in record.blocks)
        pauses = np.diff(arrivals) / NANOSECONDS
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
        expected, due_ns = (
            end,
            block.start_ns + round((end - block.sequence) * block.period * NANOSECONDS),
        )
    if repeated:
        # A block that arrives after its successor was first counted as missing.
        lost = max(lost - repeated * round(np.median([b.force.size for b in record.blocks])), 0)
        yield Trouble.REPEATED.found(count=repeated)
    left_out = {name: record.left_out(name) for name in ("displacement", "force")}
    for name, count in left_out.items():
        if count:
            yield Trouble.CLIPPED.found(name, how=f", and its source omitted {count} samples")
    known = sum(left_out.values())
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

_SKEW, _SURE = 3e-4, 3.0
"""Smallest skew [s] that is reported, and its smallest ratio to the standard error."""

_USUAL = 2e-3
"""Usual amplitude [m] of the first motion."""


@dataclass(frozen=True)
class RigCheck:
    """``findings`` (empty: no fault), ``lag`` of the force, and the recommended first motion."""

    findings: tuple[RigFinding, ...]
    lag: ChannelLag | None
    advice: str

    def __str__(self) -> str:
        lines = [f"- {finding.sentence}" for finding in self.findings]
        return "\n".join([*(lines or ["No fault found in the signals."]), "", self.advice])


def check_rig(record: RigRecord) -> RigCheck:
    """Check the received signals of a rig, ideally 30 s of motion at several frequencies."""
    found = [Trouble.UNUSABLE.found(count=record.unusable)] if record.unusable else []
    if not record.blocks:
        silent = Trouble.SILENT.found()
        return RigCheck((*found, silent, *current_findings(record)), None, "")
    found += stream_findings(record)
    displacement, force = record.stretch()
    channels = {"displacement": displacement, "force": force}
    missing = {n: int(np.count_nonzero(~np.isfinite(values))) for n, values in channels.items()}
    found += [Trouble.NOT_FINITE.found(n, count=count) for n, count in missing.items() if count]
    lag = None
    if not any(missing.values()) and displacement.size >= _ENOUGH:
        of_channels, lag = _channels(displacement, force, record.period)
        found += of_channels
    found += current_findings(record)
    return RigCheck(tuple(found), lag, _advice(displacement, force, record.period))


def _channels(
    displacement: Array, force: Array, period: float
) -> tuple[list[RigFinding], ChannelLag | None]:
    channels = (("displacement", "m", displacement), ("force", "N", force))
    still = [Trouble.STUCK.found(name) for name, _, values in channels if np.ptp(values) == 0.0]
    if still:
        return still, None
    at_rest = _half_range(displacement) < _DISPLACEMENT[0]
    if not at_rest and _exchanged(displacement, force):
        return [Trouble.SWAPPED.found()], None
    found = list(_unit_findings(displacement, force))
    if at_rest:
        return found, None
    frequency = motion_frequency(displacement, period)
    for name, unit, values in channels:
        found += channel_findings(name, unit, values, period, frequency)
    sound = not any(finding.trouble is Trouble.CLIPPED for finding in found)
    work = np.diff(displacement) @ (force[1:] + force[:-1] - 2.0 * force.mean())
    if work < 0.0:
        found.append(Trouble.INVERTED.found())
    lag = channel_lag(displacement, math.copysign(1.0, work) * force, period)
    if sound and lag.determined and abs(lag.skew) > max(_SKEW, _SURE * lag.standard_error):
        late, early = ("force", "displacement") if lag.skew > 0 else ("displacement", "force")
        skew, error = 1e3 * abs(lag.skew), 1e3 * lag.standard_error
        found.append(
            Trouble.SKEW.found(late=late, early=early, skew=skew, error=error, lateness=lag.skew)
        )
    return found, lag


def _unit_findings(displacement: Array, force: Array) -> Iterator[RigFinding]:
    for name, unit, other, values, (low, high) in (
        ("displacement", "m", "millimetres", displacement, _DISPLACEMENT),
        ("force", "N", "kilonewtons", force, _FORCE),
    ):
        half = _half_range(values)
        if half < low and name == "displacement":
            yield Trouble.AT_REST.found(name, half=half, unit=unit)
        elif not low <= half <= high:
            only = " only" if half < low else ""
            yield Trouble.UNIT.found(name, half=half, unit=unit, only=only, other=other)
    half = _half_range(force)
    if _half_range(displacement) < _DISPLACEMENT[0]:
        return
    # The centre between the extremes, because a mean over incomplete cycles would be biased.
    middle = 0.5 * float(np.quantile(force, 0.99) + np.quantile(force, 0.01))
    if abs(middle) > _OFFSET * half:
        yield Trouble.OFFSET.found("force", middle=middle)


def _half_range(values: Array) -> float:
    """Half the range of the values without rare outliers."""
    low, high = np.quantile(values, (0.01, 0.99))
    return 0.5 * float(high - low)


def _exchanged(displacement: Array, force: Array) -> bool:
    """Whether the channels are exchanged: the displacement is rough and noisy for its size."""
    if coarse_step(displacement):
        return False  # coarse quantisation is also rough
    noises = [white_noise(values) / float(np.std(values)) for values in (displacement, force)]
    rougher = _roughness(displacement) * _EXCHANGED_RATIO > _roughness(force)
    return rougher and noises[0] > noises[1]


def _roughness(values: Array) -> float:
    """Steps between samples without noise, relative to the standard deviation."""
    steps = float(np.mean(np.diff(values) ** 2)) - 2.0 * white_noise(values) ** 2
    return float(np.sqrt(max(steps, 0.0)) / np.std(values))


def _advice(displacement: Array, force: Array, period: float) -> str:
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
