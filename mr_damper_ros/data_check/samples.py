"""Check of displacement, force and current that were sampled together, and what can be mended."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from mr_damper_ros.data_check.channels import (
    HARMONICS,
    SHARP,
    SIDEBANDS,
    SMOOTH,
    Limit,
    Line,
    Spectrum,
    clipped_at,
    coarse_step,
    extent,
    held_steps,
    jumps,
    longest,
    spikes,
    stretches,
    without_lines,
)
from mr_damper_ros.data_check.findings import NOTE, REFUSE, WARN, Finding, Kind
from mr_damper_ros.data_check.lag import (
    channel_skew,
    force_lead,
    motion_frequency,
    smooth_velocity,
    usual_speed,
)
from mr_damper_ros.kinematics.window import TURN, holds_cycle
from mr_damper_ros.models.quantities import SAME_CURRENT
from mr_damper_ros.signals.arrays import NOISE_SPAN, SIGMAS, Array, Mask, white_noise
from mr_damper_ros.signals.moving_average import find_average
from mr_damper_ros.signals.recording import (
    LARGEST_CURRENT,
    LARGEST_FORCE,
    LARGEST_MOTION,
    TEMPERATURES,
)

UNITS = {"displacement": "m", "force": "N", "current": "A", "temperature": "°C"}
"""Unit of each channel."""

_PERIODS = (1e-6, 0.1)
"""Plausible sample periods [s]."""

_SMALLEST_MOTION = 1e-4
"""Smallest plausible span [m] of a displacement; the seals of a damper give way by as much."""

_LARGEST_SPEED = 5.0
"""Largest plausible usual velocity [m/s]."""

_SPIKES = 0.06
"""Part of the samples that may be spikes, and does not count for the size of a channel."""

SMALLEST_FORCE, _UNUSUAL_FORCE = 5.0, 2e5
"""Smallest plausible peak force [N], and the largest that is usual: the few larger MR dampers are
those of buildings, and a small damper in the wrong unit seems as strong."""

_FEWEST, _ENOUGH = 16, 200
"""Smallest number of samples that are judged, and for what is found in spectra and statistics."""

NEGATIVE_POWER = 0.1
"""If the correlation of force and velocity is below minus this value, one of the signs is wrong."""

_OFFSET = 0.25
"""Largest mean force, relative to half the range, that goes without saying."""

_EXCHANGED_RATIO = 0.9
"""A machine moves smoothly and a damper force reverses sharply, so the force has the larger steps.
"""

_NOISY = {"displacement": (0.002, 1e-5), "force": (0.03, 10.0)}
"""Limits of white noise, in standard deviations of the channel and in its unit. Noise is excessive
if it exceeds both, because without current the force is small."""

_HUM_OF_SPEED, _HUM_OF_FORCE = 0.01, 0.005
"""Smallest velocity of a disturbance of the displacement, and smallest disturbance of the force,
relative to the root mean square of the channel."""

_ANSWER = 0.2
"""The force of a damper answers a real motion with at least this part of its mean damping."""

_SKEW, _DETERMINED = 3e-4, 5e-4
"""Smallest skew [s] that is reported, and the largest standard error [s] of a known skew."""

_EARLY = 1e-3
"""Smallest lead [s] of the force that is reported."""

_LITTLE = 0.04
"""Height cut off by clipping that does not matter, relative to half the range."""

_MOST_CLIPPED = (0.3, 0.45)
"""Largest part of the samples that may be clipped at one limit, and at both. Of flat loops of which
a third was clipped at one limit, or half at both, fits of the rest were wrong by 20 %."""

_RENEWALS = {"displacement": 12, "force": 60}
"""Smallest number of renewals in a cycle with which a channel that is held can be bridged; a force
has corners."""

_LONG = 0.15
"""Shortest stretch in cycles in which a channel is stuck; a coarse displacement rests for less at
its dead centres."""

_REPEATING = 0.02
"""Part of the samples of a channel with noise that repeats the sample before, at most."""

_LEAST_USED = 0.5
"""Smallest part of the samples that must be left where a run is cut."""

_RESTORED = 0.1
"""Longest stay of a displacement at a limit, in cycles, that can be restored."""

_GROSS = 0.4
"""Resolution or noise, relative to the standard deviation, above which it is warned of."""

_MOST_GLITCHES = 0.05
"""Largest fraction of wrong readings in a current that can be bridged."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Displacement [m], force [N] and current [A], each (n,), one ``period`` [s] apart."""

    displacement: Array
    force: Array
    current: Array
    period: float

    @cached_property
    def motion_spectrum(self) -> Spectrum:
        """Spectrum of the displacement."""
        return Spectrum(self.displacement, self.period)

    @cached_property
    def force_spectrum(self) -> Spectrum:
        """Spectrum of the force."""
        return Spectrum(self.force, self.period)


