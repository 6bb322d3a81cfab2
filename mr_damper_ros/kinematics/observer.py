"""Causal estimate of displacement, velocity and acceleration from displacement samples.

The observer assumes a motion with piecewise constant jerk and has four equal poles at -w. It is the
steady state of a Kalman filter with white snap. It follows a polynomial motion up to third order
without delay or error. For a sinusoid, the relative errors of displacement, velocity and
acceleration are proportional to the fourth, third and second power of the ratio of its frequency to
the bandwidth.

A wide bandwidth passes noise; a narrow one causes lag. :class:`AdaptiveObserver` minimises the mean
square error of the acceleration, (6 s_4 / w²)² + g(w)² s_n², for white displacement noise of
standard deviation s_n, a fourth derivative of the motion with a root mean square of s_4, and the
gain g(w) from noise to acceleration. The best bandwidth w depends on the ninth root of
(s_4 / s_n)², so rough estimates of s_4 and s_n suffice.
"""

from __future__ import annotations

import math
from collections import deque
from functools import lru_cache

import numpy as np

from mr_damper_ros.signals.arrays import Array, noise_power

_ORDER = 4

_GROUP = 10
"""Number of samples in a group: one matrix product processes it, and its residual is judged."""

_SETTLING = 12.0
"""Number of time constants after which the initial transient has decayed to a thousandth."""


def possible_bandwidths(period: float) -> tuple[float, float]:
    """Lowest and highest bandwidth [Hz] of the observer for samples ``period`` [s] apart.

    Above a quarter of the sample rate, the observer would not filter. At very low bandwidths, the
    four poles lie so close to 1 that double precision is not sufficient.
    """
    return 2e-4 / period, 0.25 / period


class CausalDifferentiator:
    """Observer with a fixed bandwidth that processes blocks of samples.

    ``period`` [s] is the sample period and ``bandwidth`` [Hz] the corner frequency of the observer.
    It must lie within :func:`possible_bandwidths`. ``seen`` counts the samples since the start or
    :meth:`reset`.
    """

    def __init__(self, period: float, bandwidth: float) -> None:
        self._period = period
        self.tune(bandwidth)
        self._settling = settling_samples(period, bandwidth)
        self.reset()

    def tune(self, bandwidth: float) -> None:
        """Change the bandwidth [Hz], keeping the state."""
        self._decays, self._responses = _observer(self._period, bandwidth)
        self._closed, self._gain = self._decays[:, 0].copy(), self._responses[:, 0, 0].copy()

    def reset(self) -> None:
        """Discard the state: the next sample is treated as the first."""
        self.seen = 0
        self._origin = 0.0
        self._state = np.zeros(_ORDER)

    @property
    def settled_count(self) -> int:
        """Number of samples since the transient of the start has died away."""
        return max(self.seen - self._settling + 1, 0)

    def follow(self, displacement: Array) -> tuple[Array, Array, Array]:
        """Displacement [m], velocity [m/s] and acceleration [m/s²] at the samples, shape (n,)."""
        if self.seen == 0:
            # The state is relative to the first sample, which avoids a step at the start.
            self._origin = float(displacement[0])
        if displacement.size == 1:  # a fast path, which takes two thirds of the time
            self._state = state = self._closed @ self._state + self._gain * (
                displacement[0] - self._origin
            )
            self.seen += 1
            return state[0:1] + self._origin, state[1:2], state[2:3]
        centred = np.asarray(displacement, dtype=float) - self._origin
        outputs = np.empty((_ORDER, centred.size))
        for first in range(0, centred.size, _GROUP):
            part = centred[first : first + _GROUP]
            states = self._decays[:, : part.size] @ self._state
            states += self._responses[:, : part.size, : part.size] @ part
            outputs[:, first : first + part.size] = states
            self._state = states[:, -1]
        self.seen += centred.size
        return outputs[0] + self._origin, outputs[1], outputs[2]


