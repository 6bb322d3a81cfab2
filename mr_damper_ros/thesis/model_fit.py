"""Identification of any of the reviewed models from one record, all models in the same way.

Bounded least squares from the model's own starts; the Jacobian is by differences, whose sets are
evaluated side by side.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from mr_damper_ros.damper.models import Model
from mr_damper_ros.damper.sigmoid import Array
from mr_damper_ros.identification.window import Window

_STEP = 1e-6


@dataclass(frozen=True, eq=False)
class ModelFit:
    """Parameters (p,), ``rmse`` [N], ``nrmse`` (over the force's standard deviation) [1].

    ``evaluations`` of the force over the record, differences included; ``seconds`` of processor
    time; ``seconds_per_sample`` to predict.
    """

    parameters: Array
    rmse: float
    nrmse: float
    evaluations: int
    seconds: float
    seconds_per_sample: float


def fit_model(model: Model, record: Window, period: float, evaluations: int = 40) -> ModelFit:
    """Least-squares fit of a model to a record sampled every ``period`` [s].

    ``evaluations``: of the residual from each start, at most.
    """
    motion, force = record.motion, record.force
    half_span = max(0.5 * float(np.ptp(force)), 1e-9)
    middle = 0.5 * float(force.max() + force.min())
    speed = float(np.quantile(np.abs(motion.velocity), 0.98))
    amplitude = float(np.quantile(np.abs(motion.displacement), 0.98))
    starts = model.scale_starts(half_span, middle, speed, amplitude)
    free = model.free_indices
    low, high = (side[free] for side in model.bounds)
    count = 0
    began = time.process_time()
    best: tuple[float, Array] = (np.inf, starts[0])
    for start in starts:
        sizes = _sizes(starts, half_span, speed, amplitude, model)[free]

        def forces(unknowns: Array, start: Array = start, sizes: Array = sizes) -> Array:
            values = np.broadcast_to(start, (*unknowns.shape[:-1], start.size)).copy()
            values[..., free] = unknowns * sizes
            return model.force(values, motion, record.current, period)

        def residual(unknowns: Array, forces: Callable[[Array], Array] = forces) -> Array:
            nonlocal count
            count += 1
            return (forces(unknowns) - force) / half_span

        def jacobian(unknowns: Array, forces: Callable[[Array], Array] = forces) -> Array:
            nonlocal count
            count += unknowns.size + 1
            steps = _STEP * np.maximum(np.abs(unknowns), 0.1)
            moved = forces(np.vstack([unknowns, unknowns + np.diag(steps)]))
            return (moved[1:] - moved[0]).T / steps / half_span

        inside = np.clip(start[free], low, high) / sizes
        edges = (low / sizes, high / sizes)
        margin = 1e-6 * np.maximum(np.abs(inside), 1.0)
        inside = np.clip(inside, edges[0] + margin, edges[1] - margin)
        fit = least_squares(
            residual, inside, jac=jacobian, bounds=edges, x_scale="jac", max_nfev=evaluations,
            xtol=1e-6, ftol=1e-6, gtol=1e-8,
        )  # fmt: skip
        if fit.cost < best[0]:
            values = np.array(start, dtype=float)
            values[free] = fit.x * sizes
            best = (float(fit.cost), values)
    seconds = time.process_time() - began
    began = time.process_time()
    predicted = model.force(best[1], motion, record.current, period)
    per_sample = (time.process_time() - began) / force.size
    rmse = float(np.sqrt(np.mean((predicted - force) ** 2)))
    return ModelFit(best[1], rmse, rmse / float(np.std(force)), count, seconds, per_sample)


def _sizes(starts: Array, half_span: float, speed: float, amplitude: float, model: Model) -> Array:
    """A typical size of each parameter, from its unit."""
    by_unit = {
        "N": half_span,
        "N s/m": half_span / speed,
        "N/m": half_span / amplitude,
        "s/m": 1.0 / speed,
        "m/s": speed,
        "m": amplitude,
        "s": amplitude / speed,
        "1": 1.0,
        "1/A": 1.0,
        "A": 1.0,
        "s/A": amplitude / speed,
    }
    return np.array([by_unit[parameter.unit] for parameter in model.parameters])