@dataclass(frozen=True, eq=False)
class Checked:
    """The findings on samples, and the ``samples`` as they are used, in which faults are mended.

    ``parts`` are the stretches that are used; more than one where samples are missing or useless.
    ``clipped`` (n,) marks forces that a fit leaves out, None without any.
    """

    samples: Samples
    findings: tuple[Finding, ...]
    parts: tuple[slice, ...] = (slice(None),)
    clipped: Mask | None = None

    @property
    def refused(self) -> Finding | None:
        """The first finding that refuses the samples, None without one."""
        return next((each for each in self.findings if each.severity is REFUSE), None)


def check_samples(given: Samples, gaps: Sequence[slice] = (), *, mend: bool = True) -> Checked:
    """Check finite samples of a run, and with ``mend`` mend what can be mended.

    The samples in ``gaps`` are interpolated; a displacement in a short one is restored.

    Spikes and held values are bridged, short clipping of the displacement is restored, and a
    disturbance of it that stands apart from the motion is filtered without a shift in time. Where
    samples are missing, or a channel is stuck, the ``parts`` are cut, and ``clipped`` forces are
    marked. The findings say so.
    """
    if given.force.size < _FEWEST:
        return Checked(given, ())
    units, stuck = tuple(unit_findings(given)), _stuck(given)
    if given.force.size < _ENOUGH:
        found = [] if stuck is None else [stuck.finding]
        return Checked(given, (*units, *found, *_sign_findings(given)))
    inverted = tuple(_sign_findings(given))
    # With exchanged channels, the loop runs the other way round, and the units are wrong as well.
    if inverted and _exchanged(given.displacement, given.force):
        return Checked(given, (Kind.SWAPPED.found(),))
    refused = [each for each in units if each.severity is REFUSE]
    most = (1.0 - _LEAST_USED) * given.force.size if mend else 0.0
    if stuck is not None and stuck.stretch.stop - stuck.stretch.start > most:
        refused.append(stuck.finding)
    if refused:
        return Checked(given, tuple(refused))
    cycle, long = _cycle(given), list(gaps)
    if mend:
        long = [gap for gap in gaps if gap.stop - gap.start > _RESTORED * cycle]
        short = [gap for gap in gaps if gap not in long]
        restored = _restored(given.displacement, short, cycle) if short else None
        given = given if restored is None else replace(given, displacement=restored)
    samples, found = _mended(given, mend=mend)
    clipped = _left_out(given.force, found) if mend else None
    lost, parts = _interruptions(samples, stuck, long, mend=mend)
    held = any(each.kind is Kind.HELD and each.channel == "force" for each in found)
    if not held and (count := find_average(given.force)) > 1:
        found.append(Kind.SMOOTHED.found("force", value=count, count=count))
    of_motion = inverted or tuple(_lag_findings(samples, longest(list(parts))))
    found = [*units, *lost, *found, *_quality(samples), *of_motion]
    return Checked(samples, tuple(found), parts, clipped)


def check_window(given: Samples, *, moves: bool) -> Checked:
    """As :func:`check_samples`, but only what decides whether a window of a stream can be fitted.

    ``moves``: whether the machine moves enough to judge more than units.
    """
    found: tuple[Finding, ...] = tuple(unit_findings(given, moves=moves))
    if moves and (stuck := _stuck(given)) is not None:
        found += (stuck.finding,)
    checked = Checked(given, found)
    if checked.refused or not moves or given.force.size < _ENOUGH:
        return checked
    samples, more = _mended(given, mend=True)
    return Checked(samples, (*found, *more))