@lru_cache(maxsize=256)
def noise_gains(period: float, bandwidth: float) -> tuple[float, float]:
    """Gains of the observer from white noise [m] to acceleration [m/s²] and to residual [m].

    They are ratios of standard deviations; the residual is the displacement minus its estimate.
    """
    closed, gain = closed_loop(period, bandwidth)
    # Covariance of the states, P = A P A' + g g', computed by doubling.
    power, step = np.outer(gain, gain), closed
    for _ in range(40):
        power, step = power + step @ power @ step.T, step @ step
    residual = max(1.0 - 2.0 * gain[0] + power[0, 0], 0.0)
    return math.sqrt(power[2, 2]), math.sqrt(residual)


def settling_samples(period: float, bandwidth: float) -> int:
    """Samples after which the initial transient of the observer has decayed."""
    return math.ceil(_SETTLING / (2.0 * math.pi * bandwidth * period))


def closed_loop(period: float, bandwidth: float) -> tuple[Array, Array]:
    """Matrix A (4, 4) and gain g (4,) of the state equation x+ = A x + g y.

    A = (1 - g C) F, where F integrates a constant jerk. The gain belongs to a fading-memory filter
    of third degree (Morrison, "Introduction to sequential smoothing and prediction", 1969).
    """
    pole = math.exp(-2.0 * math.pi * bandwidth * period)
    rest = -math.expm1(-2.0 * math.pi * bandwidth * period)
    gain = np.array(
        [
            1.0 - pole**4,
            rest**2 * (11.0 + 14.0 * pole + 11.0 * pole**2) / (6.0 * period),
            2.0 * rest**3 * (1.0 + pole) / period**2,
            rest**4 / period**3,
        ]
    )
    lags = np.arange(_ORDER) - np.arange(_ORDER)[:, np.newaxis]
    powers = np.array([period**k / math.factorial(k) for k in range(_ORDER)])
    advance = np.where(lags >= 0, powers[lags], 0.0)
    return advance - np.outer(gain, advance[0]), gain


@lru_cache(maxsize=64)
def _observer(period: float, bandwidth: float) -> tuple[Array, Array]:
    """Matrices that give the states at the next m samples from the last state and the samples.

    The first, of shape (4, m, 4), multiplies the last state. The second, of shape (4, m, m),
    multiplies the samples; each of its four matrices is lower triangular.
    """
    closed, gain = closed_loop(period, bandwidth)
    decays = np.empty((_ORDER, _GROUP, _ORDER))
    impulses = np.empty((_ORDER, _GROUP))
    impulse, power = gain, closed
    for sample in range(_GROUP):
        decays[:, sample], impulses[:, sample] = power, impulse
        impulse, power = closed @ impulse, closed @ power
    later = np.subtract.outer(np.arange(_GROUP), np.arange(_GROUP))
    return decays, np.where(later >= 0, impulses[:, later], 0.0)


_STRETCH = 120
"""Number of samples between two choices of the bandwidth."""

_GROUP_EXCESS = 6.0
"""The bandwidth increases at once if the residual of a group of ten samples has six times the
expected power, which occurs by chance once in 280 million groups of white noise, or six times the
usual excess over it: the noise of a sensor may not be white. The velocity error after a start from
rest is 2.3 % at 200 Hz with this rule, and 7.3 % without it (doc/kinematics.md).
"""

_TINY = np.finfo(float).tiny

_INITIAL, _LOWEST = 40.0, 0.5
"""Initial and lowest bandwidth [Hz]."""

_RATIO = math.sqrt(2.0)
"""Ratio of neighbouring bandwidths."""

_TRIAL_STEPS = 2
"""Smallest number of bandwidth steps between the first and the narrower second observer. With one
step, the valid share of recorded sines is 1 % lower."""

_VISIBLE_RATIO = 2.0
"""The motion is visible in a residual whose power exceeds the noise power by this factor."""

_RECENT = 9
"""Number of stretches over which the noise is the median, so that a kink has no effect, and over
which the largest change and the largest fourth derivative are kept."""

_JUMP = 8.0
"""The sensor has jumped if the displacement changes between two samples by more than this factor
times the largest recent change, and times the previous change."""


