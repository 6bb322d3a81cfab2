"""What samples that are held back from a fit say of the sets before and after it."""

from __future__ import annotations

import math

import numpy as np

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import Model
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.acceptance import Evidence

_CHUNKS = 40
_HELD_BACK_EVERY = 4
"""Of the chunks into which a window is cut, every fourth is held back from the fit."""


def held_back_samples(count: int) -> np.ndarray:
    """Mask (n,) of the samples that are held back: chunks spread over the whole window."""
    chunk = np.arange(count) * _CHUNKS // max(count, 1)
    return np.asarray(chunk % _HELD_BACK_EVERY == _HELD_BACK_EVERY - 1)


def evidence_of(
    model: Model, held_back: np.ndarray, window: Window, before: Array, after: Array
) -> Evidence:
    """What the held-back samples (mask, shape (n,)) of a window say of two sets (p,)."""
    settled = model.settled(window, after)
    spread = float(np.std(window.force))
    old, new = (model.window_force(window, set_) for set_ in (before, after))
    if not np.isfinite(old).all():
        # Whatever was loaded there, anything is better.
        old = np.full(old.size, math.inf)
    rmse_before, rmse_after = (
        float(np.sqrt(np.mean((force - window.force)[held_back & settled] ** 2)))
        for force in (old, new)
    )
    power = float(old[settled] @ old[settled])
    change = math.inf
    if 0.0 < power < math.inf:
        change = float(new[settled] @ old[settled]) / power - 1.0
    return Evidence(rmse_before / spread, rmse_after / spread, rmse_after, change)