# -- what no damper gives --------------------------------------------------------------------


def unit_findings(samples: Samples, *, moves: bool = True) -> Iterator[Finding]:
    """Findings on values that no damper gives in SI units."""
    if not _PERIODS[0] <= samples.period <= _PERIODS[1]:
        yield wrong_unit("time", "has a sample period of", samples.period, "another unit", "s")
    span = 2.0 * extent(samples.displacement, _SPIKES)[1]
    speed = float(np.quantile(np.abs(np.diff(samples.displacement)), 0.7)) / samples.period
    if span > LARGEST_MOTION:
        yield wrong_unit("displacement", "spans", span, "millimetres")
    elif moves and span < _SMALLEST_MOTION:
        if span <= NOISE_SPAN * white_noise(samples.displacement):
            yield Kind.AT_REST.found("displacement", value=span, span=span, unit="m")
        else:
            yield wrong_unit("displacement", "spans only", span, "metres")
    elif speed > _LARGEST_SPEED:
        yield wrong_unit("time", "lets the rod move at", speed, "another unit", "m/s on average")
    largest = float(np.quantile(np.abs(samples.force), 1.0 - _SPIKES))
    if largest > LARGEST_FORCE:
        yield wrong_unit("force", "reaches", largest, "another unit")
    elif moves and 0.0 < largest < SMALLEST_FORCE:
        yield wrong_unit("force", "reaches only", largest, "kilonewtons")
    elif largest > _UNUSUAL_FORCE:
        unusual = wrong_unit("force", "reaches", largest, "another unit")
        yield replace(unusual, severity=WARN)
    largest = float(np.max(np.abs(samples.current)))
    if largest > LARGEST_CURRENT:
        yield wrong_unit("current", "reaches", largest, "milliamperes")


def temperature_findings(temperature: Array) -> Iterator[Finding]:
    """A finding on temperatures (n,) [°C] that no damper has."""
    low, high = float(np.min(temperature)), float(np.max(temperature))
    if low < TEMPERATURES[0] or high > TEMPERATURES[1]:
        worst = low if low < TEMPERATURES[0] else high
        yield wrong_unit("temperature", "reaches", worst, "kelvin")


def wrong_unit(channel: str, reaches: str, size: float, other: str, unit: str = "") -> Finding:
    """The finding that a size is that of the ``other`` unit."""
    return Kind.UNIT.found(
        channel, value=size, reaches=reaches, size=size, unit=unit or UNITS[channel], other=other
    )


class _Stuck(NamedTuple):
    """The finding on a channel that gets stuck, and the stretch."""

    finding: Finding
    stretch: slice


def _stuck(samples: Samples) -> _Stuck | None:
    """A constant force, or a channel that is constant while the other one reverses."""
    displacement, force = samples.displacement, samples.force
    if np.ptp(force) == 0.0:
        return _Stuck(Kind.STUCK.found("force", how="does not change"), slice(0, force.size))
    cycle = _cycle(samples)
    for name, values, other in (
        ("force", force, displacement),
        ("displacement", displacement, force),
    ):
        repeats = np.diff(values) == 0.0
        same = longest(stretches(repeats))
        start, stop = same.start, same.stop + 1
        constant = np.ptp(values) == 0.0
        # A channel with noise does not repeat itself, unless it is stuck.
        alone = np.count_nonzero(repeats) - same.stop + same.start < _REPEATING * values.size
        long = max(_LONG * cycle, _FEWEST) if alone else TURN * values.size
        if constant or stop - start < long or clipped_at(values):
            continue
        stretch = other[start:stop]
        ends, extremes = stretch[[0, -1]], (stretch.max(), stretch.min())
        way_back = max(float(np.min(np.abs(ends - extreme))) for extreme in extremes)
        least = TURN * float(np.ptp(other))
        moves = name == "force" and alone and float(np.ptp(stretch)) > least
        if moves or way_back > least:
            what = "motion goes on" if name == "force" else "force reverses"
            found = Kind.STUCK.found(name, how=f"is constant although the {what}")
            return _Stuck(found, slice(start, stop))
    return None


