"""Fit of any model to one window: the parameters that one run determines, all models alike.

The sigmoid law, whose seven coefficients allow more, has a fit of its own (:mod:`fit`).

Derivatives are by differences. Bounds are kept by a change of variables (James and Roos, MINUIT,
Computer Physics Communications 10, 1975). What a model remembers is that of the motion behind the
window, see :class:`History`; where this begins with the window, samples whose force still depends
on the unknown past are left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from mr_damper_ros.estimation.covariance import least_squares_covariance
from mr_damper_ros.estimation.local_search import LocalSearch, StopRequestedError
from mr_damper_ros.estimation.window_fit import CONVERGED, POOR_START, WINDOW_METHODS, WindowFit
from mr_damper_ros.models import Model
from mr_damper_ros.models.sigmoid.scale_misfit import Window
from mr_damper_ros.models.sigmoid.sigmoid_model import is_sigmoid
from mr_damper_ros.signals.arrays import Array

_STEP = 1e-6
"""Step of a difference, relative to the size of the parameter."""

_MOST_STEPS = 40
"""Of a search: a step costs as many evaluations of the force as there are unknowns."""

_INSIDE = 1e-3
"""Distance from a bound at which a search starts at least, relative to the parameter's size."""

_ROUGHLY = 1e-3
_FINELY = 1e-6
"""Relative tolerance of the sum of squares: of the search from each start, and of the last one.

A hysteresis kinks where it yields, so that the last digits would take many steps.
"""

_FORGOTTEN = 0.01
"""A start is forgotten where it changes the force by less than this part of its span."""

_LONGEST_MEMORY = 0.25
"""No more than this part of a window is left out because its past is not known."""


# A set may hold any finite numbers: what overflows, here and below, is judged by its misfit.
@np.errstate(over="ignore", invalid="ignore")
def model_force(model: Model, window: Window, parameters: Array) -> Array:
    """Force [N] of a model at the samples of a window, shape (..., n), parameters (..., p)."""
    if is_sigmoid(model):
        sets = parameters.reshape(-1, parameters.shape[-1])
        forces = np.array([window.predicted_force(one) for one in sets])
        return forces.reshape(*parameters.shape[:-1], window.sample_count)
    if not model.remembers:
        return model.force(parameters, window.motion, window.current, 1.0)
    history = window.history.coarse
    stream = model.stream(history.period)
    force = stream.follow(parameters, history.motion, history.current)
    if history.periodic:
        force = stream.follow(parameters, history.motion, history.current)
    return np.moveaxis(history.at_samples(np.moveaxis(force, -1, 0)), 0, -1)


def unsettled_samples(model: Model, window: Window, parameters: Array) -> np.ndarray:
    """Mask (n,) of samples whose force depends on what the model knew before the window."""
    unsettled = np.zeros(window.sample_count, dtype=bool)
    if not model.remembers or window.history.periodic:
        return unsettled
    history = window.history.coarse
    stream = model.stream(history.period)
    first, second = (stream.follow(parameters, history.motion, history.current) for _ in range(2))
    differs = np.abs(first - second) > _FORGOTTEN * float(np.ptp(first))
    # The true past may be further off than either of the two.
    count = 2 * int(np.max(np.flatnonzero(differs), initial=-1) + 1)
    return np.asarray(history.places < min(count, _LONGEST_MEMORY * differs.size))


