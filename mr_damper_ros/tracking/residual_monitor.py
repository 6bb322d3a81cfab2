"""Holds the predicted force against the one that was measured in the same samples.

Two errors are followed, both as parts of the recent peak of the measured force: that of every
sample, which tells at once that the force is wrong now, and the root mean square over a half-
cycle, which tells that the parameters are: then nothing is valid until they are right again.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from mr_damper_ros.signals.arrays import Array, Mask
from mr_damper_ros.tracking.force_statistics import ForceStatistics
from mr_damper_ros.tracking.validity import NO_DOUBT, Doubt, DoubtKind

_SEEN = 0.98
"""Part of the allowed error that a sample may have: the peak is known no better ..."""

_CHANCE = 3.0
"""... less so many standard deviations of the noise, which may hide as much of it ..."""

_SAMPLE, _RARE = 0.68, 2.0
"""... but with much noise this part and so many more: noise alone is seldom a wrong force, and then
for a sample."""

_LASTING = 1.0
"""Part of the allowed error that the root mean square over a half-cycle may reach."""

_MOST_REMEMBERED = 1.5
"""A burst counts no more than so many times that limit: it must not be remembered for ever."""

_BACK = 0.9
"""Part of either limit that the error must fall below again."""

_CALM, _CALM_PART, _AS_LONG = 0.02, 0.1, 0.125
"""A force is valid again once it has been right for so many seconds, or this part of a half-cycle,
or the last part of the time for which it was wrong, whichever is least."""

_JUMP, _LONGEST_WILD = 1.0, 0.02
"""Samples of the measured force are wild whose error has jumped by so many peaks from one to the
next, until it is small again; after so many seconds the force is taken to be such."""

_ENOUGH = 4.0
"""Seconds for which a force was right, if a cycle is longer: those of two windows."""

_MOST_NOISE = 0.1
"""What looks like noise is taken for it up to this part of the peak."""

_SHORTEST, _LONGEST = 0.2, 20.0
"""Seconds within which the half-cycle lies over which a lasting error is taken."""


class ResidualMonitor:
    """Watches the forces of samples ``period`` [s] apart.

    ``maximum_error`` is a part of the peak of the measured force; 0: that force is not looked at.
    """

    def __init__(self, period: float, maximum_error: float) -> None:
        self._period = period
        self._limit = maximum_error
        self._recent = ForceStatistics(period)
        self._time = _SHORTEST
        # Mean square [1] of the error over the peak.
        self._square = 0.0
        self._wrong = False
        # The error [N] of the last sample, and for how many samples the measured force is wild.
        self._error, self._wild_for = 0.0, 0
        self._longest_wild = max(round(_LONGEST_WILD / period), 1)
        # Samples until one that is right is valid again, and how many those are at most.
        self._wait, self._calm = 0.0, _CALM / period
        # Seconds for which the forces have been compared without a break.
        self._compared = 0.0
        self._cycle_known = False

    @property
    def holds(self) -> bool:
        """Whether the predicted force is right, and was over the last cycle, by the measured one.

        Or over so many seconds of it as are enough.

        A moment in which it was wrong is over with that moment, but for what it adds to the rest.
        """
        enough = min(2.0 * self._time, _ENOUGH)
        return self._cycle_known and self._compared >= enough and not (self._wrong or self._wait)

    @property
    def allowed(self) -> float:
        """Error [N] that a sample may have; infinite where no force is measured."""
        peak = self._recent.peak
        if self._limit == 0.0 or not peak > 0.0:
            return math.inf
        return self._allowed(self._limit * peak, self._noise(peak))

    def forget_error(self, known: float = math.nan) -> None:
        """Other parameters: the lasting error of those before says nothing of them.

        Where they were wrong these have to show first that they are not, unless their error [N] is
        ``known``, from what has been measured before.
        """
        if known < math.inf and self._recent.peak > 0.0:
            self._square = (known / self._recent.peak) ** 2
            self._wrong, self._wait = False, 0.0
        elif self._wrong:
            self._square = (_LASTING * self._limit) ** 2
        self._recent.forget_predicted()

    def forget_moment(self) -> None:
        """The samples do not go on from where the force could be known, or were not judged."""
        self._square = self._compared = self._error = 0.0
        self._wrong, self._wait, self._wild_for = False, 0.0, 0

    def judge(self, predicted: Array, measured: Array) -> list[Doubt]:
        """Follow the forces (n,) [N] of the next samples: why to doubt the predicted ones."""
        if self._limit == 0.0:
            return [self._doubt_of_power()]
        peak = self._recent.peak
        if not peak > 0.0:
            # Nothing is known of the force yet, or it never changed.
            return [self._doubt_of_sensor()] if peak == 0.0 else []
        errors = predicted - measured
        sizes = np.abs(errors)
        if not float(sizes.max()) < math.inf:
            return [Doubt(DoubtKind.WRONG, "the predicted force has no finite error")]
        wrong, wild = self._wrong_samples(errors, sizes, measured, peak)
        self._follow(sizes if wild is None else sizes[~wild], peak)
        doubts = [self._doubt_of_sensor()]
        if wild is not None:
            doubts.append(self._doubt_of_wild(measured[wild], peak, wild))
        if self._wrong or wrong is not None:
            error = self._doubt_of_error(sizes, peak, wrong)
            # One that agrees with the measured force drives the motion no more than that does.
            doubts += [replace(self._doubt_of_power(), at=error.at), error]
        return doubts

    def learn(
        self,
        forces: tuple[Array, Array],
        velocity: Array,
        current: Array | float,
        half_cycle: float,
        *,
        steady: bool,
    ) -> None:
        """What only later samples need of these; arrays of shape (n,).

        ``forces`` [N], predicted and measured; ``velocity`` [m/s]; ``current`` [A], also a
        number; ``half_cycle`` [s] of the motion, NaN before it is known; ``steady``: whether that
        is a sine that goes on.
        """
        self._recent.add(forces, velocity, current, half_cycle, steady=steady)
        self._cycle_known = not math.isnan(half_cycle)
        if self._cycle_known:
            self._calm = min(_CALM, _CALM_PART * half_cycle) / self._period
            self._time = min(max(half_cycle, _SHORTEST), _LONGEST)

    def _wrong_samples(
        self, errors: Array, sizes: Array, measured: Array, peak: float
    ) -> tuple[Mask | None, Mask | None]:
        """Masks (n,) of the samples with too large an error, and of the wild ones; None for none.

        ``errors`` [N] and their ``sizes`` are those against the ``measured`` force [N].
        """
        before, self._error = self._error, float(errors[-1])
        limit, noise = self._limit * peak, self._noise(peak)
        if self._wait == 0.0 and float(sizes.max()) <= self._allowed(limit, noise):
            self._wild_for = 0
            return None, None
        # A force that grows is not wrong because it was smaller before.
        largest = np.maximum(np.abs(measured - self._recent.centre), peak)
        begins, stays = (
            (sizes > np.maximum(*self._limits(part * self._limit * largest, noise))).tolist()
            for part in (1.0, _BACK)
        )
        jumps = (np.abs(np.diff(errors, prepend=before)) > _JUMP * peak).tolist()
        wrong, wild = np.zeros((2, sizes.size), dtype=bool)
        for k, (begin, stay) in enumerate(zip(begins, stays, strict=True)):
            if begin and (jumps[k] or 0 < self._wild_for < self._longest_wild):
                self._wild_for += 1
                wild[k] = True
                continue
            self._wild_for = 0
            if begin or (stay and self._wait):
                self._wait = min(self._wait + _AS_LONG, self._calm)
                wrong[k] = True
            elif self._wait:
                wrong[k] = self._wait >= 1.0
                self._wait = max(self._wait - 1.0, 0.0)
        return wrong if wrong.any() else None, wild if wild.any() else None

    def _follow(self, sizes: Array, peak: float) -> None:
        """Follow the lasting error by the sizes (n,) [N] of the errors of the next samples."""
        count = sizes.size
        self._compared += count * self._period
        if count == 0:
            return
        most = _MOST_REMEMBERED * _LASTING * self._limit * peak
        if float(sizes.max()) > most:
            sizes = sizes.clip(0.0, most)
        square = (float(sizes @ sizes) / count - self._noise(peak) ** 2) / peak**2
        part = min(count * self._period / self._time, 1.0)
        self._square += part * (square - self._square)
        lasting = _LASTING * self._limit * (_BACK if self._wrong else 1.0)
        self._wrong = self._square > lasting**2

    @staticmethod
    def _limits(limit: Array | float, noise: float) -> tuple[Array | float, Array | float]:
        """Differences [N] of which a sample may have the larger to a force of so much noise [N]."""
        # The noise may hide a part of the error; where there is much of it, it may look like one.
        return _SEEN * limit - _CHANCE * noise, _SAMPLE * limit + _RARE * noise

    def _allowed(self, limit: float, noise: float) -> float:
        return float(max(*self._limits(limit, noise)))

    def _noise(self, peak: float) -> float:
        return min(self._recent.noise, _MOST_NOISE * peak)

    def _doubt_of_error(self, sizes: Array, peak: float, wrong: Mask | None) -> Doubt:
        if self._wrong:
            return Doubt(
                DoubtKind.WRONG,
                f"the predicted force was off by {math.sqrt(self._square):.0%} of the peak over "
                f"the last half-cycle: valid again below {_BACK * _LASTING * self._limit:.0%}",
            )
        return Doubt(
            DoubtKind.WRONG,
            f"the predicted force is off by {float(sizes[wrong].max()):.3g} N, and the peak of the "
            f"measured one is {peak:.3g} N: maximum_error is {self._limit:.0%}",
            wrong,
        )

    @staticmethod
    def _doubt_of_wild(measured: Array, peak: float, wild: Mask) -> Doubt:
        return Doubt(
            DoubtKind.SENSOR,
            f"the measured force jumps to {float(measured[-1]):.4g} N, and its peak is {peak:.3g} "
            "N: a loose contact, or a disturbance on the line of the load cell?",
            wild,
        )

    def _doubt_of_sensor(self) -> Doubt:
        if self._recent.stuck:
            return Doubt(
                DoubtKind.SENSOR,
                "the measured force does not change though the damper moves: is the load cell "
                "connected? without one set maximum_error to 0",
            )
        if self._recent.measured_drives:
            return Doubt(
                DoubtKind.SENSOR,
                "the measured force drives the motion, which no damper does: has the sign of the "
                "force or of the displacement changed?",
            )
        return NO_DOUBT

    def _doubt_of_power(self) -> Doubt:
        if self._recent.predicted_drives:
            return Doubt(
                DoubtKind.DRIVING,
                "the predicted force drives the motion, which no damper does: are the parameters "
                "those of this damper, and the signs of force and displacement right?",
            )
        return NO_DOUBT