def _cycle(samples: Samples) -> float:
    """Samples in a cycle of the motion; very many if it does not move."""
    frequency = motion_frequency(samples.displacement, samples.period)
    return 1.0 / max(frequency * samples.period, 1e-9)


def _interruptions(
    samples: Samples, stuck: _Stuck | None, recorded: list[slice], *, mend: bool
) -> tuple[list[Finding], tuple[slice, ...]]:
    """Findings on a channel that got stuck and on missing samples, and the parts between them.

    ``recorded`` are gaps that are known.
    """
    found, gaps = list[Finding](), recorded.copy()
    if gaps:
        found.append(Kind.MISSING.found(value=len(gaps), what=f"the time has {len(gaps)} gaps"))
    if stuck is not None:
        found.append(stuck.finding)
        gaps.append(stuck.stretch)
    places = jumps(samples.displacement) + 1
    lost = [place for place in places.tolist() if not any(_near(place, gap) for gap in gaps)]
    if lost:
        what = f"the displacement jumps {len(lost)} times, which no motion explains"
        found.append(Kind.MISSING.found("displacement", value=len(lost), what=what))
        gaps += [slice(place, place) for place in lost]
    whole = (slice(0, samples.force.size),)
    if not (gaps and mend):
        return found, whole
    gaps.sort(key=lambda gap: gap.start)
    starts, stops = [0, *(gap.stop for gap in gaps)], [*(gap.start for gap in gaps), whole[0].stop]
    cycle = _cycle(samples)
    parts = tuple(
        part
        for part in map(slice, starts, stops)
        if part.stop - part.start >= cycle and holds_cycle(samples.displacement[part])
    )
    if sum(part.stop - part.start for part in parts) < _LEAST_USED * samples.force.size:
        return found, whole
    return [each.mended("the run is cut there") for each in found], parts


def _near(place: int, gap: slice) -> bool:
    """Whether a jump belongs to a stretch in which a channel is stuck."""
    return gap.start - 1 <= place <= gap.stop + 1


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


# -- what can be mended ----------------------------------------------------------------------


def _mended(given: Samples, *, mend: bool) -> tuple[Samples, list[Finding]]:
    """The samples in which faults of single channels are mended, and the findings on them."""
    cycle = _cycle(given)
    samples, found = given, list[Finding]()
    for name in ("displacement", "force"):
        values: Array = getattr(samples, name)
        if coarse_step(values):
            continue
        fault, bridged = _bridged(name, values, cycle)
        if fault is None:
            continue
        if mend and bridged is not None:
            too_slow = fault.kind is Kind.HELD and cycle < _RENEWALS[name] * fault.value
            fault = fault.mended("a fit bridges this", WARN if too_slow else NOTE)
            samples = replace(samples, **{name: bridged})  # type: ignore[arg-type]
        found.append(fault)
    glitches, current = _without_glitches(given.current)
    if glitches is not None:
        found.append(glitches.mended("a fit uses the readings before them") if mend else glitches)
        samples = replace(samples, current=current) if mend else samples
    # The steps of held values have lines of their own.
    held = any(each.kind is Kind.HELD for each in found) and not mend
    lines = [] if held else _disturbances(samples)
    for line in lines:
        hum = _hum("displacement", line)
        found.append(hum.mended("a fit filters it, without a shift in time") if mend else hum)
    if lines and mend:
        quiet = without_lines(samples.displacement, lines, samples.period)
        samples = replace(samples, displacement=quiet)
    return samples, found


def _bridged(name: str, values: Array, cycle: float) -> tuple[Finding | None, Array | None]:
    """The finding on held values, clipping or spikes of a channel (n,), and the channel without.

    The channel is None if it cannot be mended.
    """
    renewed = np.ones(values.size, dtype=bool)
    if (step := held_steps(values)) > 1:
        renewed[1:] = np.diff(values) != 0.0
        # Every held value looks like clipping.
        if not clipped_at(values[renewed]):
            return Kind.HELD.found(name, value=step, step=step), _between(name, values, renewed)
    if limits := clipped_at(values):
        return _clipped(name, values, limits, cycle)
    wild = spikes(values, cycle, SMOOTH if name == "displacement" else SHARP)
    if not wild.any():
        return None, None
    count, kept = int(np.count_nonzero(wild)), _between(name, values, ~wild)
    size = float(np.max(np.abs(values - kept)))
    return Kind.SPIKES.found(name, value=count, count=count, size=size, unit=UNITS[name]), kept


