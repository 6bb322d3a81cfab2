"""An observer of velocity and acceleration whose bandwidth follows the motion and the noise.

A wide observer passes noise, a narrow one is late. With four poles at -w, white noise of standard
deviation s_n on the displacement and a fourth derivative of the motion of root mean square s_4, the
error of the acceleration is

    e² = (6 s_4 / w²)² + g(w)² s_n²,

g(w) being the observer's gain from noise to acceleration. The bandwidth is that of the least e. It
depends on the ninth root of (s_4 / s_n)²: rough estimates of both do. The noise is that of eighth
differences, which leave almost nothing of a motion, or of the steps of a digital sensor. The fourth
derivative is seen in what a second, narrower observer leaves of the displacement: s_4 / w⁴, besides
noise; it is made so narrow that this shows.
"""

from __future__ import annotations

import math

import numpy as np

from mr_damper_ros.kinematics.causal import CausalDifferentiator, noise_gains, possible_bandwidths
from mr_damper_ros.signals.arrays import Array

_STRETCH = 120
"""The bandwidth is chosen anew after so many samples, however they come in blocks; usual blocks go
into it, so that it is chosen between two of them."""

_START = 40.0
"""Bandwidth [Hz] before anything is known."""

_NARROWEST = 0.5
"""[Hz]; a motion so slow that less would do is followed by this, too."""

_NOTCH = math.sqrt(2.0)
"""Ratio of neighbouring bandwidths."""

_DIFFERENCE = 8
_DIFFERENCE_GAIN = math.comb(2 * _DIFFERENCE, _DIFFERENCE)
"""Sum of the squared binomial coefficients: what differences make of the power of white noise."""

_SHOWS = 2.0
"""The motion shows in what is left where that has so many times the power of the noise."""

_FORGETTING = 0.93
"""What has shown counts the less, the more stretches ago it did: half after ten."""

_NOISES = 9
"""The noise is the median of so many stretches: a kink in the motion is none."""

_JUMP, _SUDDEN = 8.0, 5.0
"""A sensor jumps, and not the motion, where the displacement changes between two samples by so many
times what it did in the fastest stretch of late, and so many times what it just did."""


