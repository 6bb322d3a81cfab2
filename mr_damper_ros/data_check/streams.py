"""Check of the live signals of a rig, and a recommended first motion."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from mr_damper_ros.data_check.findings import NOTE, Finding, Kind, labelled
from mr_damper_ros.data_check.samples import Samples, check_samples
from mr_damper_ros.signals.arrays import Array, white_noise
from mr_damper_ros.signals.blocks import NANOSECONDS

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


def stream_findings(record: RigRecord) -> Iterator[Finding]:
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
            yield Kind.RATE.found(measured=1e3 * period, rate=1.0 / period, stated=1e3 * stated)
        # A line fitted to the whole record would not follow a step of the clock.
        off = steps - period * counts
        jitter = float(np.std(off[np.abs(off) < 1.0])) / math.sqrt(2.0)
        if jitter > _JITTER * period:
            yield Kind.JITTER.found(jitter=1e3 * jitter, share=jitter / period)
    if len(record.blocks) > 2:
        longest = max(block.force.size * block.period for block in record.blocks)
        pauses = np.diff([block.arrival_ns for block in record.blocks]) / NANOSECONDS
        # A gap in the stamps, or the length of a block, is not a pause.
        held_up = pauses[pauses - np.clip(np.diff(times), longest, None) > _PAUSE]
        if held_up.size > 1:
            yield Kind.BURSTS.found(count=held_up.size, pause=held_up.max())


def _count_findings(record: RigRecord) -> Iterator[Finding]:
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
        yield Kind.REPEATED.found(count=repeated)
    channels = ("displacement", "force")
    saturated = {name: record.saturated[name] for name in channels if name in record.saturated}
    omitted = {name: last - first for name, (first, last) in saturated.items() if last > first}
    for name, count in omitted.items():
        yield Kind.CLIPPED.found(name, how=f", and its source omitted {count} samples")
    known = sum(omitted.values())
    if lost and not (known and (lost - known) * record.period < _COUNT_TOLERANCE):
        whole = lost + record.sample_count
        yield Kind.LOST.found(count=lost, whole=whole, share=lost / whole)
    if restarts:
        yield Kind.RESTARTED.found(count=restarts)


def current_findings(record: RigRecord) -> Iterator[Finding]:
    """Findings on the current."""
    if not record.measured:
        yield Kind.NO_CURRENT.found("current")
        return
    stamps = np.array([stamp for stamp, _ in record.measured], dtype=np.int64)
    values = np.array([value for _, value in record.measured])
    if not np.isfinite(values).all():
        yield Kind.NOT_FINITE.found("current", count=np.count_nonzero(~np.isfinite(values)))
        return
    if record.blocks:
        last = record.blocks[-1]
        end_ns = last.start_ns + round(last.force.size * last.period * NANOSECONDS)
        ahead = (int(stamps.max()) - end_ns) / NANOSECONDS
        usual = float(np.median(np.diff(np.sort(stamps)))) / NANOSECONDS if stamps.size > 1 else 0.0
        if abs(ahead) > _CURRENT_AHEAD + 2.0 * usual:
            direction = "later" if ahead > 0.0 else "earlier"
            yield Kind.CURRENT_CLOCK.found("current", ahead=abs(ahead), direction=direction)
    yield from _command_findings(record, stamps, values)


def _command_findings(
    record: RigRecord, stamps: np.ndarray, values: np.ndarray
) -> Iterator[Finding]:
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
        yield Kind.CURRENT.found("current", off=float(np.median(off)))


_ENOUGH = 200
"""Smallest number of contiguous samples for checks of the channels."""

_USUAL = 2e-3
"""Usual amplitude [m] of the first motion."""


@dataclass(frozen=True)
class RigCheck:
    """``findings`` (empty: no fault), and the recommended first motion."""

    findings: tuple[Finding, ...]
    advice: str

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """The findings that are more than notes."""
        return tuple(finding for finding in self.findings if finding.severity > NOTE)

    def __str__(self) -> str:
        lines = [labelled(finding) for finding in self.findings]
        return "\n".join([*(lines or ["No fault found in the signals."]), "", self.advice])


def check_rig(record: RigRecord) -> RigCheck:
    """Check the received signals of a rig, ideally 30 s of motion at several frequencies."""
    found = []
    if record.unusable:
        reason = "each needs a period above 0, and as many displacements as forces"
        topic = "mts/samples"
        found.append(Kind.UNUSABLE.found(count=record.unusable, topic=topic, reason=reason))
    if not record.blocks:
        return RigCheck((*found, Kind.SILENT.found(), *current_findings(record)), "")
    found += stream_findings(record)
    displacement, force = record.stretch()
    channels = {"displacement": displacement, "force": force}
    missing = {n: int(np.count_nonzero(~np.isfinite(values))) for n, values in channels.items()}
    found += [Kind.NOT_FINITE.found(n, count=count) for n, count in missing.items() if count]
    if not any(missing.values()) and displacement.size >= _ENOUGH:
        current = np.zeros(force.size)  # the current has its own stamps
        samples = Samples(displacement, force, current, record.period)
        of_samples = check_samples(samples, mend=False).findings
        # A time between channels in a wrong unit of time says nothing.
        untimed = any(each.kind is Kind.RATE for each in found)
        found += [each for each in of_samples if not (untimed and each.kind is Kind.SKEW)]
    found += current_findings(record)
    return RigCheck(tuple(found), _advice(displacement, record.period))


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