def _between(name: str, values: Array, right: Mask) -> Array:
    """A channel (n,), interpolated between its right values: by a spline if it is smooth."""
    places, known = np.arange(values.size), np.flatnonzero(right)
    if name == "force":
        return np.interp(places, known, values[known])
    from scipy.interpolate import CubicSpline  # imported late: see entry_points

    return np.asarray(CubicSpline(known, values[known])(np.clip(places, known[0], known[-1])))


def _clipped(
    name: str, values: Array, limits: list[Limit], cycle: float
) -> tuple[Finding, Array | None]:
    """The finding on clipping, and a displacement that is restored after short stays."""
    where = " and ".join(f"{limit.extreme:.4g}" for limit in limits)
    cut = max(limit.cut for limit in limits)
    found = Kind.CLIPPED.found(name, value=cut, how=f" at {where} {UNITS[name]}")
    if name == "force":
        little = cut <= _LITTLE * extent(values)[1]
        return found.mended("little is cut off") if little else found, None
    return found, _restored(values, [stay for limit in limits for stay in limit.stays], cycle)


def _restored(displacement: Array, stays: Sequence[slice], cycle: float) -> Array | None:
    """A displacement (n,) with polynomials in short ``stays``; None if one is too long."""
    restored = displacement.copy()
    for stay in stays:
        length = stay.stop - stay.start
        around = slice(max(stay.start - length, 0), min(stay.stop + length, displacement.size))
        if length > _RESTORED * cycle or around.stop - around.start < 3 * length:
            return None
        places = np.arange(around.start, around.stop)
        known = (places < stay.start) | (places >= stay.stop)
        line = np.polynomial.Polynomial.fit(places[known], displacement[around][known], 4)
        restored[stay] = line(places[~known])
    return restored


def _left_out(force: Array, found: list[Finding]) -> Mask | None:
    """The clipped forces (n,), if enough others remain for a fit; the finding then says so."""
    for place, each in enumerate(found):
        if each.kind is Kind.CLIPPED and each.channel == "force":
            sides = [force == limit.extreme for limit in clipped_at(force)]
            shares = [float(side.mean()) for side in sides]
            if max(shares) <= _MOST_CLIPPED[0] and sum(shares) <= _MOST_CLIPPED[1]:
                found[place] = each.mended(f"a fit leaves out {sum(shares):.1%} of the samples")
                return np.any(sides, axis=0)
    return None


def _without_glitches(current: Array) -> tuple[Finding | None, Array]:
    """The finding on wrong readings of an otherwise steady current (n,), and the current without.

    A reading is wrong if it differs from those before and after, which are equal. A current that
    changes by itself more often than that is commanded.
    """
    edges = np.flatnonzero(np.abs(np.diff(current)) > SAME_CURRENT) + 1
    if edges.size == 0 or edges.size > _MOST_GLITCHES * current.size:
        return None, current
    pieces = np.split(current, edges)
    levels = np.array([float(np.median(piece)) for piece in pieces])
    sizes = np.array([piece.size for piece in pieces])
    wrong = np.abs(levels - float(np.median(current))) > SAME_CURRENT
    alone = np.append(~wrong[1:], False) & np.append(False, ~wrong[:-1])
    few = sizes[wrong].sum() <= _MOST_GLITCHES * current.size
    if not wrong.any() or not few or np.any(wrong & ~alone):
        return None, current
    count = int(np.count_nonzero(wrong))
    size = float(np.max(np.abs(levels[wrong] - float(np.median(current)))))
    kept = np.concatenate(
        [np.full(p.size, levels[k - 1]) if wrong[k] else p for k, p in enumerate(pieces)]
    )
    found = Kind.SPIKES.found("current", value=count, count=count, size=size, unit="A")
    return found, kept


