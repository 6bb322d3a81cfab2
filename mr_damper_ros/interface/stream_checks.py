"""What is wrong with how samples and currents come: losses, rate, jitter, clocks."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from mr_damper_ros.interface.rig_record import RigRecord
from mr_damper_ros.interface.rig_trouble import RigFinding, Trouble
from mr_damper_ros.signals.blocks import NANOSECONDS

_RATE = 0.003
"""Difference from the stated period that no clock of a machine has."""

_JITTER = 0.1
"""Sample periods: a stamp that is off by less is taken as it is (doc/time.md)."""

_BURST = 0.1
"""Seconds by which a block comes later than its samples, that no network needs."""

_TOLD_LATE = 2.0
"""Seconds of samples by which two counts may differ that are told once a second."""

_CURRENT_OFF, _SETTLING = 0.05, 1.0
"""Amperes that the measured current may be off, once the command is so many seconds old."""

_CURRENT_AHEAD = 0.5
"""Seconds between the newest stamps of current and samples that are more than a slow reading."""


def stream_findings(record: RigRecord) -> Iterator[RigFinding]:
    """What is wrong with the blocks of a record that holds some."""
    yield from _count_findings(record)
    yield from _stamp_findings(record)
    arrivals = np.array([block.arrival_ns for block in record.blocks], dtype=np.float64)
    if (arrivals >= 0.0).all() and arrivals.size > 2:
        longest = max(block.force.size * block.period for block in record.blocks)
        stamps = np.array([block.start_ns for block in record.blocks], dtype=np.int64)
        # Where there are no samples, nothing was held up.
        expected = np.clip(np.diff(stamps) / NANOSECONDS, longest, None)
        pauses = np.diff(arrivals) / NANOSECONDS
        held_up = pauses - expected > _BURST
        if np.count_nonzero(held_up) > 1:
            yield RigFinding(
                Trouble.BURSTS,
                f"{np.count_nonzero(held_up)} times nothing came for up to "
                f"{pauses[held_up].max():.2g} s, then much "
                "at once: look at the network and the load of the sender",
            )


def _count_findings(record: RigRecord) -> Iterator[RigFinding]:
    lost = repeated = restarts = 0
    newest, expected = -1, record.blocks[0].sequence
    stamped = record.blocks[0].start_ns
    for block in record.blocks:
        missing = block.sequence - expected
        later = (block.start_ns - stamped) / NANOSECONDS
        if missing > 0:
            lost += missing
        elif missing < 0:
            if later > -1.0 and block.sequence + block.force.size <= newest and later <= 0.0:
                repeated += 1
                continue
            restarts += 1
        elif abs(later) > 1.0:
            restarts += 1
        expected = newest = block.sequence + block.force.size
        stamped = block.start_ns + round(block.force.size * block.period * NANOSECONDS)
    if repeated:
        # What comes later than its successor was missed when that came.
        lost = max(lost - repeated * round(np.median([b.force.size for b in record.blocks])), 0)
        yield RigFinding(
            Trouble.REPEATED,
            f"{repeated} blocks came twice or after later ones: does only one node publish them?",
        )
    left_out = 0
    for name in ("displacement", "force"):
        count = record.left_out(name)
        left_out += count
        if count:
            yield RigFinding(
                Trouble.CLIPPED,
                f"the {name} was at the end of its range: {count} samples were left out by their "
                "source; choose a larger range, or a smaller motion",
                name,
            )
    if left_out and (lost - left_out) * record.period < _TOLD_LATE:
        lost = 0
    if lost:
        whole = lost + record.sample_count
        yield RigFinding(
            Trouble.LOST,
            f"{lost} samples of {whole} ({lost / whole:.2%}) never came: look at the network, send "
            "larger blocks, and see that the queues are deep enough",
        )
    if restarts:
        yield RigFinding(
            Trouble.RESTARTED,
            f"count or stamps of the samples were set {restarts} times: is the source started "
            "again, or its clock set, while it runs?",
        )


def _stamp_findings(record: RigRecord) -> Iterator[RigFinding]:
    numbers, times = record.stamps()
    rising = np.flatnonzero(np.diff(numbers) > 0)
    if rising.size < 8 or numbers[-1] <= numbers[0]:
        return
    periods = np.diff(times)[rising] / np.diff(numbers)[rising]
    period, stated = float(np.median(periods)), record.period
    if abs(period / stated - 1.0) > _RATE:
        yield RigFinding(
            Trouble.RATE,
            f"the stamps say a sample every {1e3 * period:.4g} ms ({1.0 / period:.4g} Hz), stated "
            f"are {1e3 * stated:.4g} ms: set the right period in the driver",
        )
    # A line over the whole record would not follow a clock that was set.
    off = np.diff(times)[rising] - period * np.diff(numbers)[rising]
    jitter = float(np.std(off[np.abs(off) < 1.0])) / math.sqrt(2.0) / period
    if jitter > _JITTER:
        yield RigFinding(
            Trouble.JITTER,
            f"the stamps jitter by {1e3 * jitter * period:.2g} ms ({jitter:.0%} of a period): "
            "stamp by the count of the samples, not by when they come (doc/time.md)",
        )


def current_findings(record: RigRecord) -> Iterator[RigFinding]:
    """What is wrong with the current."""
    if not record.measured:
        yield RigFinding(
            Trouble.NO_CURRENT,
            "no current comes on supply/current: start the supply, or a driver of your own",
            "current",
        )
        return
    stamps = np.array([stamp for stamp, _ in record.measured], dtype=np.int64)
    values = np.array([value for _, value in record.measured])
    if not np.isfinite(values).all():
        yield RigFinding(
            Trouble.NOT_FINITE, "the current holds values that are no numbers", "current"
        )
        return
    if record.blocks:
        last = record.blocks[-1]
        end_ns = last.start_ns + round(last.force.size * last.period * NANOSECONDS)
        ahead = (int(stamps.max()) - end_ns) / NANOSECONDS
        usual = float(np.median(np.diff(np.sort(stamps)))) / NANOSECONDS if stamps.size > 1 else 0.0
        if abs(ahead) > _CURRENT_AHEAD + 2.0 * usual:
            yield RigFinding(
                Trouble.CURRENT_CLOCK,
                f"the current is stamped {abs(ahead):.3g} s "
                f"{'later' if ahead > 0.0 else 'earlier'} than the samples: synchronise the clocks",
                "current",
            )
    yield from _command_findings(record, stamps, values)


def _command_findings(
    record: RigRecord, stamps: np.ndarray, values: np.ndarray
) -> Iterator[RigFinding]:
    if not record.commanded:
        return
    told = np.array([stamp for stamp, _ in record.commanded], dtype=np.int64)
    wanted = np.array([value for _, value in record.commanded])
    changed = np.concatenate([[True], np.diff(wanted) != 0.0])
    since = told[np.maximum.accumulate(np.where(changed, np.arange(told.size), 0))]
    place = np.searchsorted(told, stamps, side="right") - 1
    known = place >= 0
    held = (stamps[known] - since[place[known]]) / NANOSECONDS
    fresh = (stamps[known] - told[place[known]]) / NANOSECONDS < _SETTLING
    off = (values[known] - wanted[place[known]])[(held > _SETTLING) & fresh]
    if off.size and float(np.median(np.abs(off))) > _CURRENT_OFF:
        yield RigFinding(
            Trouble.CURRENT,
            f"the measured current is {float(np.median(off)):+.3g} A off the commanded one: look "
            "at the limits of the supply, its voltage and the wires to the coil",
            "current",
        )
