"""The error of a parameter set on runs that it was, or was not, identified from."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from mr_damper_ros.interface.comparison import Comparison, compare, error_entry, error_over
from mr_damper_ros.interface.estimates import html_table
from mr_damper_ros.interface.measured_runs import MeasuredRun, RunSource, measured_runs
from mr_damper_ros.interface.run_doubts import remarks_on
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.signals.error_sums import ErrorSums
from mr_damper_ros.tracking.predictor import PredictorSettings
from mr_damper_ros.tracking.state_directory import read_parameter_file
from mr_damper_ros.tracking.validity import current_allowance

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MARGINS = PredictorSettings()


@dataclass(frozen=True, eq=False)
class ValidatedRun:
    """Error of the set on one run; ``remark`` says where the run is not what the set is for."""

    comparison: Comparison
    remark: str

    @property
    def name(self) -> str:
        """Name of the run: the path of its bag, or that of the recording."""
        return self.comparison.name

    @property
    def error(self) -> ErrorSums:
        """RMSE, NRMSE and R² of the set on this run."""
        return self.comparison.error


@dataclass(frozen=True, eq=False)
class Validation:
    """Outcome of :func:`validate`: the set and its error on each run, in the order given.

    ``remarks`` say what seems wrong with the runs.
    """

    parameter_set: ParameterSet
    runs: tuple[ValidatedRun, ...]
    remarks: tuple[str, ...] = ()

    @property
    def error(self) -> ErrorSums:
        """RMSE, NRMSE and R² of the set on the samples of all runs together."""
        return error_over(run.comparison for run in self.runs)

    @property
    def nrmse(self) -> float:
        """RMSE over the standard deviation of the force [1], all runs together."""
        return self.error.nrmse

    def plot(self, run: int = 0) -> Figure:
        """Figure of one run: both loops, the force and the residual over time, its histogram."""
        from mr_damper_ros.interface.figures import comparison_figure

        return comparison_figure(self.runs[run].comparison)

    def document(self) -> dict[str, Any]:
        """The result as JSON can hold it."""
        return {
            "bags": [
                {"bag": run.name, "metrics": error_entry(run.error), "remark": run.remark}
                for run in self.runs
            ],
            "remarks": list(self.remarks),
        }

    def __str__(self) -> str:
        lines = []
        for run in self.runs:
            error = run.error
            lines.append(
                f"{run.name}: RMSE {error.rmse:.4g} N, NRMSE {error.nrmse:.2%}, "
                f"R2 {error.r2:.4f} ({error.count} samples)"
            )
            if run.remark:
                lines.append(f"  {run.remark}")
        lines += [f"WARNING: {remark}" for remark in self.remarks]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        rows = [
            (
                run.name,
                f"{run.error.rmse:.4g}",
                f"{run.error.nrmse:.2%}",
                f"{run.error.r2:.4f}",
                run.remark,
            )
            for run in self.runs
        ]
        return html_table(("run", "RMSE [N]", "NRMSE", "R2", ""), rows)


@one_thread()
def validate(
    parameters: ParameterSet | str | os.PathLike[str],
    *runs: RunSource,
    displacement: ArrayLike | None = None,
    force: ArrayLike | None = None,
    current: ArrayLike | None = None,
    period: float | None = None,
    accept_doubtful: bool = False,
) -> Validation:
    """Compare the force that a parameter set predicts with that of runs.

    Parameters
    ----------
    parameters
        A parameter set of any model, or its file.
    *runs, displacement, force, current, period, accept_doubtful
        As in :func:`identify`.

    Raises
    ------
    ValueError
        In one sentence that says what to change, where the set or a run cannot be used.

    Examples
    --------
    >>> import numpy as np
    >>> import mr_damper_ros as mr
    >>> bingham = mr.ParameterSet(np.array([900.0, 1500.0, 0.0]), model="bingham")
    >>> time = np.arange(2000) * 1e-3
    >>> displacement, velocity = 5e-3 * np.sin(20 * time), 0.1 * np.cos(20 * time)
    >>> force = 900 * np.tanh(velocity / 0.02) + 1500 * velocity
    >>> print(mr.validate(bingham, displacement=displacement, force=force,
    ...                   current=1.0, period=1e-3))
    arrays: RMSE 202.1 N, NRMSE 21.53%, R2 0.9536 (2000 samples)
    """
    if not isinstance(parameters, ParameterSet):
        parameters = read_parameter_file(Path(parameters))
    measured = measured_runs(
        runs,
        displacement=displacement,
        force=force,
        current=current,
        period=period,
        accept_doubtful=accept_doubtful,
    )
    return Validation(
        parameters,
        tuple(ValidatedRun(compare(parameters, run), _remark(parameters, run)) for run in measured),
        remarks_on(measured),
    )


def _remark(found: ParameterSet, run: MeasuredRun) -> str:
    """Where a run lies outside of what the set was identified from, by the predictor's margins."""
    remarks = []
    speeds, currents = zip(*(window.operating_point for window in run.windows), strict=True)
    low, high = found.peak_velocity_range
    margin = _MARGINS.velocity_margin
    if not low * (1.0 - margin) <= min(speeds) <= max(speeds) <= high * (1.0 + margin):
        remarks.append(
            f"peak velocity {_span(speeds)} m/s, and the set is for {low:.3g} to {high:.3g} m/s"
        )
    low, high = found.current_range
    margin = current_allowance(found.current_range, _MARGINS.current_margin)
    if not low - margin <= min(currents) <= max(currents) <= high + margin:
        remarks.append(f"current {_span(currents)} A, and the set is for {low:.3g} to {high:.3g} A")
    return f"OUT OF RANGE: {'; '.join(remarks)}" if remarks else ""


def _span(values: tuple[float, ...]) -> str:
    low, high = f"{min(values):.3g}", f"{max(values):.3g}"
    return low if low == high else f"{low} to {high}"
