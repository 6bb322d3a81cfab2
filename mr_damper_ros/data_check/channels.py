"""Evidence in the samples of one channel: clipping, spikes, held values, hum, coarse steps."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mr_damper_ros.signals.arrays import Array, Mask, white_noise


def stretches(mask: Mask) -> list[slice]:
    """The stretches of consecutive true values of a mask (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.view(np.int8), [0])))).tolist()
    return [slice(*ends) for ends in zip(edges[::2], edges[1::2], strict=True)]


def longest(found: list[slice]) -> slice:
    """The longest stretch; an empty one if there is none."""
    return max(found, key=lambda each: each.stop - each.start, default=slice(0, 0))


def extent(values: Array, left_out: float = 0.01) -> tuple[float, float]:
    """Centre and half the range of values (n,) without this part at either end."""
    low, high = np.quantile(values, (left_out, 1.0 - left_out))
    return 0.5 * float(high + low), 0.5 * float(high - low)


_COARSE = 0.02
"""Smallest step, in standard deviations of the channel, that counts as coarse quantisation."""


def coarse_step(values: Array) -> float:
    """The quantisation step if it is coarse, otherwise 0."""
    steps = np.abs(np.diff(values))
    steps = steps[steps > 1e-9 * float(np.ptp(values))]
    step = float(steps.min()) if steps.size else 0.0
    return step if step > _COARSE * float(np.std(values)) else 0.0


# -- clipping --------------------------------------------------------------------------------

_CLIPPED = 0.02
"""Smallest fraction of samples at its extreme for which a signal counts as clipped."""

_STAY = 8
"""Shortest stay at an extreme, in samples, that is judged."""

_RESOLVED = 8.0
"""The approach to an extreme is judged over a distance of so many steps of the finest digit."""

_ARRIVAL_PART = 0.37
"""A signal is clipped if it covers more than this fraction of the approach in the second half. At
constant speed this fraction is a half; if it comes to rest, it is a quarter, and if it approaches a
limit exponentially, 0.35 at the resolved distance."""


class Limit(NamedTuple):
    """An extreme at which a signal is clipped, and the estimated height of what is ``cut`` off.

    ``stays`` are the stretches at the extreme.
    """

    extreme: float
    cut: float
    stays: tuple[slice, ...]


def clipped_at(values: Array) -> list[Limit]:
    """The extremes of a signal (n,) at which it stays, and where it arrives without slowing down.

    A machine that rests at a dead centre, or a sine with a coarse resolution, approaches its
    extreme slowly and is not clipped. Noise above the finest digit does not repeat a value for
    long, so that then every stay is clipped.
    """
    steps = np.abs(np.diff(values))
    finest = float(np.min(steps[steps > 0.0], initial=np.inf))
    found = []
    for extreme in (float(values.min()), float(values.max())):
        at_extreme = values == extreme
        if at_extreme.mean() < _CLIPPED:
            continue
        stays = [stay for stay in stretches(at_extreme) if stay.stop - stay.start >= _STAY]
        if not stays:
            continue
        below = np.abs(values - extreme)
        cut = _cut_off(below, stays)
        noisy = white_noise(values[~at_extreme]) > finest
        # A resolution that rounds an extreme cuts off a step or less.
        if cut > 2.0 * finest and (noisy or _arrives_at_speed(below, stays, finest)):
            found.append(Limit(extreme, cut, tuple(stays)))
    return found


