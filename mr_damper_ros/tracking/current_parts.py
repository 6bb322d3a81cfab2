"""A window of changing current, taken apart: the samples of about one current are one part.

Each part is an operating point of its own, whatever the law says of the dependence on the current.
Where the law explains all parts together as well as each is explained by itself, its dependence
on the current is known; else the parts are what it can be learnt from.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.estimation.set_error import error_of_set
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.motion_history import LONGEST_SETTLING
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array

_MOST_INTERVALS = 6

_FEWEST_SAMPLES = 64
"""A part of fewer samples is no operating point ..."""

_LEAST_SPEED = 0.2
"""... nor one in which the speed (RMS) is below this part of that of the window."""

_MOST_SAMPLES = 250
"""So many samples of a part tell what its own fit leaves."""

_AS_WELL = 1.25
"""The law explains the parts where it leaves no more than so many times what their own fits do."""

_BESIDES = 0.01
"""... or no more besides than this part of the force."""


@dataclass(frozen=True)
class PartsByCurrent:
    """What the parts' own fits leave of the force: ``rmse`` [N], ``nrmse``; what the law adds.

    ``explained``: whether the law leaves hardly more of all of them together.
    """

    rmse: float
    nrmse: float
    explained: bool


def parts_by_current(model: Model, window: Window, tolerance: float) -> list[Window]:
    """Parts of a window within which the current changes little; the window, if it does so itself.

    Levels of the current more than ``tolerance`` [A] apart are parts of their own. Where it passes
    through all values between, its range is cut into equal intervals. What lies only in the begin
    of the window is no part, if the force of the ``model`` there depends on the unknown past.
    """
    if float(np.ptp(window.current)) <= tolerance:
        return [window]
    lead_in = round(LONGEST_SETTLING * window.sample_count) if model.needs_past(window) else 0
    edges = _edges(window.current, tolerance)
    place = np.searchsorted(edges, window.current, side="right")
    speed = window.motion.velocity
    least = _LEAST_SPEED * float(np.sqrt(np.mean(speed**2)))
    parts = []
    for number in range(edges.size + 1):
        chosen = place == number
        if np.count_nonzero(chosen[lead_in:]) < _FEWEST_SAMPLES:
            continue
        moving = float(np.sqrt(np.mean(speed[chosen] ** 2))) >= least
        if moving and np.ptp(window.force[chosen]) > 0.0:
            parts.append(window.part(chosen))
    return parts


def _edges(current: Array, tolerance: float) -> Array:
    """Currents [A] at which one part ends and the next begins, rising."""
    levels = np.unique(current)
    widest = max(float(np.ptp(levels)) / _MOST_INTERVALS, tolerance)
    gaps = np.flatnonzero(np.diff(levels) > tolerance)
    edges = (0.5 * (levels[gaps] + levels[gaps + 1])).tolist()
    for stretch in np.split(levels, gaps + 1):
        count = math.ceil(float(np.ptp(stretch)) / widest)
        edges += np.linspace(stretch[0], stretch[-1], count + 1)[1:-1].tolist()
    return np.sort(edges)


def judge_parts(window: Window, parts: Sequence[Window], found: ParameterSet) -> PartsByCurrent:
    """How a set explains the parts of a window, against what their own fits leave."""
    few = [found.held(part.thinned(_MOST_SAMPLES)) for part in parts]
    own = [fit_window(found.law, part, found.values, method="least_squares") for part in few]
    alone = _pooled([fit.rmse for fit in own], parts)
    together = _pooled([error_of_set(found, [part]).rmse for part in few], parts)
    spread = float(np.std(window.force))
    explained = together <= max(_AS_WELL * alone, math.hypot(alone, _BESIDES * spread))
    return PartsByCurrent(alone, alone / spread, explained)


def _pooled(errors: Sequence[float], parts: Sequence[Window]) -> float:
    """RMSE [N] over all parts from that of each."""
    counts = [part.sample_count for part in parts]
    return math.sqrt(float(np.average(np.square(errors), weights=counts)))
