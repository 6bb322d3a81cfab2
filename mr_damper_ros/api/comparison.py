"""Comparison of measured and predicted force: errors, figures and validation of a set."""

from __future__ import annotations

import io
import os
import re
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mr_damper_ros.api.findings import html_table
from mr_damper_ros.api.inertia import without_inertia
from mr_damper_ros.api.measured_runs import MeasuredRun, RunSource, measured_runs, remarks_on
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.processes.files import write_bytes
from mr_damper_ros.report.document import figure_of, styled
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.error_sums import ErrorSums, pooled
from mr_damper_ros.tracking.predictor import PredictorSettings
from mr_damper_ros.tracking.state_directory import read_parameter_file
from mr_damper_ros.tracking.validity import current_allowance

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Comparison:
    """Measured and predicted force of one run.

    Arrays of shape (n,): ``time`` [s] since the first sample, ``displacement`` [m] from the centre
    of the motion, ``velocity`` [m/s], ``measured`` and ``predicted`` force [N]. ``name`` and
    ``provenance`` are copied from the run.
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
    """Compare the force of a parameter set with the measured force of a run.

    As in a prediction, the peak velocity is limited to the range of the set.
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
        predicted=np.concatenate(
            [found.window_force(window, gradual=None) for window in run.windows]
        ),
        provenance=run.provenance,
    )


def error_over(comparisons: Iterable[Comparison]) -> ErrorSums:
    """Prediction error over the samples of all runs."""
    return pooled(comparison.error for comparison in comparisons)


class ComparedRun:
    """Base class of the runs of a result: name and error of the ``comparison``."""

    comparison: Comparison

    @property
    def name(self) -> str:
        """Path of the bag, or name of the recording."""
        return self.comparison.name

    @property
    def error(self) -> ErrorSums:
        """RMSE, NRMSE and R² of the set on this run."""
        return self.comparison.error


class ComparedRuns:
    """Base class of results with ``runs``: overall error and figures."""

    runs: tuple[ComparedRun, ...]

    @property
    def error(self) -> ErrorSums:
        """RMSE, NRMSE and R² of the set over the samples of all runs."""
        return error_over(run.comparison for run in self.runs)

    @property
    def rmse(self) -> float:
        """Root mean square error of the force over all runs [N]."""
        return self.error.rmse

    @property
    def nrmse(self) -> float:
        """RMSE relative to the standard deviation of the force [1], over all runs."""
        return self.error.nrmse

    def plot(self, run: int = 0) -> Figure:
        """Figure of one run: both loops, force and residual over time, residual histogram."""
        return comparison_figure(self.runs[run].comparison)


def error_entry(error: ErrorSums) -> dict[str, Any]:
    """RMSE [N], NRMSE, R² and the number of samples as JSON-compatible values."""
    return {
        "rmse": error.rmse,
        "nrmse": error.nrmse,
        "r2": error.r2,
        "n_samples": error.count,
    }


FORMATS = ("png", "svg", "pdf")

_LEGEND = 0.06
"""Fraction of the height of the figure for the legend."""

_MEASURED = {"color": "0.65", "linestyle": "none", "marker": ".", "markersize": 3.0}
_PREDICTED = {"color": "#8f1023", "linewidth": 1.2}
"""Light dots and a dark line, which also differ without colour."""


def comparison_figure(comparison: Comparison, title: str = "") -> Figure:
    """Figure of a comparison: both loops, force and residual over time, residual histogram.

    ``title`` is an additional line in the heading. The heading always contains name, NRMSE, RMSE
    and provenance of the run.
    """
    with styled():
        return _drawn(comparison, title)


def save_figures(
    comparisons: Iterable[Comparison], folder: Path, formats: Sequence[str], title: str = ""
) -> list[Path]:
    """Save a figure of each comparison in all formats; returns the paths. Raises OSError."""
    written: list[Path] = []
    for comparison in comparisons:
        figure = comparison_figure(comparison, title)
        stem = _file_name(comparison.name, {path.stem for path in written})
        for kind in formats:
            written.append(folder / f"{stem}.{kind}")
            content = io.BytesIO()
            figure.savefig(content, format=kind, dpi=150)
            write_bytes(written[-1], content.getvalue())
    return written


def _file_name(name: str, taken: set[str]) -> str:
    """A valid, unused file name from the name of a run, which may be a path."""
    stem = re.sub(r"[^\w.+-]+", "_", Path(name).name.removesuffix(".mcap")).strip("._") or "run"
    free, number = stem, 1
    while free in taken:
        number += 1
        free = f"{stem}_{number}"
    return free


