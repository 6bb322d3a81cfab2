"""What a window says, weighed against what the running set already knows.

In a steady sine a window determines its seven scales to a fraction of a percent. In random motion
it may hold two strokes, and what the law cannot follow is correlated over much of it: some
combinations of the scales are then as good as unknown, and a fit on its own puts them anywhere.
They must stay where they were, and so must a scale that the window hardly notices, such as the
viscous slope of a direction in which it is slow. So the fit of a window is the most probable set
given both the window and the running set: the samples count by what the law leaves of them at best,
once per correlation length, and the scales wander from window to window by no more than a damper
does.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from mr_damper_ros.estimation.covariance import correlation_length
from mr_damper_ros.estimation.local_search import LocalSearch
from mr_damper_ros.estimation.window_fit import WindowFit
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models import Model
from mr_damper_ros.models.sigmoid.extension import SIGMOID_COUNT
from mr_damper_ros.models.sigmoid.scale_misfit import ScaleMisfit, Window
from mr_damper_ros.models.sigmoid.sigmoid_model import is_sigmoid
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.unscented_filter import FilterState, as_fit

_CONTRADICTED = 24.3
"""Seven squared normal numbers exceed this once in a thousand times."""

_MOST_DOUBLINGS = 10

_SINE_SAMPLES = 256

WANDER = 0.03
"""Standard deviation of what the change of one scale between two windows does to the force [1].

Heating changes the force by less within a window (thesis: 26 % in ten minutes). A sudden change is
another matter: where the window contradicts the running set, they may wander further.
"""


def with_prior(
    model: Model,
    fit: WindowFit,
    window: Window,
    running: Array,
    *,
    fastest: float = math.inf,
    robust: bool = False,
) -> WindowFit:
    """The fit of a window on its own, weighed against the running set of shape (16,) or (19,).

    ``fastest`` [m/s] is the largest peak velocity that the running set holds for, infinite where
    that is not known: what a scale does to the force is seen in the window and in a sine so fast.
    Where the window determines the scales, the fit hardly changes; that of a model other than the
    sigmoid law and its extension does not change at all.
    """
    if not is_sigmoid(model):
        return fit
    misfit = ScaleMisfit(window, running)
    prior = misfit.start
    width = _width(misfit)
    if math.isfinite(fastest):
        sine = _sine(fastest, window.operating_point[1])
        width = np.minimum(width, _width(ScaleMisfit(sine, running[:SIGMOID_COUNT])))
    if not np.isfinite(width).all():
        return fit  # A set without any force knows nothing.
    left = misfit.residual(fit.scales)
    length = max(correlation_length(left), 1)
    # A fit with seven scales leaves less of few independent samples than is there.
    freedom = max(left.size / length - prior.size, 1.0)
    noise = float(np.sqrt(np.sum(left**2) / freedom))
    evaluations = fit.evaluations
    for _ in range(_MOST_DOUBLINGS):
        search = LocalSearch(_Weighed(misfit, prior, noise / width), prior)
        search.try_out(prior)
        search.try_out(fit.scales)
        search.least_squares()
        if robust:
            search.reweighted_least_squares()
        scales = search.best
        evaluations += search.evaluations
        if float(np.sum(((scales - prior) / width) ** 2)) <= _CONTRADICTED:
            break
        # The damper has changed by more than it usually does: less is known than was thought.
        width = 2.0 * width
    information = misfit.jacobian(scales) * width / noise if noise > 0.0 else np.zeros((1, 7))
    precision = information.T @ information + np.eye(prior.size)
    covariance = np.linalg.inv(precision) * np.outer(width, width)
    state = FilterState(scales, covariance, 0, window.operating_point)
    weighed = as_fit(state, window, running, evaluations)
    return replace(weighed, method=fit.method, success=fit.success, message=fit.message)


def _width(misfit: ScaleMisfit) -> Array:
    """Standard deviation (7,) of the change of each scale between two windows, by its effect.

    Infinite where there is no force to compare it with.
    """
    jacobian = misfit.jacobian(misfit.start)
    effect = np.sqrt(np.mean(jacobian**2, axis=0))
    force = misfit.residual(misfit.start) + misfit.window.force
    strength = float(np.sqrt(np.mean(force**2)))
    if strength == 0.0:
        return np.full(effect.size, np.inf)
    return np.asarray(WANDER * strength / np.maximum(effect, 1e-12 * strength))


def _sine(peak_velocity: float, current: float) -> Window:
    """A cycle of a sine, to see what scales do to the force of it."""
    angle: Array = 2.0 * np.pi * np.arange(_SINE_SAMPLES) / _SINE_SAMPLES
    nothing = np.zeros(_SINE_SAMPLES)
    velocity, acceleration = peak_velocity * np.cos(angle), -np.sin(angle)
    speeds = np.full(_SINE_SAMPLES, peak_velocity)
    motion = Motion(nothing, velocity, acceleration, speeds, sine=None)
    return Window(motion, nothing, np.full(_SINE_SAMPLES, current))


class _Weighed:
    """Residual of a window, and below it that of the prior, in the unit of the samples' noise."""

    def __init__(self, misfit: ScaleMisfit, prior: Array, weights: Array) -> None:
        self._misfit = misfit
        self._prior = prior
        self._weights = weights

    def residual(self, scales: Array) -> Array:
        return np.concatenate(
            (self._misfit.residual(scales), self._weights * (scales - self._prior))
        )

    def jacobian(self, scales: Array) -> Array:
        return np.vstack((self._misfit.jacobian(scales), np.diag(self._weights)))
