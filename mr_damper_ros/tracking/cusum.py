"""Change detection: a two-sided CUSUM detects a sudden change of the force between two windows.

It sums, over blocks of samples, the logarithm of the likelihood of a force changed by a few percent
relative to an unchanged force (Page, Biometrika 41, 1954). The sum is scaled so that the noise of a
typical block has a standard deviation of 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from mr_damper_ros.signals.arrays import Array, Positive
from mr_damper_ros.tracking.acceptance import CHUNKS

SLACK = 0.5
"""Smallest slack: half the smallest shift to detect, in standard deviations of a typical block."""

THRESHOLD = 12.0
"""Sum [1] above which a change is reported.

If the residual is white noise, the mean interval between two false alarms is half a million blocks:
7 h at 20 blocks per second (Siegmund, "Sequential Analysis", 1985, for both sums together). If the
force is large compared with the noise, the slack is larger (see :meth:`ChangeWatch.follow`) and the
false alarms are rarer.
"""

_EXCURSION = 2.0
"""The threshold is at least this multiple of the largest sum within the fitted window."""


@dataclass(frozen=True)
class ChangeWatch:
    """State of the change detection; every step returns a new state.

    Of the window that the running set was fitted to come ``noise`` [N], the standard deviation of
    its residual, ``block_norm`` [N], the root mean square norm of the force in a block of ``block``
    samples, and ``operating_point`` (peak velocity [m/s], current [A]). A relative change of the
    force of ``smallest_change`` triggers an early fit. ``rising`` and ``falling`` are the two sums,
    with the numbers of samples since each was last zero; ``top`` is the largest sum so far.
    """

    noise: Positive
    block_norm: Positive
    smallest_change: Positive
    operating_point: tuple[float, float]
    block: int
    threshold: Positive = THRESHOLD
    rising: float = 0.0
    falling: float = 0.0
    rising_samples: int = 0
    falling_samples: int = 0
    top: float = 0.0

    @classmethod
    def after_fit(
        cls,
        predicted: Array,
        measured: Array,
        operating_point: tuple[float, float],
        smallest_change: float,
    ) -> ChangeWatch:
        """Start after a window: its measured force (n,) [N] and the force of the set fitted to it.

        If the law is not exact, its residual oscillates with the motion. The threshold is then
        above the sums that this oscillation causes.
        """
        residual = measured - predicted
        noise = math.sqrt(float(np.mean(residual**2)))
        level = math.sqrt(float(np.mean(predicted**2)))
        block = max(predicted.size // CHUNKS, 1)
        fresh = cls(
            # A simulated force has no noise, and the noise must not be zero.
            noise=max(noise, 1e-6 * level, 1e-100),
            block_norm=max(level * math.sqrt(block), 1e-100),
            smallest_change=smallest_change,
            operating_point=operating_point,
            block=block,
        )
        usual = fresh.follow(predicted, measured).top
        return replace(fresh, threshold=max(THRESHOLD, _EXCURSION * usual))

    @property
    def samples_since_change(self) -> int:
        """Number of samples since the change began, where its sum was last zero; 0 without one."""
        if max(self.rising, self.falling) <= self.threshold:
            return 0
        return self.rising_samples if self.rising > self.falling else self.falling_samples

    def follow(self, predicted: Array, measured: Array) -> ChangeWatch:
        """Return the state after further samples (n,) [N].

        The slack is half of ``smallest_change``, and at least ``SLACK``.
        """
        state = self
        blocks = max(predicted.size // self.block, 1)
        shift = max(self.smallest_change * self.block_norm / self.noise, 2.0 * SLACK)
        for chosen in np.array_split(np.arange(predicted.size), blocks):
            force, residual = predicted[chosen], measured[chosen] - predicted[chosen]
            # Each block is weighted by its force, as the likelihood requires. The weighted residual
            # then sums to zero over the fitted window, even if it oscillates.
            deviation = float(force @ residual) / (self.noise * self.block_norm)
            slack = 0.5 * shift * float(force @ force) / self.block_norm**2
            rising = max(state.rising + deviation - slack, 0.0)
            falling = max(state.falling - deviation - slack, 0.0)
            state = replace(
                state,
                rising=rising,
                falling=falling,
                rising_samples=state.rising_samples + chosen.size if rising > 0.0 else 0,
                falling_samples=state.falling_samples + chosen.size if falling > 0.0 else 0,
                top=max(state.top, rising, falling),
            )
        return state


def change_point(predicted: Array, measured: Array, fewest: int) -> int:
    """Index at which a change of the force scale explains the samples (n,) best.

    The least-squares model is the force of the running set before the index, and this force times
    the best factor from the index on. The second part has at least ``fewest`` samples. The CUSUM
    alone locates the start of a change only to within a block.
    """

    def to_the_end(products: Array) -> Array:
        return np.asarray(np.cumsum(products[::-1])[::-1])

    power = to_the_end(predicted * predicted)
    explained = to_the_end(predicted * measured) ** 2 / np.maximum(power, 1e-300)
    # Decrease of the squared error if the change is at each index.
    gain = explained - power - 2.0 * to_the_end(predicted * (measured - predicted))
    return int(np.argmax(gain[: max(predicted.size - fewest, 0) + 1]))