class ModelMisfit:
    """Residual of a window as a function of the parameters (f,) that one run determines.

    The unknowns are without bounds and of order 1; the other parameters stay as they are given.
    """

    def __init__(self, model: Model, window: Window, parameters: Array) -> None:
        self.model = model
        self.window = window
        self.differences = 0
        self._given = np.array(parameters, dtype=float)
        self._free = model.free_indices
        self._sizes = _sizes(model, window)[self._free]
        self._low, self._high = (bound[self._free] for bound in model.bounds)
        self.settled = ~unsettled_samples(model, window, self._given)

    @property
    @np.errstate(over="ignore", invalid="ignore")
    def start(self) -> Array:
        """The unknowns of the parameters given, or next to them, if those are on a bound."""
        margin = np.minimum(_INSIDE * self._sizes, 0.25 * (self._high - self._low))
        values = np.clip(self._given[self._free], self._low + margin, self._high - margin)
        above = (values - self._low) / self._sizes + 1.0
        share = 2.0 * (values - self._low) / (self._high - self._low) - 1.0
        return np.where(
            np.isinf(self._low),
            values / self._sizes,
            np.where(np.isinf(self._high), np.sqrt(above**2 - 1.0), np.arcsin(share)),
        )

    @np.errstate(over="ignore", invalid="ignore")
    def _values(self, unknowns: Array) -> tuple[Array, Array]:
        """Values (f,) of the free parameters, and their derivatives by the unknowns."""
        root = np.sqrt(unknowns**2 + 1.0)
        half = 0.5 * (self._high - self._low)
        values = np.where(
            np.isinf(self._low),
            unknowns * self._sizes,
            np.where(
                np.isinf(self._high),
                self._low + (root - 1.0) * self._sizes,
                self._low + half * (1.0 + np.sin(unknowns)),
            ),
        )
        slopes = np.where(
            np.isinf(self._low),
            self._sizes,
            np.where(np.isinf(self._high), unknowns / root * self._sizes, half * np.cos(unknowns)),
        )
        return np.clip(values, self._low, self._high), slopes

    def parameters(self, unknowns: Array) -> Array:
        """All parameters (p,)."""
        values = self._given.copy()
        values[self._free] = self._values(unknowns)[0]
        return values

    def residual(self, unknowns: Array) -> Array:
        """Model minus measurement [N], shape (n,); zero where the past is not known."""
        force = model_force(self.model, self.window, self.parameters(unknowns))
        return np.where(self.settled, force - self.window.force, 0.0)

    def jacobian(self, unknowns: Array) -> Array:
        """Derivatives of the residual by the unknowns, shape (n, f)."""
        return self.parameter_jacobian(self.parameters(unknowns)) * self._values(unknowns)[1]

    def parameter_jacobian(self, parameters: Array) -> Array:
        """Derivatives of the residual by the free parameters, shape (n, f)."""
        values = parameters[self._free]
        steps = _STEP * np.maximum(np.abs(values), 0.1 * self._sizes)
        steps = np.where(values + steps > self._high, -steps, steps)
        moved = np.tile(parameters, (values.size + 1, 1))
        moved[1 + np.arange(values.size), self._free] += steps
        forces = model_force(self.model, self.window, moved)
        self.differences += values.size + 1
        derivatives = (forces[1:] - forces[0]).T / steps
        return np.where(self.settled[:, np.newaxis], derivatives, 0.0)