class AdaptiveObserver:
    """Displacement, velocity and acceleration of a stream of samples ``period`` [s] apart.

    It begins with a bandwidth of 40 Hz, or what the period allows. What it returns does not depend
    on how the stream is cut into blocks. After a jump of the sensor it begins anew: no motion had
    that velocity. Of a displacement that does not change at all nothing is learnt.
    """

    def __init__(self, period: float) -> None:
        lowest, highest = possible_bandwidths(period)
        count = 1 + int(math.log(highest / max(lowest, min(_NARROWEST, highest)), _NOTCH))
        self._period = period
        # Widest first.
        self._bandwidths = highest / _NOTCH ** np.arange(count)
        self._rates = 2.0 * math.pi * self._bandwidths
        gains = [noise_gains(period, float(bandwidth)) for bandwidth in self._bandwidths]
        self._acceleration_gains = np.array([gain.acceleration for gain in gains])
        self._residual_gains = np.array([gain.residual for gain in gains])
        start = int(np.argmin(np.abs(np.log(self._bandwidths / _START))))
        self._place, self._trial_place = start, min(start + 2, count - 1)
        self._observer = CausalDifferentiator(period, self.bandwidth)
        self._trial = CausalDifferentiator(period, float(self._bandwidths[self._trial_place]))
        self._stretch: list[Array] = []
        self._count = 0
        self._noises: list[float] = []
        self._snap = 0.0
        self._shown = False
        # The last sample [m], the last change, and the largest of late; NaN: not known yet.
        self._last = self._last_change = self._largest_change = math.nan

    @property
    def bandwidth(self) -> float:
        """The present one [Hz]."""
        return float(self._bandwidths[self._place])

    @property
    def settled(self) -> bool:
        """Whether the transient of the start has died away."""
        return self._observer.settled

    def follow(self, displacement: Array) -> tuple[Array, Array, Array]:
        """Displacement [m], velocity [m/s] and acceleration [m/s²] at the samples, shape (n,)."""
        parts = []
        first = 0
        while first < displacement.size:
            self.adapt()
            part = self._up_to_jump(displacement[first : first + _STRETCH - self._count])
            parts.append(self._observer.follow(part))
            self._stretch.append(part)
            self._count += part.size
            first += part.size
        if len(parts) == 1:
            return parts[0]
        u, v, a = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        return u, v, a

    def adapt(self) -> None:
        """Choose the bandwidth where it is time to; :meth:`follow` does it, too."""
        if self._count == _STRETCH:
            stretch = np.concatenate(self._stretch)
            self._stretch, self._count = [], 0
            self._choose(stretch)

    def _up_to_jump(self, displacement: Array) -> Array:
        """The next samples, of shape (n,), up to where the sensor jumps, the first apart.

        If it jumps to that, the motion begins anew there.
        """
        changes = np.empty(displacement.size)
        changes[0] = displacement[0] - self._last
        np.subtract(displacement[1:], displacement[:-1], out=changes[1:])
        np.abs(changes, out=changes)
        if changes.max() > _JUMP * self._largest_change:
            sudden = changes > _JUMP * self._largest_change
            sudden[0] &= changes[0] > _SUDDEN * self._last_change
            sudden[1:] &= changes[1:] > _SUDDEN * changes[:-1]
            if sudden[0]:
                self._begin_anew()
            if sudden[1:].any():
                end = 1 + int(sudden[1:].argmax())
                displacement, changes = displacement[:end], changes[:end]
        self._last, self._last_change = float(displacement[-1]), float(changes[-1])
        return displacement

    def _begin_anew(self) -> None:
        self._observer.reset()
        self._trial.reset()
        self._stretch, self._count = [], 0

    def _choose(self, stretch: Array) -> None:
        settled = self._trial.settled
        left = stretch - self._trial.follow(stretch)[0]
        largest = float(np.abs(np.diff(stretch)).max())
        if largest == 0.0:
            return
        known = self._largest_change
        self._largest_change = largest if math.isnan(known) else max(largest, _FORGETTING * known)
        if not settled:
            return
        white, steps = _noise_powers(stretch)
        self._noises = [*self._noises, white][-_NOISES:]
        white = float(np.median(self._noises))
        # The error of a digital sensor in a slow motion is not white: no observer takes it out.
        noise = self._residual_gains[self._trial_place] ** 2 * white + steps
        bias = float(np.mean(left**2)) - noise
        shows = bias > (_SHOWS - 1.0) * noise
        snap = self._rates[self._trial_place] ** 4 * math.sqrt(bias if shows else noise)
        # Before the motion has shown, what it could be at most is known better every time.
        self._snap = max(snap, _FORGETTING * self._snap) if self._shown else snap
        self._shown = self._shown or shows
        if not shows:
            self._move_trial(1)
        elif bias > _SHOWS**8 * noise:
            self._move_trial(-1)
        errors = (6.0 * self._snap / self._rates**2) ** 2
        errors += self._acceleration_gains**2 * (white + steps)
        best = int(np.argmin(errors))
        if best != self._place:
            self._place = best
            self._observer.tune(self.bandwidth)

    def _move_trial(self, notches: int) -> None:
        self._trial_place = min(max(self._trial_place + notches, 0), self._bandwidths.size - 1)
        self._trial.tune(float(self._bandwidths[self._trial_place]))


def _noise_powers(stretch: Array) -> tuple[float, float]:
    """Power [m²] of the white noise of a stretch (n,), and of the steps of a digital sensor."""
    white = float(np.mean(np.diff(stretch, _DIFFERENCE) ** 2)) / _DIFFERENCE_GAIN
    changes = np.abs(np.diff(stretch))
    moved = changes > 0.0
    if moved.all() or not moved.any():
        return white, 0.0
    return white, float(changes[moved].min()) ** 2 / 12.0
