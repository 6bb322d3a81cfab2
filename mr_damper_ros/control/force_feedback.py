"""Feedback of the measured force: a slow factor on what is wanted.

A damper that has got weaker since it was identified is too weak in either direction, so the
correction is a factor and not a sum. It is the integral of the error, weighed by the wanted force
(the normalised LMS rule; Widrow and Stearns, Adaptive Signal Processing, 1985).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import Array

_LEAST = 0.05
"""Of the largest force wanted so far: what is smaller tells nothing of the factor."""


@dataclass(frozen=True)
class FeedbackSettings(CheckedSettings):
    """How much the measured force counts."""

    feedback_gain: float = option(
        0.0,
        "Gain [1/s] of the feedback of the measured force: 1 takes about a second to make good a "
        "damper that has got weaker. 0: feedforward alone, for a rig without a load cell.",
        minimum=0.0,
        maximum=100.0,
    )
    feedback_limit: float = option(
        0.2,
        "The feedback changes the wanted force by no more than this part.",
        minimum=0.0,
        maximum=0.9,
    )


class ForceFeedback:
    """Follows wanted and measured forces; ``factor`` is by what the wanted force is multiplied."""

    def __init__(self, settings: FeedbackSettings) -> None:
        self._settings = settings
        self._expected = math.nan
        self._largest = 0.0
        self.factor = 1.0

    def expect(self, wanted: float) -> None:
        """The force [N] that the next block should have; NaN where it cannot be had."""
        self._expected = wanted
        if not math.isnan(wanted):
            self._largest = max(self._largest, abs(wanted))

    def pause(self) -> None:
        """The next block is not controlled."""
        self._expected = math.nan

    def follow(self, measured: Array, duration: float) -> None:
        """Correct the factor by the force (n,) [N] of a block of this duration [s]."""
        wanted, gain = self._expected, self._settings.feedback_gain
        if gain == 0.0 or not abs(wanted) > _LEAST * self._largest:
            return
        step = min(gain * duration, 1.0) * (wanted - float(np.mean(measured))) / wanted
        limit = self._settings.feedback_limit
        self.factor = min(max(self.factor + step, 1.0 - limit), 1.0 + limit)
