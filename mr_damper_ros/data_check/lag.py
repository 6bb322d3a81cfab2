"""Delay between force and motion: skew of the channels, and hysteresis that runs backward."""

from __future__ import annotations

import math

import numpy as np

from mr_damper_ros.data_check.channels import extent
from mr_damper_ros.kinematics.motion import SavitzkyGolay
from mr_damper_ros.signals.arrays import NORMAL_MEDIAN, Array

_FEWEST = 8
"""Smallest number of reversals that determine a shift."""

_SMOOTHED = 40.0
"""The half-width of the smoothing is the median cycle divided by this."""

_SMALL = 0.25
"""Fraction of the 90 % quantile of the speed that must be reached between two reversals."""

_CROSSING_PART = 0.25
"""Fraction of a cycle around a reversal in which the force must cross zero."""

_CYCLE_RATIO = 1.3
"""Smallest ratio of the longest to the shortest cycle, without a tenth at either end."""

_FAR = 4.0

_LAW_ERROR = 4e-4
"""Additional standard error [s], because hysteresis is not exactly a fraction of the cycle. It is
the error of the skew for emulated dampers without skew."""

_PARTS, _DRAWN = 20, 10_000
"""Largest number of parts whose scatter gives the error of the lead, and of samples."""

_EXPLAINED = 1e-3
"""Part of the squares of a force that is left where no lead is needed to explain it."""

_MUCH_BETTER = 0.3
"""Part of the squares without a lead that is left by any lead, however long, that is a fault."""

_HEAVIEST = 50.0
"""Largest mass [kg] between load cell and damper."""

_LARGEST_LEAD, _SLOW = 0.2, (0.02, 0.15)
"""Largest lead or lag that is tried, in cycles, and the parts of the 90 % quantile of the speed
within which the direction of the motion changes: at once, and gradually."""

_PAST_CYCLES, _EQUAL_CYCLES = 4, 0.05
"""Number of past cycles that affect the hysteresis, and their largest relative difference."""


_USUAL = 0.75
"""Quantile of speed and distance that gives the frequency of a motion."""

_UNKNOWN = (math.nan, math.inf)


