"""Notices a sudden change of the force between two windows: a two-sided CUSUM.

What is summed is the log-likelihood ratio of a damper whose force has changed by some percent to
one that has not, block by block of samples (Page, Biometrika 41, 1954), in units in which a usual
block of noise has a standard deviation of 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from mr_damper_ros.signals.arrays import Array

SLACK = 0.5
"""Least slack: half the smallest shift to find, in standard deviations of a usual block."""

THRESHOLD = 12.0
"""Sum [1] that counts as a change.

Where the residual is white noise, half a million blocks lie between two false alarms on average:
7 h at 20 blocks per second (Siegmund, "Sequential Analysis", 1985, for both sums together). The
slack grows where the force stands far out of the noise (see :meth:`ChangeWatch.follow`), and then
the alarms become rarer still.
"""

_EXCURSION = 2.0
"""The sum must exceed so many times what the residual of a usual window reaches by itself."""

_BLOCKS_PER_WINDOW = 40


@dataclass(frozen=True)
class ChangeWatch:
    """State of the detector; every step returns a new one.

    ``noise`` [N]: standard deviation of the residual of the window that the running set was
    fitted to; ``block_norm`` [N]: root mean square norm of the force in a block of that window;
    ``smallest_change``: relative change of the force that is worth an early fit;
    ``operating_point``: peak velocity [m/s] and current [A] for which the set is known to hold;
    ``block``: samples per block; ``threshold``: see :data:`THRESHOLD`. ``rising`` and ``falling``
    are the two sums; ``samples`` have been followed since the larger one was last zero.
    """

    noise: float
    block_norm: float
    smallest_change: float
    operating_point: tuple[float, float]
    block: int
    threshold: float = THRESHOLD
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
        """Watch from a window (n,) [N] on, predicted by the set that was fitted to it.

        Where the law itself is not exact its residual swings with the motion: the threshold then
        stands above what that swing adds up to.
        """
        residual = measured - predicted
        noise = math.sqrt(float(np.mean(residual**2)))
        level = math.sqrt(float(np.mean(predicted**2)))
        block = max(predicted.size // _BLOCKS_PER_WINDOW, 1)
        fresh = cls(
            # A simulated force has no noise at all.
            noise=max(noise, 1e-6 * level, 1e-100),
            block_norm=max(level * math.sqrt(block), 1e-100),
            smallest_change=smallest_change,
            operating_point=operating_point,
            block=block,
        )
        usual = fresh.follow(predicted, measured).top
        return replace(fresh, threshold=max(THRESHOLD, _EXCURSION * usual))

    @property
    def changed(self) -> bool:
        """Whether a sum has passed the threshold."""
        return max(self.rising, self.falling) > self.threshold

    @property
    def samples_since_change(self) -> int:
        """Samples followed since the change began, as far as the larger sum tells."""
        return self.rising_samples if self.rising > self.falling else self.falling_samples

    def quiet(self) -> ChangeWatch:
        """The same with both sums at zero."""
        return replace(self, rising=0.0, falling=0.0, rising_samples=0, falling_samples=0)

    def follow(self, predicted: Array, measured: Array) -> ChangeWatch:
        """The state after further samples (n,) [N].

        The slack is half of the smallest change worth an early fit, and never less than ``SLACK``.
        """
        state = self
        blocks = max(predicted.size // self.block, 1)
        for chosen in np.array_split(np.arange(predicted.size), blocks):
            state = state._next(predicted[chosen], measured[chosen])
        return state

    def _next(self, predicted: Array, measured: Array) -> ChangeWatch:
        # The sum over a window of a set that was fitted to it is zero, whatever swing is left:
        # so blocks are weighted by the force in them, as the likelihood says.
        deviation = float(predicted @ (measured - predicted)) / (self.noise * self.block_norm)
        shift = max(self.smallest_change * self.block_norm / self.noise, 2.0 * SLACK)
        slack = 0.5 * shift * float(predicted @ predicted) / self.block_norm**2
        rising = max(self.rising + deviation - slack, 0.0)
        falling = max(self.falling - deviation - slack, 0.0)
        count = predicted.size
        return replace(
            self,
            rising=rising,
            falling=falling,
            rising_samples=self.rising_samples + count if rising > 0.0 else 0,
            falling_samples=self.falling_samples + count if falling > 0.0 else 0,
            top=max(self.top, rising, falling),
        )


def change_point(predicted: Array, measured: Array, fewest: int) -> int:
    """Index from which on another force scale explains the samples (n,) best.

    Least squares over the two parts: the running set before, the best factor on it from there on,
    which has at least ``fewest`` samples. The detector itself knows the begin to a block only.
    """

    def to_the_end(products: Array) -> Array:
        return np.asarray(np.cumsum(products[::-1])[::-1])

    power = to_the_end(predicted * predicted)
    explained = to_the_end(predicted * measured) ** 2 / np.maximum(power, 1e-300)
    # Squared error without a change, less what the change explains of it from an index on.
    gain = explained - power - 2.0 * to_the_end(predicted * (measured - predicted))
    return int(np.argmax(gain[: max(predicted.size - fewest, 0) + 1]))


@dataclass(frozen=True)
class ScaleFit:
    """Factor on the force of the running set, with its standard error [1]."""

    factor: float
    standard_error: float


def fit_scale(predicted: Array, measured: Array) -> ScaleFit:
    """Factor on ``predicted`` (n,) [N] that comes nearest to ``measured``: the early re-fit.

    A fraction of a cycle determines this one number well, and seven coefficients not at all.
    Raises ValueError where the predicted force is zero.
    """
    power = float(predicted @ predicted)
    if power == 0.0:
        raise ValueError("the predicted force is zero: no factor on it can be found")
    factor = float(predicted @ measured) / power
    residual = measured - factor * predicted
    noise = float(residual @ residual) / max(predicted.size - 1, 1)
    return ScaleFit(factor, math.sqrt(noise / power))
