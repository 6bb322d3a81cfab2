"""Holds the predicted force against the one that was measured in the same samples.

Two errors are followed, both as parts of the recent peak of the measured force: that of every
sample, which tells at once that the force is wrong now, and the root mean square over a half-
cycle, which tells that the parameters are: then nothing is valid until they are right again.
"""

from __future__ import annotations

import math

import numpy as np

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.recent_force import RecentForce
from mr_damper_ros.tracking.validity import NO_DOUBT, Doubt, DoubtKind

_SEEN = 0.98
"""Part of the allowed error that a sample may have: the peak is known no better ..."""

_CHANCE = 3.0
"""... less so many standard deviations of the noise, which may hide as much of it ..."""

_SAMPLE = 0.68
"""... but with much noise this part and as many more, so that noise alone is no wrong force."""

_LASTING = 1.0
"""Part of the allowed error that the root mean square over a half-cycle may reach."""

_MOST_REMEMBERED = 1.5
"""A burst counts no more than so many times that limit: it must not be remembered for ever."""

_BACK = 0.9
"""Part of either limit that the error must fall below again."""

_MOST_NOISE = 0.1
"""What looks like noise is taken for it up to this part of the peak."""

_SHORTEST, _LONGEST = 0.2, 20.0
"""Seconds within which the half-cycle lies over which a lasting error is taken."""


class ForceWatch:
    """Watches the forces of samples ``period`` [s] apart.

    ``maximum_error`` is a part of the peak of the measured force; 0: that force is not looked at.
    """

    def __init__(self, period: float, maximum_error: float) -> None:
        self._period = period
        self._limit = maximum_error
        self._recent = RecentForce(period)
        self._time = _SHORTEST
        # Mean square [1] of the error over the peak.
        self._square = 0.0
        self._wrong_now = False
        self._wrong = False
        # Seconds for which the forces have been compared without a break.
        self._compared = 0.0

    @property
    def holds(self) -> bool:
        """Whether the predicted force is right, and was over the last cycle, by the measured one.

        A moment in which it was wrong is over with that moment, but for what it adds to the rest.
        """
        return self._compared >= 2.0 * self._time and not (self._wrong or self._wrong_now)

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
            self._wrong = self._wrong_now = False
        elif self._wrong:
            self._square = (_LASTING * self._limit) ** 2
        self._recent.forget_predicted()

    def forget_moment(self) -> None:
        """The samples do not go on from where the force could be known, or were not judged."""
        self._square = self._compared = 0.0
        self._wrong_now = self._wrong = False

    def judge(self, predicted: Array, measured: Array) -> Doubt:
        """Follow the forces (n,) [N] of the next samples: why to doubt the predicted one."""
        if self._limit == 0.0:
            return self._doubt_of_power()
        peak = self._recent.peak
        if not peak > 0.0:
            # Nothing is known of the force yet, or it never changed.
            return self._doubt_of_sensor() if peak == 0.0 else NO_DOUBT
        largest = self._follow(predicted, measured, peak)
        if not largest < math.inf:
            return Doubt(DoubtKind.WRONG, "the predicted force has no finite error")
        error = self._doubt_of_error(largest, peak, measured)
        # One that agrees with the measured force drives the motion no more than that does.
        return self._doubt_of_sensor() or (error and (self._doubt_of_power() or error))

    def learn(
        self, forces: tuple[Array, Array], velocity: Array, half_cycle: float, *, steady: bool
    ) -> None:
        """What only later samples need of these; arrays of shape (n,).

        ``forces`` [N], predicted and measured; ``velocity`` [m/s]; ``half_cycle`` [s] of the
        motion, NaN before it is known; ``steady``: whether that is a sine that goes on.
        """
        self._recent.add(forces, velocity, half_cycle, steady=steady)
        if not math.isnan(half_cycle):
            self._time = min(max(half_cycle, _SHORTEST), _LONGEST)

    def _follow(self, predicted: Array, measured: Array, peak: float) -> float:
        """Follow the lasting error; returns the largest error [N] of a sample."""
        count = measured.size
        if count == 1:
            largest = abs(float(predicted[0]) - float(measured[0]))
            square = largest * largest
        else:
            errors = predicted - measured
            square = float(errors @ errors) / count
            largest = float(np.abs(errors).max())
        if not square < math.inf:
            return math.inf
        square = max(square - self._noise(peak) ** 2, 0.0) / peak**2
        square = min(square, (_MOST_REMEMBERED * _LASTING * self._limit) ** 2)
        part = min(count * self._period / self._time, 1.0)
        self._square += part * (square - self._square)
        self._compared += count * self._period
        return largest

    @staticmethod
    def _allowed(limit: float, noise: float) -> float:
        """Difference [N] that a sample may have to a measured force of so much noise [N]."""
        chance = _CHANCE * noise
        # The noise may hide a part of the error; where there is much of it, it may look like one.
        return max(_SEEN * limit - chance, _SAMPLE * limit + chance)

    def _noise(self, peak: float) -> float:
        return min(self._recent.noise, _MOST_NOISE * peak)

    def _doubt_of_error(self, largest: float, peak: float, measured: Array) -> Doubt:
        limit, noise = self._limit * (_BACK if self._wrong_now else 1.0), self._noise(peak)
        if largest > self._allowed(limit * peak, noise):
            # A force that grows is not wrong because it was smaller before.
            peak = max(peak, float(np.abs(measured - self._recent.centre).max()))
        self._wrong_now = largest > self._allowed(limit * peak, noise)
        lasting = _LASTING * self._limit * (_BACK if self._wrong else 1.0)
        self._wrong = self._square > lasting**2
        if self._wrong_now:
            return Doubt(
                DoubtKind.WRONG,
                f"the predicted force is off by {largest:.3g} N, and the peak of the measured one "
                f"is {peak:.3g} N: maximum_error is {self._limit:.0%}",
            )
        if self._wrong:
            return Doubt(
                DoubtKind.WRONG,
                f"the predicted force was off by {math.sqrt(self._square):.0%} of the peak over "
                f"the last half-cycle: valid again below {lasting:.0%}",
            )
        return NO_DOUBT

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
