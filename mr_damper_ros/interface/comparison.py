"""Measured against predicted force: the errors of a parameter set."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from mr_damper_ros.interface.measured_runs import MeasuredRun
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.error_sums import ErrorSums, pooled


@dataclass(frozen=True, eq=False)
class Comparison:
    """Measured and predicted force of one run along its motion.

    Arrays of shape (n,): ``time`` [s] from the first sample, ``displacement`` [m] from the centre
    of the motion, ``velocity`` [m/s], ``measured`` and ``predicted`` force [N]. ``name`` and
    ``provenance`` are those of the run.
    """

    name: str
    time: Array
    displacement: Array
    velocity: Array
    measured: Array
    predicted: Array
    provenance: str = ""

    @property
    def residual(self) -> Array:
        """Predicted minus measured force [N], shape (n,)."""
        return self.predicted - self.measured

    @cached_property
    def error(self) -> ErrorSums:
        """RMSE, NRMSE and R² of the prediction."""
        return ErrorSums.of(self.predicted, self.measured)


def compare(found: ParameterSet, run: MeasuredRun) -> Comparison:
    """The force that a parameter set of any model gives for a run, next to that measured.

    As the set is used in a prediction: with the peak velocity held within its range.
    """
    time = [
        start + window.period * np.arange(window.sample_count)
        for start, window in zip(run.starts, run.windows, strict=True)
    ]
    return Comparison(
        name=run.name,
        time=np.concatenate(time),
        displacement=np.concatenate([window.motion.displacement for window in run.windows]),
        velocity=np.concatenate([window.motion.velocity for window in run.windows]),
        measured=np.concatenate([window.force for window in run.windows]),
        predicted=np.concatenate([found.force(window) for window in run.windows]),
        provenance=run.provenance,
    )


def error_over(comparisons: Iterable[Comparison]) -> ErrorSums:
    """Error of the predictions of several runs, all their samples together."""
    return pooled(comparison.error for comparison in comparisons)


def error_entry(error: ErrorSums) -> dict[str, Any]:
    """RMSE [N], NRMSE, R2 and the number of samples as JSON can hold them."""
    return {
        "rmse": error.rmse,
        "nrmse": error.nrmse,
        "r2": error.r2,
        "n_samples": error.count,
    }