def fit_model(
    model: Model,
    window: Window,
    start: Array | None = None,
    *,
    method: str = "least_squares",
    robust: bool = False,
    should_stop: Callable[[], bool] | None = None,
) -> WindowFit:
    """Fit a model to a window, from the parameters ``start`` (p,) or from the model's own starts.

    A start that leaves more than a quarter of the force's variance competes with those of the
    model. ``method``, ``robust`` and ``should_stop`` as in :func:`fit_window`, and its errors.
    The ``scales`` of the result are the free parameters (f,); it has no coefficients.
    """
    if method not in WINDOW_METHODS:
        raise ValueError(f"method '{method}' is unknown: use one of {', '.join(WINDOW_METHODS)}")
    spread = float(np.std(window.force))
    if spread == 0.0:
        raise ValueError("the force does not change: there is nothing to identify")
    searches: list[LocalSearch] = []
    weights = np.ones(window.sample_count)
    message = CONVERGED

    def begin(parameters: Array) -> LocalSearch:
        misfit = ModelMisfit(model, window, parameters)
        searches.append(LocalSearch(misfit, misfit.start, should_stop))
        searches[-1].try_out(misfit.start)
        return searches[-1]

    try:
        # "not <=" also holds for a cost that is not a number.
        if start is None or not _mean_square(begin(start)) <= POOR_START * spread**2:
            for candidate in cold_starts(model, window):
                begin(candidate).least_squares(tolerance=_ROUGHLY, most_steps=_MOST_STEPS)
        search = min(searches, key=_mean_square)
        if method == "nelder_mead":
            search.nelder_mead()
        search.least_squares(tolerance=_FINELY, most_steps=_MOST_STEPS)
        if robust:
            weights = search.reweighted_least_squares()
    except StopRequestedError:
        message = "stopped before it converged: this is the best so far"
        search = min(searches, key=_mean_square)
    misfit = search.problem
    assert isinstance(misfit, ModelMisfit)
    parameters = misfit.parameters(search.best)
    residual = misfit.residual(search.best)[misfit.settled]
    jacobian = misfit.parameter_jacobian(parameters)[misfit.settled]
    return as_model_fit(
        model,
        window,
        parameters,
        least_squares_covariance(jacobian, residual, weights[misfit.settled]),
        method=method,
        evaluations=sum(s.evaluations + _differences(s) for s in searches),
        message=message,
    )


def as_model_fit(
    model: Model,
    window: Window,
    parameters: Array,
    covariance: Array,
    *,
    method: str,
    evaluations: int,
    message: str = CONVERGED,
) -> WindowFit:
    """Parameters (p,) as a fit of the window; ``covariance`` (f, f) of the free ones."""
    settled = ~unsettled_samples(model, window, parameters)
    residual = (model_force(model, window, parameters) - window.force)[settled]
    rmse = math.sqrt(float(np.mean(residual**2)))
    return WindowFit(
        scales=parameters[model.free_indices],
        covariance=covariance,
        parameters=parameters,
        coefficients=np.empty(0),
        coefficient_covariance=np.empty((0, 0)),
        operating_point=window.operating_point,
        rmse=rmse,
        nrmse=rmse / float(np.std(window.force)),
        sample_count=window.sample_count,
        method=method,
        evaluations=evaluations,
        success=message == CONVERGED,
        message=message,
    )


def _mean_square(search: LocalSearch) -> float:
    """Mean square residual [N²] over the samples that have one."""
    assert isinstance(search.problem, ModelMisfit)
    return search.best_cost / int(np.count_nonzero(search.problem.settled))


def _differences(search: LocalSearch) -> int:
    assert isinstance(search.problem, ModelMisfit)
    return search.problem.differences


def cold_starts(model: Model, window: Window) -> Array:
    """The model's own starts (k, p) from what can be read off a window."""
    top, bottom = float(window.force.max()), float(window.force.min())
    force, speed, amplitude = _spans(window)
    return np.clip(model.scale_starts(force, 0.5 * (top + bottom), speed, amplitude), *model.bounds)


def _spans(window: Window) -> tuple[float, float, float]:
    """Half the span of the force [N], the largest velocity [m/s] and displacement [m]."""
    half_span = max(0.5 * float(np.ptp(window.force)), 1e-9)
    speed = float(np.quantile(np.abs(window.motion.velocity), 0.98))
    amplitude = float(np.quantile(np.abs(window.motion.displacement), 0.98))
    return half_span, max(speed, 1e-9), max(amplitude, 1e-9)


def _sizes(model: Model, window: Window) -> Array:
    """A typical size (p,) of each parameter, from its unit."""
    force, speed, amplitude = _spans(window)
    by_unit = {
        "N": force,
        "N s/m": force / speed,
        "N/m": force / amplitude,
        "s/m": 1.0 / speed,
        "m/s": speed,
        "m": amplitude,
        "m/N": amplitude / force,
        "1": 1.0,
        "1/A": 1.0,
        "A": 1.0,
    }
    return np.array([by_unit[parameter.unit] for parameter in model.parameters])