def _drawn(comparison: Comparison, title: str) -> Figure:
    figure = figure_of(7.2, 7.6)
    # Space for the legend; the Matplotlib of Ubuntu 24.04 does not support loc="outside …".
    figure.get_layout_engine().set(rect=(0.0, _LEGEND, 1.0, 1.0 - _LEGEND))
    axes: dict[str, Any] = figure.subplot_mosaic(
        [["velocity"] * 2 + ["displacement"] * 2, ["force"] * 4, ["residual"] * 3 + ["histogram"]],
        height_ratios=[1.25, 1.0, 0.7],
    )
    c = comparison
    gaps = np.flatnonzero(np.diff(c.time) > 1.5 * float(np.median(np.diff(c.time)))) + 1
    _pair(axes["velocity"], c.velocity, c, gaps)
    _pair(axes["displacement"], 1e3 * c.displacement, c, gaps)
    _pair(axes["force"], c.time, c, gaps)
    axes["residual"].plot(*_broken(gaps, c.time, c.residual), color="0.25", linewidth=0.6)
    axes["residual"].axhline(0.0, color="0.6", linewidth=0.6)
    axes["histogram"].hist(c.residual, 40, orientation="horizontal", color="0.55")
    axes["histogram"].sharey(axes["residual"])
    axes["histogram"].tick_params(labelleft=False)
    labels = {
        "velocity": ("Velocity [m/s]", "Force [N]"),
        "displacement": ("Displacement [mm]", "Force [N]"),
        "force": ("Time [s]", "Force [N]"),
        "residual": ("Time [s]", "Residual [N]"),
        "histogram": ("Samples", ""),
    }
    for name, (below, beside) in labels.items():
        axes[name].set_xlabel(below)
        axes[name].set_ylabel(beside)
        axes[name].grid(color="0.9", linewidth=0.6)
        axes[name].set_axisbelow(True)
    figure.suptitle(_title(comparison, title), fontsize="medium")
    handles, names = axes["velocity"].get_legend_handles_labels()
    figure.legend(handles, names, loc="lower center", ncols=2, markerscale=2.5)
    return figure


def _pair(axes: Any, x: Array, comparison: Comparison, gaps: NDArray[np.intp]) -> None:
    axes.plot(x, comparison.measured, label="measured", rasterized=True, **_MEASURED)
    axes.plot(*_broken(gaps, x, comparison.predicted), label="predicted", **_PREDICTED)


def _broken(gaps: NDArray[np.intp], *arrays: Array) -> tuple[Array, ...]:
    """The arrays with a NaN at each gap, which interrupts the line."""
    return tuple(np.insert(array, gaps, np.nan) for array in arrays)


def _title(comparison: Comparison, title: str) -> str:
    error = comparison.error
    lines = [Path(comparison.name).name, f"NRMSE {error.nrmse:.2%}, RMSE {error.rmse:.3g} N"]
    if title:
        lines.insert(1, title)
    lines += textwrap.wrap(comparison.provenance, 92)  # characters per line
    return "\n".join(lines)


_MARGINS = PredictorSettings()


@dataclass(frozen=True, eq=False)
class ValidatedRun(ComparedRun):
    """Error of the set on one run.

    ``remark``: a sentence if the run lies outside the range of the set, otherwise empty.
    """

    comparison: Comparison
    remark: str


@dataclass(frozen=True, eq=False)
class Validation(ComparedRuns):
    """Result of :func:`validate`: the set and its error on each run, in the given order.

    ``remarks`` describe possible problems of the runs.
    """

    parameter_set: ParameterSet
    runs: tuple[ValidatedRun, ...]
    remarks: tuple[str, ...] = ()

    def document(self) -> dict[str, Any]:
        """The result as JSON-compatible values."""
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
    mass: float = 0.0,
) -> Validation:
    """Compare the predicted force of a parameter set with the measured force of runs.

    Parameters
    ----------
    parameters
        A parameter set of any model, or the path of its file.
    *runs, displacement, force, current, period, accept_doubtful, mass
        As in :func:`identify`.

    Raises
    ------
    ValueError
        If the set or a run cannot be used; the message says what to change.

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
        (displacement, force, current, period),
        accept_doubtful=accept_doubtful,
    )
    measured = without_inertia(measured, mass)
    return Validation(
        parameters,
        tuple(ValidatedRun(compare(parameters, run), _remark(parameters, run)) for run in measured),
        remarks_on(measured),
    )


def _remark(found: ParameterSet, run: MeasuredRun) -> str:
    """A sentence if a run lies outside the identified range plus the margins of the predictor."""
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
