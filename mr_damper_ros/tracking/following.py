"""What it takes to follow a damper of any model: fit, errors, early fit, force scale.

The sigmoid law and its extension have a window fit of their own, seven scales with operating-point
coefficients (:mod:`fit`); all other models are fitted alike (:mod:`model_fit`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mr_damper_ros.estimation.model_fit import (
    ModelMisfit,
    as_model_fit,
    fit_model,
    model_force,
    unsettled_samples,
)
from mr_damper_ros.estimation.window_fit import WindowFit, fit_window
from mr_damper_ros.models import Model
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL
from mr_damper_ros.models.sigmoid.law import SCALE_INDICES, SHAPE_PARAMETER_NAMES
from mr_damper_ros.models.sigmoid.scale_misfit import ScaleMisfit, Window, scale_parameter_errors
from mr_damper_ros.models.sigmoid.sigmoid_model import is_sigmoid
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.cusum import ScaleFit
from mr_damper_ros.tracking.force_scale import Baselines, ForceScale, force_scale, scale_between
from mr_damper_ros.tracking.unscented_filter import FilterState, as_fit

STRENGTH = np.array([True, False, False, False, False, False, True])
"""Of the seven scales, those that rise and fall with the strength of the damper."""


def fit_to_window(
    model: Model,
    window: Window,
    start: Array,
    *,
    method: str,
    robust: bool,
    should_stop: Callable[[], bool] | None = None,
) -> WindowFit:
    """Fit what one window determines, from parameters ``start`` (p,); see :func:`fit_window`."""
    if is_sigmoid(model):
        return fit_window(window, start, method=method, robust=robust, should_stop=should_stop)
    return fit_model(model, window, start, method=method, robust=robust, should_stop=should_stop)


def fitted_errors(model: Model, fit: WindowFit) -> tuple[Array, Array]:
    """Places of the parameters that a window was fitted with, and their standard errors.

    NaN where the window does not determine one.
    """
    if is_sigmoid(model):
        return SCALE_INDICES, scale_parameter_errors(fit.scales, fit.covariance)
    return model.free_indices, np.sqrt(np.diag(fit.covariance))


def shape_is_known(model: Model, observable: np.ndarray) -> bool:
    """Whether a parameter is known (p,) that only several operating points determine."""
    shape = np.isin(model.parameter_names, SHAPE_PARAMETER_NAMES)
    return is_sigmoid(model) and bool(np.any(observable[shape]))


def lasting_force(model: Model, window: Window, parameters: Array) -> Array:
    """The part (n,) [N] of the force that stays where the damper loses all its strength."""
    weakest = parameters.copy()
    weakest[model.strength_indices] = 0.0
    return model_force(model, window, np.clip(weakest, *model.bounds))


def strengthened(
    model: Model, window: Window, start: Array, found: ScaleFit, method: str
) -> WindowFit:
    """Parameters ``start`` (p,) with the strength of the damper changed, as a fit of the window."""
    if is_sigmoid(model):
        scales = ScaleMisfit(window, start).start
        moved = np.where(STRENGTH, scales, 0.0)
        own = FilterState(
            scales + moved * (found.factor - 1.0),
            np.outer(moved, moved) * found.standard_error**2,
            0,
            window.operating_point,
        )
        return replace(as_fit(own, window, start, 2), method=method)
    moved = np.zeros(start.size)
    moved[model.strength_indices] = start[model.strength_indices]
    free = moved[model.free_indices]
    return as_model_fit(
        model,
        window,
        np.clip(start + moved * (found.factor - 1.0), *model.bounds),
        np.outer(free, free) * found.standard_error**2,
        method=method,
        evaluations=2,
    )


def scale_of_force(
    model: Model, window: Window, fit: WindowFit, baselines: Baselines
) -> ForceScale:
    """Force of a fit of the window over that of the baseline, with its standard error.

    Of the sigmoid law the two loops of the coefficients are compared, see :mod:`drift`; of any
    other model the forces predicted over the motion of the window, so its noise plays no part.
    """
    if model.name == DEFAULT_MODEL:
        return force_scale(baselines, fit)
    baseline = baselines.get(fit.operating_point)
    if baseline is None:
        return ForceScale()
    if is_sigmoid(model):
        jacobian = ScaleMisfit(window, fit.parameters).jacobian(fit.scales)
    else:
        jacobian = ModelMisfit(model, window, fit.parameters).parameter_jacobian(fit.parameters)
    settled = ~unsettled_samples(model, window, fit.parameters)
    reference, present = (
        model_force(model, window, parameters)[settled]
        for parameters in (baseline.parameters, fit.parameters)
    )
    return scale_between(reference, present, jacobian[settled], fit.covariance)
