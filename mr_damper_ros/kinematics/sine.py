"""Sine fit of a sampled displacement (thesis 2.8.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.white_noise import white_noise

_ENOUGH_CYCLES = 2.0
_FAR_FROM_SINE = 0.4
"""Of a sine of so many cycles or more, the strongest line of the spectrum leaves 0.15 of the
displacement at most (standard deviations). What leaves more than this is none, but for noise ..."""

_NOISE_FACTOR = 2.0
"""... so many times that of the displacement."""

_ROUGHLY, _LAST_DIGITS = 1e-3, 1e-13
"""Relative tolerances: of shorter motions the line of the spectrum is not near enough to tell."""


@dataclass(frozen=True)
class Sine:
    """u(t) = offset + amplitude sin(2 pi frequency t + phase), with the residual of its fit.

    ``amplitude`` and ``offset`` [m], ``frequency`` [Hz], ``phase`` [rad] at t = 0;
    ``residual_rms`` [m] is the standard deviation of what the sine leaves of the displacement.
    """

    amplitude: float
    frequency: float
    phase: float
    offset: float
    residual_rms: float

    def displacement(self, time: Array) -> Array:
        """Displacement about the centre of the motion (without the offset) [m]."""
        return self.amplitude * np.sin(2.0 * np.pi * self.frequency * time + self.phase)

    def velocity(self, time: Array) -> Array:
        """First derivative [m/s]."""
        omega = 2.0 * np.pi * self.frequency
        return self.amplitude * omega * np.cos(omega * time + self.phase)

    def acceleration(self, time: Array) -> Array:
        """Second derivative [m/s²]."""
        return -((2.0 * np.pi * self.frequency) ** 2) * self.displacement(time)


def fit_sine(displacement: Array, period: float) -> Sine | None:
    """Least-squares sine of a displacement of shape (n,) [m] sampled every ``period`` [s].

    The spectrum's peak gives the start. Frequency is the only unknown that enters nonlinearly;
    the other three are solved linearly at each step. Returns None where the samples hold less
    than half a cycle of the strongest frequency or do not move at all, or where it shows early that
    the motion is far from a sine: then there is none.
    """
    u = np.asarray(displacement, dtype=float)
    n = u.size
    centred = u - u.mean()
    if n < 8 or np.ptp(u) == 0.0:
        return None
    # Zero padding refines the start to a fraction of a spectral line.
    spectrum = np.abs(np.fft.rfft(centred * np.hanning(n), 8 * n))
    # Below half a cycle in the window a sine, an offset and a ramp cannot be told apart.
    lowest = 4
    start = float(np.argmax(spectrum[lowest:]) + lowest) / (8 * n)
    # Time is counted from the middle, where frequency and phase are nearly uncorrelated.
    index = np.arange(n) - 0.5 * (n - 1)

    def basis(cycles_per_sample: float) -> Array:
        angle = 2.0 * np.pi * cycles_per_sample * index
        return np.column_stack((np.sin(angle), np.cos(angle), np.ones(n)))

    def solve(cycles_per_sample: float) -> tuple[Array, Array]:
        columns = basis(cycles_per_sample)
        weights = np.linalg.lstsq(columns, u, rcond=None)[0]
        return weights, columns @ weights - u

    scale = float(np.std(u))

    def fitted(start: float, tolerance: float) -> float:
        from scipy.optimize import least_squares  # here: see mr_damper_ros.entry_points

        fit = least_squares(
            lambda x: solve(x[0])[1] / scale,
            x0=[start],
            x_scale=1.0 / (8 * n),
            bounds=(lowest / (8 * n) / 2, 0.5),
            xtol=tolerance,
            ftol=tolerance,
            gtol=tolerance,
        )
        return float(fit.x[0])

    near = start if start * n >= _ENOUGH_CYCLES else fitted(start, _ROUGHLY)
    left = float(np.std(solve(near)[1]))
    if left > _FAR_FROM_SINE * scale and left > _NOISE_FACTOR * white_noise(u):
        return None
    frequency = fitted(near, _LAST_DIGITS)
    (sine, cosine, offset), residual = solve(frequency)
    omega = 2.0 * np.pi * frequency
    return Sine(
        amplitude=float(np.hypot(sine, cosine)),
        frequency=frequency / period,
        phase=float((np.arctan2(cosine, sine) - omega * 0.5 * (n - 1)) % (2.0 * np.pi)),
        offset=float(offset),
        residual_rms=float(np.sqrt(np.mean(residual**2))),
    )