def _hum(channel: str, line: Line) -> Finding:
    return Kind.HUM.found(
        channel,
        value=line.amplitude,
        size=line.amplitude,
        unit=UNITS[channel],
        frequency=line.frequency,
    )


def _disturbances(samples: Samples) -> list[Line]:
    """Disturbances of the displacement that stand apart from the motion, and move no damper."""
    motion, answer = samples.motion_spectrum, samples.force_spectrum
    speed = usual_speed(samples.displacement, samples.period)
    damping = float(np.std(samples.force)) / max(speed, 1e-12)
    found, fastest = [], motion.fastest
    for line in motion.standing_apart(fastest):
        ripple = 2.0 * math.pi * line.frequency * line.amplitude
        if ripple < _HUM_OF_SPEED * speed or line.frequency < HARMONICS * fastest:
            continue
        known = answer.amplitude(line) if answer.answers(line, fastest) else 0.0
        if known < _ANSWER * damping * ripple:
            found.append(line)
    return found


# -- quality ---------------------------------------------------------------------------------


def _quality(samples: Samples) -> Iterator[Finding]:
    """Findings on noise, resolution, hum of the force and offset, which a fit averages out."""
    for name in _NOISY:
        values = getattr(samples, name)
        spread, noise = float(np.std(values)), white_noise(values)
        part, least = _NOISY[name]
        if step := coarse_step(values):
            found = Kind.COARSE.found(name, value=step, step=step, unit=UNITS[name])
        elif noise > max(part * spread, least):
            share = noise / spread
            found = Kind.NOISE.found(name, value=noise, noise=noise, unit=UNITS[name], share=share)
        else:
            continue
        gross = found.value > _GROSS * spread
        yield replace(found, severity=WARN if gross else NOTE)
    force, moved = samples.force, samples.motion_spectrum
    for line in samples.force_spectrum.standing_apart(moved.fastest):
        large = line.amplitude > _HUM_OF_FORCE * float(np.std(force))
        # The harmonics of the motion, and what the displacement holds, too, are no disturbance.
        if (
            large
            and line.frequency > SIDEBANDS * moved.fastest
            and not moved.answers(line, moved.fastest)
        ):
            yield replace(_hum("force", line), severity=NOTE)
    # The centre between the extremes, because a mean over incomplete cycles would be biased.
    middle, half = extent(force)
    if abs(middle) > _OFFSET * half:
        yield Kind.OFFSET.found("force", value=middle, middle=middle)


# -- motion and force ------------------------------------------------------------------------


def _lag_findings(samples: Samples, part: slice) -> Iterator[Finding]:
    displacement, force, period = samples.displacement[part], samples.force[part], samples.period
    lead, error = force_lead(displacement, force, period)
    if lead > max(_EARLY, SIGMAS * error):
        early = {"early": 1e3 * lead, "doubt": 1e3 * error}
        yield Kind.BACKWARD.found("force", value=lead, error=error, **early)
    skew, error = channel_skew(displacement, force, period)
    if error <= _DETERMINED and abs(skew) > max(_SKEW, SIGMAS * error):
        yield skew_finding(skew, error)


def skew_finding(late: float, error: float) -> Finding:
    """The finding on a force that is recorded ``late`` [s], with its standard error [s]."""
    channel, early = ("force", "displacement")[:: 1 if late > 0.0 else -1]
    return Kind.SKEW.found(
        channel,
        value=late,
        error=error,
        late=channel,
        early=early,
        skew=1e3 * abs(late),
        doubt=1e3 * error,
        lateness=late,
    )


def _sign_findings(samples: Samples) -> Iterator[Finding]:
    velocity = smooth_velocity(samples.displacement, samples.period)
    if drives(velocity, samples.force):
        yield Kind.INVERTED.found("force")


def drives(velocity: Array, force: Array) -> bool:
    """Whether a force (n,) drives the motion; a damper is dissipative over some cycles."""
    centred = force - force.mean()
    power = float(centred @ velocity)
    return power < -NEGATIVE_POWER * float(np.linalg.norm(centred) * np.linalg.norm(velocity))