class AdaptiveObserver:
    """Observer of samples ``period`` [s] apart that adapts its bandwidth to motion and noise.

    The noise is estimated from eighth differences, which remove almost all of the motion, and from
    the steps of a digital sensor. The fourth derivative is estimated from the residual of a second
    observer, which is s_4 / w⁴ plus noise. The bandwidth of this second observer is reduced until
    the motion is visible in its residual.

    The initial bandwidth is 40 Hz, or the nearest one that the period allows. Constant displacement
    is ignored. The observer restarts after a jump of the sensor. The result does not depend on how
    the stream is divided into blocks.
    """

    def __init__(self, period: float) -> None:
        lowest, highest = possible_bandwidths(period)
        count = 1 + int(math.log(highest / max(lowest, min(_LOWEST, highest)), _RATIO))
        self._period = period
        # The highest bandwidth first.
        self._bandwidths = highest / _RATIO ** np.arange(count)
        self._rates = 2.0 * math.pi * self._bandwidths
        gains = [noise_gains(period, float(bandwidth)) for bandwidth in self._bandwidths]
        self._acceleration_gains, self._residual_gains = np.array(gains).T
        self._start = int(np.argmin(np.abs(np.log(self._bandwidths / _INITIAL))))
        self._place, self._trial_place = self._start, min(self._start + _TRIAL_STEPS, count - 1)
        self._observer = CausalDifferentiator(period, self.bandwidth)
        self._trial = CausalDifferentiator(period, float(self._bandwidths[self._trial_place]))
        self._whites: deque[float] = deque(maxlen=_RECENT)
        # Power [m²] of the white noise and of the steps of a digital sensor.
        self._white = self._steps = 0.0
        # Mean of the power of the residual over the expected one, in the recent stretches.
        self._excesses: deque[float] = deque(maxlen=_RECENT)
        # Estimates of the fourth derivative [m/s⁴]; an upper bound until the motion is visible.
        self._snaps: deque[float] = deque(maxlen=_RECENT)
        self._visible = False
        # The last sample and the last change [m], NaN while unknown, and the largest changes.
        self._last = self._last_change = math.nan
        self._changes: deque[float] = deque(maxlen=_RECENT)
        # The last change [m] if it was a jump that the sensor may return from, otherwise 0.
        self._jump = 0.0
        self._begin_stretch()

    def _begin_stretch(self) -> None:
        self._stretch: list[Array] = []
        self._count = 0
        # Present group: sum of the squared residuals, and whether the displacement has changed.
        self._squares, self._moved = 0.0, False
        self._excess = 0.0

    @property
    def bandwidth(self) -> float:
        """The present bandwidth [Hz]."""
        return float(self._bandwidths[self._place])

    @property
    def settled_count(self) -> int:
        """Number of samples since the transient of the start, or of a restart, has died away."""
        return self._observer.settled_count

    def follow(self, displacement: Array) -> tuple[Array, Array, Array]:
        """Displacement [m], velocity [m/s] and acceleration [m/s²] at the samples, shape (n,)."""
        parts = []
        first = 0
        while first < displacement.size:
            self.adapt()
            part = self._up_to_jump(displacement[first : first + _GROUP - self._count % _GROUP])
            parts.append(self._observer.follow(part))
            residual = part - parts[-1][0]
            self._squares += float(residual @ residual)
            self._stretch.append(part)
            self._count += part.size
            first += part.size
            if self._count % _GROUP == 0:
                self._widen_at_once()
        u, v, a = np.concatenate(parts, axis=1) if len(parts) > 1 else parts[0]
        return u, v, a

    def adapt(self) -> None:
        """Choose the bandwidth if a choice is due; :meth:`follow` also does this."""
        if self._count == _STRETCH:
            self._excesses.append(self._excess)
            stretch = np.concatenate(self._stretch)
            self._begin_stretch()
            self._choose(stretch)

    def _up_to_jump(self, displacement: Array) -> Array:
        """Samples (n,) up to a jump of the sensor; after one at the start, restart the observer.

        The return from a spike also counts as a jump, although the previous change was as large.
        """
        change = float(displacement[0]) - self._last
        changes = np.abs(np.concatenate(((change,), displacement[1:] - displacement[:-1])))
        largest, usual = changes.max(), max(self._changes, default=math.nan)
        jump, self._jump = self._jump, 0.0
        if largest > _JUMP * usual:
            large = changes > _JUMP * usual
            sudden = large & (changes > _JUMP * np.append(self._last_change, changes[:-1]))
            end = 1 + int(sudden[1:].argmax()) if sudden[1:].any() else changes.size
            if sudden[0] or (large[0] and jump * change < 0.0):
                self._observer.reset()
                self._trial.reset()
                self._begin_stretch()
                # A motion that starts abruptly looks like a jump, so the bandwidth must be high.
                self._use(min(self._place, self._start))
                self._jump, end = change if sudden[0] else jump, 1
            displacement, changes = displacement[:end], changes[:end]
        self._moved = self._moved or largest > 0.0
        self._last, self._last_change = float(displacement[-1]), float(changes[-1])
        return displacement

    def _use(self, place: int) -> None:
        self._place = place
        self._observer.tune(self.bandwidth)

    @property
    def _snap(self) -> float:
        return max(self._snaps, default=0.0)

    def _noise(self, place: int) -> float:
        """Power [m²] of the noise in the residual, including the steps of a digital sensor."""
        return float(self._residual_gains[place] ** 2 * self._white + self._steps)

    def _widen_at_once(self) -> None:
        """Increase the bandwidth if the residual of a group exceeds noise and known motion."""
        power, self._squares = self._squares / _GROUP, 0.0
        moved, self._moved = self._moved, False
        settling = settling_samples(self._period, self.bandwidth)
        if not (self._whites and moved and self._observer.seen >= settling):
            return
        rate = self._rates[self._place]
        expected = self._noise(self._place) + (self._snap / rate**4) ** 2
        excess = power / max(expected, _TINY)
        self._excess += excess * _GROUP / _STRETCH
        if excess > _GROUP_EXCESS * max(1.0, *self._excesses):
            self._snaps.append(rate**4 * math.sqrt(power))
            self._visible = True
            self._use_best()
            self._move_trial(min(self._trial_place, self._place + _TRIAL_STEPS))

    def _choose(self, stretch: Array) -> None:
        """Estimate noise and fourth derivative from a stretch (n,), and choose the bandwidth."""
        settled = self._trial.settled_count > 0
        residual = stretch - self._trial.follow(stretch)[0]
        changes = np.abs(np.diff(stretch))
        largest = float(changes.max())
        if largest == 0.0:
            return
        self._changes.append(largest)
        if not settled:
            return
        self._whites.append(noise_power(stretch, 8))
        self._white = float(np.median(self._whites))
        # In slow motion the error of a digital sensor is not white; it varies over one step.
        moved = changes[changes > 0.0]
        self._steps = 0.0 if moved.size == changes.size else float(moved.min()) ** 2 / 12.0
        noise = self._noise(self._trial_place)
        bias = float(np.mean(residual**2)) - noise
        visible = bias > (_VISIBLE_RATIO - 1.0) * noise
        snap = self._rates[self._trial_place] ** 4 * math.sqrt(bias if visible else noise)
        if not self._visible:
            self._snaps.clear()  # each stretch improves the upper bound
        self._snaps.append(snap)
        self._visible = self._visible or visible
        if not visible:
            self._move_trial(self._trial_place + 1)
        elif bias > _VISIBLE_RATIO**8 * noise:
            self._move_trial(self._trial_place - 1)
        self._use_best()

    def _use_best(self) -> None:
        errors = (6.0 * self._snap / self._rates**2) ** 2
        errors += self._acceleration_gains**2 * (self._white + self._steps)
        self._use(int(np.argmin(errors)))

    def _move_trial(self, place: int) -> None:
        self._trial_place = min(max(place, 0), self._bandwidths.size - 1)
        self._trial.tune(float(self._bandwidths[self._trial_place]))
