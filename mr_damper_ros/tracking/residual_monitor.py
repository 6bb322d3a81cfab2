"""The residual monitor: compares the predicted force with the force measured in the same samples.

:class:`ForceStatistics` holds the peak, the noise and the power of the measured force over the
recent cycles. :class:`ResidualMonitor` decides when the predicted force is wrong. It monitors two
errors, both relative to the peak. The error of a sample makes that sample invalid at once. The root
mean square error over a half-cycle shows that the parameters are wrong in part of the cycle, as
where the current is late; while it is too large, noise cannot excuse the error of a sample.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from itertools import compress
from operator import mul, not_

import numpy as np

from mr_damper_ros.data_check.samples import NEGATIVE_POWER, SMALLEST_FORCE, wrong_unit
from mr_damper_ros.kinematics.peak_velocity import HALF_CYCLES
from mr_damper_ros.models.quantities import NOTICED, SAME_CURRENT
from mr_damper_ros.signals.arrays import SIGMAS, Array, RollingRows, span_of, white_noise
from mr_damper_ros.tracking.bumpless_transfer import FADE_TIME
from mr_damper_ros.tracking.operating_point import RECENT
from mr_damper_ros.tracking.validity import (
    NO_DOUBT,
    Doubt,
    DoubtKind,
    ErrorLimit,
    Objection,
    middle,
)

_SHORTEST_MEMORY = 2.0
_LONGEST_MEMORY = 120.0
"""The memory covers ``HALF_CYCLES`` half-cycles, limited to these times [s]. If the motion is not
steady, the half-cycles may all be small or belong to an earlier motion; the peak then covers
``RECENT`` seconds, or a cycle if that is longer. The power is averaged over half as many
half-cycles, in which a spring returns its energy."""

_SHORTEST = 0.2
"""Shortest time [s] over which the root mean square error is computed. A force must be constant for
at least twice this time to count as a fault, because a short half-cycle is inaccurate."""

_OUTLIER_EVERY = 20
"""At either end, the span excludes one in this many samples of a stretch, as possible outliers."""

_FEWEST = 4
"""Spans of at most this many samples exclude none."""

_TAIL, _PEAKED = 0.025, 2.0
"""The span of the force is at most the second value times the one that excludes the first part of
the time at either end, a 95 % quantile. A damper exceeds it by less, and a knock, a loose plug or
an amplifier in saturation is shorter."""

_POINTS = 16
"""Number of quantiles that represent the measured force of a stretch."""

_STRETCHES = 32
_LONGEST_STRETCH = 0.25
"""The memory is divided into this many stretches, each no longer than this time [s]."""

_ENOUGH = _STEADY_CURRENT = 1.0
"""Time [s] after which a constant current is steady, and after which agreement in slow motion
suffices: the largest time for which a wrong force may be valid (benchmark figure
``foreign_wrong_valid_s``)."""

_PRELOAD = 0.5
"""The offset of the force, which gas pressure causes, counts towards the peak up to this fraction
of half the span. A larger offset comes from a load cell that was not zeroed, and does not count."""


class ForceStatistics:
    """Running force statistics over some cycles of samples ``period`` [s] apart.

    ``peak`` and ``centre`` [N] are the largest magnitude of the measured force and the middle of
    its span, without outliers and at most twice the 95 % quantile; NaN before the first stretch. If
    the motion is not steady, they cover the longer of ten seconds and a cycle. Forces at other
    currents count for at most ten seconds, and only until the present current has lasted for a
    cycle. In a cycle of more than ten seconds at a steady current, they count up to the largest
    force of the set at this current.
    ``noise`` [N] is the standard deviation of the white part of the measured force. ``stuck`` says
    that this force has been constant for a half-cycle, ``measured_drives`` and ``predicted_drives``
    that the measured or predicted force is not dissipative.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        # Predicted and measured force, velocity and current of the present stretch.
        self._parts: list[tuple[Array, Array, Array, Array]] = []
        self._count = 0
        self._stretch = max(round(_SHORTEST_MEMORY / _STRETCHES / period), 1)
        # A column for each stretch: number of samples; highest, lowest and noise of the measured
        # force f; lowest and highest current; whether the stretch before had the same current;
        # quantiles of f; the sums of the velocity v, of f, v², v f and f²; those of the predicted
        # force p, v p and p².
        self._past = RollingRows(7 + _POINTS + 8)
        self._unchanged = 0
        self.peak = math.nan
        self.centre = math.nan
        self.noise = 0.0
        self.stuck = False
        self.measured_drives = False
        self.predicted_drives = False

    def add(
        self,
        forces: tuple[Array, Array],
        velocity: Array,
        current: Array,
        half_cycle: float,
        *,
        steady: bool,
        largest: Callable[[], float],
    ) -> None:
        """Add samples (n,) of predicted and measured force [N], velocity [m/s] and current [A].

        ``half_cycle`` [s] of the motion is NaN if unknown. ``steady`` says whether the motion is a
        continuing sine. ``largest`` returns the largest force [N] that the set gives in a cycle at
        the present current.
        """
        self._parts.append((*forces, velocity, current))
        self._count += velocity.size
        if self._count >= self._stretch:
            self._finish(half_cycle, steady, largest)

    def forget_predicted(self) -> None:
        """Discard the predicted forces, because they belong to other parameters."""
        self.predicted_drives = False
        self._parts = [(np.zeros(part[0].size), *part[1:]) for part in self._parts]
        self._past.newest[-3:] = 0.0

    def _finish(self, half_cycle: float, steady: bool, largest: Callable[[], float]) -> None:
        predicted, measured, velocity, current = np.concatenate(self._parts, axis=1)
        low, high = span_of(current)
        count, self._count = self._count, 0
        self._parts.clear()
        if not np.isfinite(predicted).all():
            predicted = np.zeros(count)
        noise, unchanged = white_noise(measured), np.ptp(measured) == 0.0
        wild = max(count // _OUTLIER_EVERY, 1) if count > _FEWEST else 0
        ordered = np.sort(measured)
        bottom, top = ordered[[wild, -1 - wild]].tolist()
        points = ordered[((np.arange(_POINTS) + 0.5) * count / _POINTS).astype(int)]
        measured = measured.clip(bottom, top)
        settled = True
        if self._past.count:
            _, top_before, bottom_before, _, low_before, high_before, *_ = self._past.newest[:, -1]
            unchanged = unchanged and top == top_before == bottom_before
            settled = max(high - low_before, high_before - low) <= SAME_CURRENT
        self._unchanged = self._unchanged + count if unchanged else 0
        with np.errstate(over="ignore", invalid="ignore"):
            sums = (
                *(velocity.sum(), measured.sum()),
                *(velocity @ velocity, velocity @ measured, measured @ measured),
                *(predicted.sum(), velocity @ predicted, predicted @ predicted),
            )
        self._past.add((count, top, bottom, noise, low, high, settled, *points, *sums), 1)
        # While the half-cycle is unknown, the memory is as short as possible.
        known = 0.0 if math.isnan(half_cycle) else half_cycle
        memory = min(max(HALF_CYCLES * known, _SHORTEST_MEMORY), _LONGEST_MEMORY)
        self._stretch = max(round(min(memory / _STRETCHES, _LONGEST_STRETCH) / self._period), 1)
        unsteady = min(max(2.0 * known, RECENT), _LONGEST_MEMORY)
        newest_first = self._past.newest[:, ::-1]
        # Age [s] of the end of each stretch.
        ages = (newest_first[0].cumsum() - newest_first[0]) * self._period
        self._past.keep(int(np.count_nonzero(ages < max(memory, unsteady))))
        recent = newest_first[:, ages < memory]
        self.noise = middle(recent[3])
        self._judge_span(
            newest_first[:, ages < (memory if steady else unsteady)], 2.0 * known, largest
        )
        self._judge_power(newest_first[:, ages < 0.5 * HALF_CYCLES * known], known)

    def _judge_span(self, stretches: Array, cycle: float, largest: Callable[[], float]) -> None:
        """Compute peak and centre from stretches, newest first, with a ``cycle`` [s] of motion."""
        counts, tops, bottoms, _, lows, highs, settled = stretches[:7]
        current = highs[0]
        here = (settled > 0.0) & (abs(lows - current) <= SAME_CURRENT)
        here &= abs(highs - current) <= SAME_CURRENT
        stayed = float(counts[np.logical_and.accumulate(here)].sum()) * self._period
        ages = (counts.cumsum() - counts) * self._period
        others = 0.0 if stayed >= max(cycle, _SHORTEST_MEMORY) else RECENT
        counted = here | (ages < others)
        top, bottom = float(tops[counted].max()), float(bottoms[counted].min())
        if not here.all() and cycle > RECENT and stayed >= _STEADY_CURRENT:
            most = largest()
            top = max(min(top, most), float(tops[here].max()))
            bottom = min(max(bottom, -most), float(bottoms[here].min()))
        # A current that has just changed is represented by its own forces.
        own = here if here.any() else np.arange(here.size) == 0
        low, high = _span(stretches[:, counted])
        if not np.array_equal(own, counted):
            lowest, highest = _span(stretches[:, own])
            low, high = min(low, lowest), max(high, highest)
        half, between = 0.5 * (high - low), 0.5 * (high + low)
        top = min(top, between + _PEAKED * half)
        bottom = max(bottom, between - _PEAKED * half)
        half, self.centre = 0.5 * (top - bottom), 0.5 * (top + bottom)
        self.peak = half + min(abs(self.centre), _PRELOAD * half)

    def _judge_power(self, stretches: Array, half_cycle: float) -> None:
        self.stuck = self._unchanged * self._period > max(half_cycle, 2.0 * _SHORTEST)
        self.measured_drives = self.predicted_drives = False
        count = float(stretches[0].sum())
        if half_cycle == 0.0 or count * self._period < 0.25 * HALF_CYCLES * half_cycle:
            return
        with np.errstate(over="ignore", invalid="ignore"):
            v, f, vv, vf, ff, p, vp, pp = stretches[-8:].sum(axis=1).tolist()
            speed = math.sqrt(max(vv - v * v / count, 0.0))

            def drives(mean: float, power: float, squares: float) -> bool:
                size = math.sqrt(max(squares - mean * mean / count, 0.0))
                return bool(power - v * mean / count < -NEGATIVE_POWER * speed * size)

            if speed > 0.0:
                self.measured_drives = drives(f, vf, ff)
                self.predicted_drives = drives(p, vp, pp)


def _span(stretches: Array) -> tuple[float, float]:
    """Lowest and highest measured force [N] of stretches, without the tails."""
    forces = stretches[7 : 7 + _POINTS].ravel()
    order = np.argsort(forces)
    time = np.tile(stretches[0], _POINTS)[order].cumsum()
    bottom, top = np.searchsorted(time, (_TAIL * time[-1], (1.0 - _TAIL) * time[-1]))
    return float(forces[order[bottom]]), float(forces[order[top]])


_USED_PART = 0.98
"""Fraction of the limit that is used for the error of a sample, because the peak is uncertain."""

_NOISY_PART, _NOISY_SIGMAS = 0.68, 2.0
"""With much noise the limit is this fraction of the nominal limit plus this many standard
deviations, so that noise alone rarely makes a force invalid, and only at single samples."""

_LARGEST_ENTRY = 1.5
"""Each error enters the root mean square with at most this multiple of its limit, so that the
effect of a burst ends soon."""

_RECOVERED = 0.9
"""An error must fall below this fraction of its limit before the force is valid again."""

_CALM_TIME, _CALM_PART, _WRONG_PART = 0.02, 0.1, 0.125
"""A wrong force is valid again once the error has been small for the shortest of three times: the
first value [s], the second value times the half-cycle, and the third value times the time during
which the force was wrong. If the error jumps by more than the peak between two samples, the
measured samples count as outliers until the error is small again, for at most the first value [s].
"""


_STUCK = Objection(
    DoubtKind.SENSOR,
    "the measured force is constant although the damper moves: is the load cell connected? without "
    "a load cell set maximum_error to 0",
)
_MEASURED_DRIVES = Objection(
    DoubtKind.SENSOR,
    "the measured force is not dissipative: has the sign of the force or of the displacement "
    "changed?",
)
_DRIVING = Objection(
    DoubtKind.DRIVING,
    "the predicted force is not dissipative: do the parameters belong to this damper, and are the "
    "signs of force and displacement right?",
)


@lru_cache(maxsize=16)
def _decays(count: int, period: float) -> Array:
    """What is left of a difference that fades in ``FADE_TIME``, at the next samples (n,)."""
    return np.exp(-period / FADE_TIME * np.arange(1, count + 1))


class LoadCellZero:
    """Estimates the force that the load cell shows without a load.

    A set that was identified in another run does not contain the zero of this run. The zero is the
    mean difference of the measured force and the force of the set over the whole cycles since the
    motion began, in which friction, lag and an error of the gain cancel. It is reduced by its
    standard error (James-Stein), with each half-cycle as one independent sample.
    """

    def __init__(self) -> None:
        self._zeros, self._target = np.zeros(1), 0.0
        self.restart()

    @property
    def present(self) -> float:
        """The zero [N] at the last sample."""
        return float(self._zeros[-1])

    def restart(self) -> None:
        """Begin a new estimate after an interruption of the motion; keep the present zero."""
        # Number, sum and sum of squares of the differences; half-cycles before them and in them.
        self._sums, self._before, self._half_cycles = np.zeros(3), -1, 0

    def follow(self, count: int, period: float, *, counts: bool) -> Array:
        """The zero [N] at the next ``count`` samples; it fades to 0 if it does not count."""
        target = self._target if counts else 0.0
        self._zeros = target + (self.present - target) * _decays(count, period)
        return self._zeros

    def learn(self, residual: Array, reversals: int, largest: float) -> None:
        """Learn from the measured minus the predicted force (n,) [N] of the last samples.

        ``reversals`` is the number of reversals of the motion. The zero is at most ``largest`` [N].
        """
        if self._before < 0:
            self._before = reversals
        most = _LARGEST_ENTRY * largest
        left = (residual + self._zeros[self._zeros.size - residual.size :]).clip(-most, most)
        self._sums += (left.size, left.sum(), left @ left)
        if reversals - self._before >= self._half_cycles + 2:
            self._half_cycles = reversals - self._before
            mean, square = (self._sums[1:] / self._sums[0]).tolist()
            variance = max(square - mean**2, 0.0) / self._half_cycles
            shrunk = mean * (1.0 - variance / mean**2) if mean**2 > variance else 0.0
            self._target = min(max(shrunk, -largest), largest)


class ResidualMonitor:
    """Monitors the forces of samples ``period`` [s] apart, with the statistics ``recent``.

    ``maximum_error`` is relative to the peak of the measured force; 0 ignores the measured force.
    ``largest_error`` [N] limits the same errors; 0: it does not. Without ``recent`` the monitor has
    statistics of its own.
    """

    def __init__(
        self,
        period: float,
        limit: ErrorLimit,
        recent: ForceStatistics | None = None,
    ) -> None:
        self._period = period
        self._limit = limit
        self.recent = ForceStatistics(period) if recent is None else recent
        self._time = _SHORTEST
        # Mean square [1] of the error over the peak.
        self._square = 0.0
        self.is_wrong = False
        # The error [N] of the last sample, and the number of outliers in a row.
        self._error, self._wild_for = 0.0, 0
        self._longest_wild = max(round(_CALM_TIME / period), 1)
        # Samples with a small error until the force is valid again, and the largest such number.
        self._wait, self._calm = 0.0, _CALM_TIME / period
        # Seconds for which the forces have been compared without interruption, and that suffice.
        self._compared, self._enough = 0.0, _ENOUGH

    @property
    def holds(self) -> bool:
        """Whether the predicted force has agreed with the measured force over the last half-cycle.

        One second suffices in slow motion, and is needed while the half-cycle is unknown. A short
        error counts while it lasts, and afterwards only through the root mean square.
        """
        return self._compared >= self._enough and not (self.is_wrong or self._wait)

    @property
    def doubt(self) -> Doubt:
        """Why the set is wrong in part of the cycle, also while single samples are right."""
        if not self.is_wrong:
            return NO_DOUBT
        return Doubt(
            DoubtKind.WRONG,
            f"the RMS error of the predicted force was {math.sqrt(self._square):.0%} of the peak "
            f"over the last half-cycle: the set is right again below "
            f"{_RECOVERED * self._limit.part_of(self.recent.peak):.0%}",
        )

    @property
    def allowed(self) -> float:
        """Largest error [N] of a valid sample; infinite if no force is measured."""
        peak = self.recent.peak
        if self._limit.relative == 0.0 or not peak > 0.0:
            return math.inf
        return self._allowed(self._limit.at(peak))

    def forget_error(self, known: float = math.nan) -> None:
        """Reset the root mean square error after a change of parameters.

        If the previous parameters were wrong, the error restarts at the limit, so that the new
        parameters must first prove correct. If their error ``known`` [N] is given, it restarts at
        that value.
        """
        if known < math.inf and self.recent.peak > 0.0:
            self._square = (known / self.recent.peak) ** 2
            self.is_wrong, self._wait = False, 0.0
        elif self.is_wrong:
            self._square = self._limit.part_of(self.recent.peak) ** 2
        self.recent.forget_predicted()

    def forget_moment(self) -> None:
        """Restart the comparison after samples whose force was unknown or not compared."""
        self._square = self._compared = self._error = 0.0
        self.is_wrong, self._wait, self._wild_for = False, 0.0, 0

    def judge(self, predicted: Array, measured: Array) -> list[Objection] | None:
        """Process the forces (n,) [N] of the next samples; returns the objections to them.

        Returns None if they could not be compared, because the statistics do not exist yet.
        """
        recent, peak = self.recent, self.recent.peak
        if self._limit.relative == 0.0:
            return [_DRIVING] if recent.predicted_drives else []
        if math.isnan(peak):
            return None
        found = [_STUCK] if recent.stuck else []
        if recent.measured_drives:
            found.append(_MEASURED_DRIVES)
        if peak == 0.0:
            return found
        if peak < SMALLEST_FORCE:
            finding = wrong_unit("force", "reaches only", peak, "kilonewtons")
            found.append(Objection(DoubtKind.SENSOR, finding.sentence))
        errors: list[float] = (predicted - measured).tolist()
        limit = self._limit.at(peak)
        wrong, wild = self._wrong_samples(errors, measured.tolist())
        self._follow([*compress(errors, map(not_, wild))])
        if any(wild):
            outliers = np.array(wild)
            sentence = (
                f"the measured force jumps to {measured[outliers][-1]:.4g} N at a peak of "
                f"{peak:.3g} N: check the load cell's cable for a loose contact or interference"
            )
            found.append(Objection(DoubtKind.SENSOR, sentence, outliers))
        if not any(wrong):
            return found
        worst = max(map(abs, compress(errors, wrong)))
        sentence = (
            f"the error of the predicted force is {worst:.3g} N at a measured peak of "
            f"{peak:.3g} N: maximum_error and largest_error allow {limit:.3g} N"
        )
        where = np.array(wrong)
        if recent.predicted_drives:
            # A force that agrees with the measured force is as dissipative as the measured one.
            found.append(_DRIVING._replace(where=where))
        return [*found, Objection(DoubtKind.WRONG, sentence, where)]

    def adapt(self, half_cycle: float) -> None:
        """Adapt the times to the ``half_cycle`` [s] of the motion, NaN if unknown."""
        if not math.isnan(half_cycle):
            self._calm = min(_CALM_TIME, _CALM_PART * half_cycle) / self._period
            self._time = max(half_cycle, _SHORTEST)
            self._enough = min(self._time, _ENOUGH)

    def _wrong_samples(
        self, errors: list[float], measured: list[float]
    ) -> tuple[list[bool], list[bool]]:
        """Whether each of n samples has too large an error, and whether it is an outlier.

        ``errors`` [N] are predicted minus ``measured`` force.
        """
        before, self._error = self._error, errors[-1]
        wrong, wild = [False] * len(errors), [False] * len(errors)
        right_up_to = self._right_up_to(self._limit.at(self.recent.peak))
        if self._wait == 0.0 and max(map(abs, errors)) <= right_up_to:
            self._wild_for = 0
            return wrong, wild
        peak, centre = self.recent.peak, self.recent.centre
        for k, (error, force) in enumerate(zip(errors, measured, strict=True)):
            # If the force grows beyond the recent peak, the limit grows with it.
            largest = max(abs(force - centre), peak)
            size, jumps = abs(error), abs(error - before) > peak
            before, begins = error, size > self._right_up_to(self._limit.at(largest))
            if begins and (jumps or 0 < self._wild_for < self._longest_wild):
                self._wild_for += 1
                wild[k] = True
                continue
            self._wild_for = 0
            stays = self._wait and size > self._allowed(_RECOVERED * self._limit.at(largest))
            if begins or stays:
                self._wait = min(self._wait + _WRONG_PART, self._calm)
                wrong[k] = True
            elif self._wait:
                wrong[k] = self._wait >= 1.0
                self._wait = max(self._wait - 1.0, 0.0)
        return wrong, wild

    def _follow(self, errors: list[float]) -> None:
        """Update the root mean square error with the errors [N] of the next samples."""
        count, peak = len(errors), self.recent.peak
        self._compared += count * self._period
        if count == 0:
            return
        limit = self._limit.at(peak)
        most = _LARGEST_ENTRY * limit
        if max(map(abs, errors)) > most:
            errors = [min(max(error, -most), most) for error in errors]
        square = (sum(map(mul, errors, errors)) / count - self._noise**2) / peak**2
        part = min(count * self._period / self._time, 1.0)
        self._square += part * (square - self._square)
        lasting = self._limit.part_of(peak) * (_RECOVERED if self.is_wrong else 1.0)
        self.is_wrong = self._square > lasting**2

    def _allowed(self, limit: float) -> float:
        """Limit [N] of the error of a sample: noise may hide part of it, or look like an error."""
        return max(
            _USED_PART * limit - SIGMAS * self._noise,
            _NOISY_PART * limit + _NOISY_SIGMAS * self._noise,
        )

    def _right_up_to(self, limit: float) -> float:
        """Limit [N] of the error of a right sample.

        While the root mean square error is too large, the set is wrong in part of the cycle: noise
        may then hide nothing, but a sample with a small error is right.
        """
        if self.is_wrong:
            return _USED_PART * _RECOVERED * limit - SIGMAS * self._noise
        return self._allowed(limit)

    @property
    def _noise(self) -> float:
        return min(self.recent.noise, NOTICED * self.recent.peak)