def _coarse(displacement: Array, period: float) -> tuple[Array, Array]:
    """Displacement about its middle and velocity, of means over 5 ms, which hold little noise."""
    size = max(round(5e-3 / period), 1)
    means = displacement[: displacement.size // size * size].reshape(-1, size).mean(axis=1)
    middle = float(np.median(means)) if means.size else 0.0
    return means - middle, np.diff(means) / (size * period)


def motion_frequency(displacement: Array, period: float) -> float:
    """Approximate frequency [Hz] of a motion (n,), 0 if it cannot be estimated.

    Quantiles ignore spikes and rests; those of a sine are proportional to its amplitude.
    """
    distances, speeds = _coarse(displacement, period)
    if speeds.size < 2:
        return 0.0
    distance, speed = (float(np.quantile(np.abs(x), _USUAL)) for x in (distances, speeds))
    return speed / (2.0 * math.pi * distance) if distance > 0.0 else 0.0


def usual_speed(displacement: Array, period: float) -> float:
    """Root mean square of the velocity [m/s] of a motion (n,) [m]."""
    return float(np.sqrt(np.mean(_coarse(displacement, period)[1] ** 2)))


def _smoother(displacement: Array, period: float) -> SavitzkyGolay | None:
    """Smoothing over a small part of a cycle; None for too few samples."""
    frequency = motion_frequency(displacement, period)
    half = max(round(1.0 / (_SMOOTHED * frequency * period)), 3) if frequency else 3
    return SavitzkyGolay(2 * half + 1, 3) if displacement.size >= 8 * half + 4 else None


def smooth_velocity(displacement: Array, period: float) -> Array:
    """Velocity [m/s] of a displacement (n,) [m], smoothed over a small part of a cycle, (n,)."""
    smooth = _smoother(displacement, period)
    if smooth is None:
        return np.gradient(displacement, period)
    return smooth.derivative(displacement, 1, period)


def force_lead(displacement: Array, force: Array, period: float) -> tuple[float, float]:
    """How much earlier than the motion (n,) the force (n,) reverses [s], and its standard error.

    The force is explained by the direction of the motion, its velocity, a preload, a spring and a
    mass up to the largest one. The lead is the shift of direction and velocity with which the least
    is left. The error follows from the scatter of parts of the record. The lead is NaN, with an
    infinite error, if it cannot be estimated, or if there is none: a hysteresis is a lag.
    """
    smooth, frequency = _smoother(displacement, period), motion_frequency(displacement, period)
    if smooth is None or not frequency:
        return _UNKNOWN
    reach = max(round(_LARGEST_LEAD / (frequency * period)), 2)
    places = np.arange(max(reach, smooth.length), force.size - max(reach, smooth.length))
    # Parts of whole cycles, because a part of a cycle has a lead of its own.
    count = min(int(places.size * frequency * period), _PARTS)
    if count < 2:
        return _UNKNOWN
    if places.size > _DRAWN:
        places = np.sort(np.random.default_rng(0).choice(places, _DRAWN, replace=False))
    velocity = smooth.derivative(displacement, 1, period)
    velocity /= float(np.quantile(np.abs(velocity), 0.9))
    moving = np.stack((*(np.tanh(velocity / part) for part in _SLOW), velocity))
    mass = _HEAVIEST * smooth.derivative(displacement, 2, period)[places]
    # At the frequency of the motion, a spring is a negative mass.
    spring = -_HEAVIEST * (2.0 * math.pi * frequency) ** 2 * displacement[places]
    fixed = np.stack((np.ones(places.size), spring, mass, force[places] - mass))

    def left(lead: int) -> Array:
        """Squares that are left of the whole record, and of it without each part."""
        rows = np.concatenate((moving[:, places + lead], fixed))
        sums = np.stack([part @ part.T for part in np.array_split(rows, count, axis=1)])
        whole, found = sums.sum(axis=0), []
        for each in (whole, *(whole - sums)):
            rest, factors = _rest(each)
            if factors[-2] + factors[-1] > 0.0:
                rest, _ = _rest(np.delete(np.delete(each, (-3, -2), axis=0), (-3, -2), axis=1))
            found.append(rest)
        return np.array(found)

    sizes = {round(reach * 0.75**k) for k in range(16)}
    leads = np.array(sorted(sizes | {-size for size in sizes} | {0}))
    coarse = np.array([left(lead)[0] for lead in leads.tolist()])
    best = int(np.argmin(coarse))
    # Some sound dampers seem to lead by a tenth of a cycle, but that hardly explains their force
    # better (false_findings).
    part = max(1.0 - 2.0 * math.pi * frequency * period * leads[best], _MUCH_BETTER)
    without = coarse[leads <= 0].min()
    unexplained = without > _EXPLAINED * places.size * float(np.var(force[places]))
    if not (leads[best] > 0 and unexplained and coarse[best] <= part * without):
        return _UNKNOWN
    around = leads[best - 1 : best + 2]
    leads = np.unique(np.linspace(around[0], around[-1], 9).astype(int))
    rests = np.stack([left(lead) for lead in leads.tolist()])
    lead, *others = [period * _lowest(leads, rest) for rest in rests.T]
    return lead, math.sqrt((count - 1) * float(np.var(others)))


def _lowest(places: Array, values: Array) -> float:
    """The place at the minimum of a parabola through the smallest of some values (m,)."""
    near = int(np.clip(np.argmin(values), 1, places.size - 2)) + np.array([-1, 0, 1])
    bend, slope, _ = np.polyfit(places[near], values[near], 2)
    least = -0.5 * slope / bend if bend > 0.0 else math.inf
    return float(least if places[near[0]] <= least <= places[near[2]] else places[near[1]])


def _rest(products: Array) -> tuple[float, Array]:
    """Squares that are left of the last of some rows by the others (m,), and their factors.

    ``products`` (m + 1, m + 1) are the scalar products of the rows.
    """
    factors = np.linalg.lstsq(products[:-1, :-1], products[:-1, -1], rcond=None)[0]
    return float(products[-1, -1] - products[-1, :-1] @ factors), np.asarray(factors)


def channel_skew(displacement: Array, force: Array, period: float) -> tuple[float, float]:
    """How much later than the displacement (n,) the force (n,) is measured [s], and the error [s].

    After a reversal, the damper force crosses zero with a delay. One part is the hysteresis, a
    fraction of the cycle (v_h is proportional to the peak velocity). The other part is the skew of
    the channels, a constant time. At several frequencies, the delay is a linear function of the
    cycle length, and the skew is its intercept; one frequency cannot separate them. A constant lag
    in the damper itself, as from a compliant mount or fluid, counts as skew. A skew that cannot be
    estimated is NaN, with an infinite standard error.
    """
    smooth = _smoother(displacement, period)
    if smooth is None:
        return _UNKNOWN
    velocity = smooth.derivative(displacement, 1, period)
    turns, direction = _reversals(velocity, _SMALL * float(np.quantile(np.abs(velocity), 0.9)))
    if turns.size < 2 * _FEWEST:
        return _UNKNOWN
    zeros, rising = _reversals(smooth.derivative(force - extent(force)[0]), 0.0)
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
    return _intercept(lags, cycles)


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


def are_several(cycles: Array) -> bool:
    """Whether cycles (n,) of several lengths are enough to tell a shift from a hysteresis."""
    enough = cycles.size >= _FEWEST
    return bool(enough and np.quantile(cycles, 0.9) > _CYCLE_RATIO * np.quantile(cycles, 0.1))


def _intercept(lags: Array, cycles: Array) -> tuple[float, float]:
    """Lag (n,) at a cycle of length 0 [s], and its standard error; errors grow with length (n,)."""
    if not are_several(cycles):
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