def _cut_off(below: Array, stays: list[slice]) -> float:
    """Height of parabolas that continue a signal over its stays; ``below`` (n,) is its distance."""
    heights = []
    for stay in stays:
        length = stay.stop - stay.start
        reach = max(length // 4, 2)
        ends = [place for place in (stay.start - reach, stay.stop - 1 + reach) if place >= 0]
        slopes = [float(below[place]) / reach for place in ends if place < below.size]
        if slopes:
            # The mean slope over a quarter of the stay before it is 1.25 times the slope at it.
            heights.append(min(slopes) / 1.25 * length / 4.0)
    return max(heights, default=0.0)


def _arrives_at_speed(below: Array, stays: list[slice], finest: float) -> bool:
    """Whether a signal reaches its extreme, at which it ``stays``, without slowing down.

    ``below`` (n,) is the distance from the extreme; ``finest`` is the finest digit of the signal.
    """
    edges = np.array([(stay.start - 1, stay.stop) for stay in stays])
    for reach in 2 ** np.arange(1, int(math.log2(below.size))):
        ways = np.concatenate(
            (edges[:, :1] - np.array([reach, 2 * reach]), edges[:, 1:] + reach * np.array([1, 2]))
        )
        ways = ways[np.all((ways >= 0) & (ways < below.size), axis=1)]
        if not ways.size:
            return False
        near, far = below[ways].mean(axis=0)
        if far > _RESOLVED * finest:
            return bool(near > _ARRIVAL_PART * far)
    return False


# -- spikes ----------------------------------------------------------------------------------

_OUTLIER, _BENT = 12.0, 4.0
"""A spike leaves its surroundings by this multiple of the noise, and of the usual bend of the
signal over its width, and comes back."""

_UNUSUAL, _USUAL_PART = 8.0, 0.95
"""A spike also exceeds this quantile of the excursions of the signal itself, by this factor."""


class Shape(NamedTuple):
    """What sets spikes apart from the signal itself.

    ``jump``: smallest height of a spike, relative to the range; ``edge``: smallest step at both its
    ends, in usual steps; ``widest``: largest width in samples; ``cycle_part``: in cycles of the
    motion.
    """

    jump: float
    edge: float
    widest: int
    cycle_part: float


SMOOTH, SHARP = Shape(0.0, 2.0, 8, 0.05), Shape(0.1, 0.0, 5, 0.02)
"""A displacement, and a force, which leaves and comes back where the motion reverses."""


_DRAWN = 50_000
"""Number of places that give a quantile."""


def spikes(values: Array, samples_per_cycle: float, shape: Shape) -> Mask:
    """Mask (n,) of the spikes of a signal: short excursions that begin and end at one level.

    ``samples_per_cycle`` of the motion limits their width.
    """
    marked = np.zeros(values.size, dtype=bool)
    least = max(_OUTLIER * white_noise(values), 2.0 * shape.jump * extent(values)[1])
    steps = np.abs(np.diff(values))
    widest = min(shape.widest, max(int(shape.cycle_part * samples_per_cycle), 1))
    widest = min(widest, (values.size - 2) // 2)
    # Quantiles of a long signal are those of places drawn at random.
    drawn = np.arange(values.size)
    if drawn.size > _DRAWN:
        drawn = np.random.default_rng(0).integers(0, values.size, _DRAWN)
    edge = shape.edge * float(np.quantile(steps[drawn[drawn < steps.size]], 0.9))
    # On the way out, one of the steps is as large as this.
    large = np.concatenate(([0], np.cumsum(steps > least / max(widest, 1))))
    for width in range(1, widest + 1):

        def beyond(starts: np.ndarray, place: int, width: int = width) -> Array:
            """How far a sample of an excursion lies beyond both the samples around it."""
            before, after = values[starts], values[starts + width + 1]
            inside = values[starts + place + 1]
            return np.maximum(
                inside - np.maximum(before, after), np.minimum(before, after) - inside
            )

        half = width // 2 + 1
        middle = drawn[(drawn >= half) & (drawn < values.size - half)]
        bends = np.abs(values[middle - half] + values[middle + half] - 2.0 * values[middle])
        limit = max(least, _BENT * 0.5 * float(np.quantile(bends, 0.9)))
        usual = drawn[drawn < values.size - width - 1]
        # The first sample after lost ones may lie beyond its neighbours, too, but on one edge.
        edges = (steps[:-width] >= edge) & (steps[width:] >= edge)
        starts = np.flatnonzero(edges & (large[width:-1] > large[: -width - 1]))
        for place in range(width):
            wild = beyond(starts, place)
            if wild.size and wild.max() > limit:
                most = max(limit, _UNUSUAL * np.quantile(beyond(usual, place), _USUAL_PART))
                marked[starts[wild > most] + place + 1] = True
    return marked


# -- held values -----------------------------------------------------------------------------

_REGULAR = 0.95
"""A channel is held if so large a part of the pauses between changes is a multiple of one."""

_UNEVEN = 0.2
"""Largest deviation of a pause from a multiple, in usual pauses, if a clock rounds it."""


def held_steps(values: Array) -> int:
    """Number of samples for which a channel (n,) holds each value; 1 if it is renewed with each.

    A coarse channel repeats values, too, but at irregular pauses.
    """
    changed = np.flatnonzero(np.diff(values))
    if changed.size < 2 * _STAY:
        return 1
    pauses = np.diff(changed)
    usual = float(np.mean(pauses[pauses <= 1.5 * np.median(pauses)]))
    if usual < 1.5:
        return 1
    off = np.abs(pauses - usual * np.maximum(np.round(pauses / usual), 1.0))
    even = off <= max(_UNEVEN * usual, 0.5 if usual % 1.0 else 0.0)
    return round(usual) if float(np.mean(even)) >= _REGULAR else 1


_LEAP = 3.0
"""A jump exceeds this multiple of the largest usual step of a displacement."""


def jumps(values: Array) -> np.ndarray:
    """Places before steps of a displacement (n,) that no motion explains: samples are missing."""
    steps = np.diff(values)
    usual = float(np.quantile(np.abs(steps), 0.99))
    places = np.flatnonzero(np.abs(steps) > max(_LEAP * usual, _OUTLIER * white_noise(values)))
    # The way out and back of a spike is no jump.
    back = (np.diff(places) <= SMOOTH.widest) & (steps[places[:-1]] * steps[places[1:]] < 0.0)
    both = np.concatenate(([False], back, [False]))
    return places[~(both[:-1] | both[1:])] if places.size else places


# -- disturbances that stand apart -----------------------------------------------------------

_WIDTHS = (0.1, 0.5, 2.0, 6.0)
"""Half-widths [Hz] of the bands in which a disturbance is looked for."""

_MOST = 0.99
"""Part of the power of a displacement that belongs to the motion, whatever disturbs it."""

_LEAST_LINES = 2
"""Smallest half-width of a band in spectral lines, which the window of the spectrum widens."""

_REACH, HARMONICS = 12.0, 2.2
"""The surroundings of a band reach so many half-widths, and multiples of the fastest motion, to
either side. The odd harmonics of the motion are two multiples apart."""

_OWN = 4
"""Half-widths to either side of a band that may belong to it, because its frequency wanders."""

_APART = 3.0
"""A band stands apart if its amplitude exceeds the largest of the surroundings by this factor."""


SIDEBANDS, _ANSWERED = 5.0, 2.0
"""Distance of the sidebands of a line, in multiples of the fastest motion, and the factor by which
a channel that answers the line exceeds its harmonics beyond."""


_STOPPED, _RINGING = 0.08, 2.0
"""Smallest half-width of a filter, relative to its frequency, and length of the samples that
continue the channel at its ends, in periods of the half-width."""


class Line(NamedTuple):
    """A disturbance: ``frequency`` [Hz], ``amplitude``, and ``width`` [Hz], half of its band."""

    frequency: float
    amplitude: float
    width: float


class Spectrum:
    """Spectrum of a channel (n,) sampled every ``period`` [s], in bands of several widths."""

    def __init__(self, values: Array, period: float) -> None:
        weights = np.hanning(values.size)
        power = np.abs(np.fft.rfft((values - values.mean()) * weights)) ** 2
        # The power of a sine of amplitude 1 is a half.
        power *= 4.0 / (float(np.sum(weights**2)) * values.size)
        self._sums = np.concatenate(([0.0], np.cumsum(power)))
        self._step = 1.0 / (values.size * period)

    @property
    def fastest(self) -> float:
        """Frequency [Hz] below which nearly all power lies."""
        return float(np.searchsorted(self._sums[1:], _MOST * self._sums[-1]) * self._step)

    def _half(self, width: float) -> int:
        """Half-width of a band in spectral lines."""
        return max(round(width / self._step), _LEAST_LINES)

    def _bands(self, width: float) -> Array:
        """Amplitude of the sine with the power of the band around each spectral line, (m,)."""
        count, half = self._sums.size - 1, self._half(width)
        lines = np.arange(count)
        last, first = np.minimum(lines + half + 1, count), np.maximum(lines - half, 0)
        return np.asarray(np.sqrt(np.maximum(self._sums[last] - self._sums[first], 0.0)))

    def amplitude(self, line: Line) -> float:
        """Amplitude of this channel in the band of a line."""
        return float(self._bands(line.width)[round(line.frequency / self._step)])

    def answers(self, line: Line, fastest: float) -> bool:
        """Whether this channel exceeds its harmonics of the motion in the band of a line.

        Where it depends on the line and on the motion, it has sidebands, too. The comparison
        therefore begins some harmonics above the line.
        """
        bands, place = self._bands(line.width), round(line.frequency / self._step)
        away = max(round(SIDEBANDS * fastest / self._step), 2 * _OWN * self._half(line.width))
        above = bands[place + away : place + 2 * away]
        return bool(above.size and bands[place] > _ANSWERED * float(above.max()))

    def standing_apart(self, fastest: float) -> list[Line]:
        """The bands that stand apart from their surroundings, the narrowest first."""
        found: list[Line] = []
        for width in _WIDTHS:
            bands = self._bands(width)
            for place in np.flatnonzero(self._stand_apart(bands, width, fastest)).tolist():
                line = Line(float(place * self._step), float(bands[place]), width)
                if not any(
                    abs(line.frequency - other.frequency) < width + other.width for other in found
                ):
                    found.append(line)
        return found

    def _stand_apart(self, bands: Array, width: float, fastest: float) -> Mask:
        """Whether each band (m,) is the largest within its half-width, and stands apart."""
        from scipy.ndimage import maximum_filter1d  # imported late: see entry_points

        half = self._half(width)
        own = _OWN * half
        reach = max(round(max(_REACH * width, HARMONICS * fastest) / self._step), 2 * own)
        stand = np.zeros(bands.size, dtype=bool)
        if bands.size <= 2 * reach:
            return stand
        # The largest of the bands before and after the own ones, for all bands at once.
        size, inside = reach - own, slice(reach, bands.size - reach)
        largest = maximum_filter1d(bands, size)[size // 2 :]
        count = bands.size - 2 * reach
        around = np.maximum(largest[:count], largest[reach + own + 1 :][:count])
        peaks = bands == maximum_filter1d(bands, 2 * half + 1)
        stand[inside] = peaks[inside] & (bands[inside] > _APART * around)
        return stand


def without_lines(values: Array, lines: list[Line], period: float) -> Array:
    """The channel (n,) without the bands of these lines, filtered forward and backward."""
    from scipy.signal import butter, sosfiltfilt  # imported late: see entry_points

    for line in lines:
        # A narrow filter would leave the line at both ends of the samples.
        half = max(2.0 * line.width, _STOPPED * line.frequency)
        ends_of_band = line.frequency + np.array([-half, half])
        band = np.clip(ends_of_band, 0.5 * line.frequency, 0.499 / period)
        stop = butter(2, band, "bandstop", fs=1.0 / period, output="sos")
        ends = min(round(_RINGING / (half * period)), values.size - 1)
        values = sosfiltfilt(stop, values, padlen=ends)
    return np.asarray(values)
