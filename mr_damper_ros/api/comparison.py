"""Comparison of measured and predicted force: errors, figures and validation of a set."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from mr_damper_ros.api.measured_runs import (
    MeasuredRun,
    RunSource,
    findings_on,
    measured_runs,
    without_inertia,
)
from mr_damper_ros.data_check.findings import NOTE, Finding, labelled
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.report.document import Cell, Grid, Shown, figure_of, save_figure, styled
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.signals.error_sums import ErrorSums, pooled
from mr_damper_ros.tracking.predictor import PredictorSettings
from mr_damper_ros.tracking.state_directory import SetSource, given_set
from mr_damper_ros.tracking.validity import current_allowance

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Comparison:
    """Measured and predicted force of one run.

    Arrays of shape (n,): ``time`` [s] since the first sample, ``displacement`` [m] from the centre
    of the motion, ``velocity`` [m/s], ``measured`` and ``predicted`` force [N]. The predicted force
    is NaN where it depends on the unknown time before the run. ``name`` and ``provenance`` are
    copied from the run.
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
        """Predicted minus measured force [N], shape (n,); NaN without a predicted force."""
        return self.predicted - self.measured

    @cached_property
    def error(self) -> ErrorSums:
        """RMSE, NRMSE and R² of the prediction, over the samples with a predicted force."""
        known = ~np.isnan(self.residual)
        return ErrorSums.of(self.predicted[known], self.measured[known])


def compare(found: ParameterSet, run: MeasuredRun) -> Comparison:
    """Compare the force of a parameter set with the measured force of a run.

    As in a prediction, the peak velocity is limited to the range of the set, and the force of a law
    with memory is unknown until its state no longer depends on the past.
    """
    first, columns = run.recordings[0], list[tuple[Array, ...]]()
    for recording, window in zip(run.recordings, run.windows, strict=True):
        start = (recording.start_ns - first.start_ns) / NANOSECONDS
        motion = window.motion
        gradual = found.turns_gradually(window)
        force = found.window_force(window, gradual=gradual)
        force = np.where(found.settled(window, gradual=gradual), force, np.nan)
        columns.append(
            (window.time + start, motion.displacement, motion.velocity, window.force, force)
        )
    # A single window is not copied.
    joined: Iterable[Array] = (
        columns[0] if len(columns) == 1 else map(np.concatenate, zip(*columns, strict=True))
    )
    time, u, v, measured, predicted = joined
    origin = first.details.get("provenance", "")
    return Comparison(run.name, time, u, v, measured, predicted, origin)


@dataclass(frozen=True, eq=False)
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

    @property
    def row(self) -> tuple[Cell, ...]:
        """Table row of the run, with the columns of :data:`RUN_COLUMNS`."""
        error = self.error
        return self.name, error.rmse, f"{error.nrmse:.2%}", f"{error.r2:.4f}", error.count

    def document(self) -> dict[str, Any]:
        """Name and error as JSON-compatible values."""
        return {"bag": self.name, "metrics": error_entry(self.error)}


RUN_COLUMNS: tuple[str, ...] = ("run", "RMSE [N]", "NRMSE", "R2", "samples")


class ComparedRuns(Shown):
    """Base class of results with ``runs`` and ``findings``: overall error and figures."""

    runs: tuple[ComparedRun, ...]
    findings: tuple[Finding, ...]
    accepted: bool

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """The findings that make the result doubtful; none if they were accepted beforehand."""
        return () if self.accepted else tuple(f for f in self.findings if f.severity > NOTE)

    @property
    def error(self) -> ErrorSums:
        """RMSE, NRMSE and R² of the set over all samples with a predicted force."""
        return pooled(run.error for run in self.runs)

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
    return {"rmse": error.rmse, "nrmse": error.nrmse, "r2": error.r2, "n_samples": error.count}


FORMATS = ("png", "svg", "pdf")


def _heading(comparison: Comparison, title: str) -> str:
    error = comparison.error
    lines = [Path(comparison.name).name, *([title] if title else [])]
    lines.append(f"NRMSE {error.nrmse:.2%}, RMSE {error.rmse:.3g} N")
    lines += textwrap.wrap(comparison.provenance, 92)  # characters per line
    return "\n".join(lines)


def comparison_figure(comparison: Comparison, title: str = "") -> Figure:
    """Figure of a comparison: both loops, force and residual over time, residual histogram.

    ``title`` is an additional line in the heading. The heading always contains name, NRMSE, RMSE
    and provenance of the run.
    """
    with styled():
        figure = figure_of(7.2, 7.6)
        # Space for the legend; the Matplotlib of Ubuntu 24.04 does not support loc="outside …".
        figure.get_layout_engine().set(rect=(0.0, 0.06, 1.0, 0.94))
        axes: dict[str, Any] = figure.subplot_mosaic(
            [
                ["velocity"] * 2 + ["displacement"] * 2,
                ["force"] * 4,
                ["residual"] * 3 + ["histogram"],
            ],
            height_ratios=[1.25, 1.0, 0.7],
        )
        c = comparison
        gaps = np.flatnonzero(np.diff(c.time) > 1.5 * float(np.median(np.diff(c.time)))) + 1
        # A NaN at each gap interrupts the line.
        time, residual = (np.insert(each, gaps, np.nan) for each in (c.time, c.residual))
        for name, label, x in (
            ("velocity", "Velocity [m/s]", c.velocity),
            ("displacement", "Displacement [mm]", 1e3 * c.displacement),
            ("force", "Time [s]", c.time),
        ):
            # Light dots and a dark line can be told apart in black and white.
            axes[name].plot(
                x, c.measured, ".", color="0.65", ms=3.0, label="measured", rasterized=True
            )
            broken = (np.insert(each, gaps, np.nan) for each in (x, c.predicted))
            axes[name].plot(*broken, color="#8f1023", linewidth=1.2, label="predicted")
            axes[name].set(xlabel=label, ylabel="Force [N]")
        axes["residual"].plot(time, residual, color="0.25", linewidth=0.6)
        axes["residual"].axhline(0.0, color="0.6", linewidth=0.6)
        axes["residual"].set(xlabel="Time [s]", ylabel="Residual [N]")
        known = c.residual[~np.isnan(c.residual)]
        axes["histogram"].hist(known, 40, orientation="horizontal", color="0.55")
        axes["histogram"].sharey(axes["residual"])
        axes["histogram"].tick_params(labelleft=False)
        axes["histogram"].set_xlabel("Samples")
        for axis in axes.values():
            axis.grid(color="0.9", linewidth=0.6)
            axis.set_axisbelow(True)
        figure.suptitle(_heading(c, title), fontsize="medium")
        handles, names = axes["velocity"].get_legend_handles_labels()
        figure.legend(handles, names, loc="lower center", ncols=2, markerscale=2.5)
        return figure


def save_figures(
    comparisons: Iterable[Comparison], folder: Path, formats: Sequence[str], title: str = ""
) -> list[Path]:
    """Save a figure of each comparison in all formats; returns the paths. Raises OSError.

    The heading of a figure is also the title in the metadata of its file.
    """
    stems: list[str] = []
    written = []
    for comparison in comparisons:
        figure = comparison_figure(comparison, title)
        # The name of a run may be a path, and two runs may have the same name.
        name = Path(comparison.name).name.removesuffix(".mcap")
        stem = re.sub(r"[^\w.+-]+", "_", name).strip("._") or "run"
        numbered = (f"{stem}_{number}" for number in count(2))
        stems.append(next(free for free in chain([stem], numbered) if free not in stems))
        for kind in formats:
            written.append(folder / f"{stems[-1]}.{kind}")
            save_figure(figure, written[-1], metadata={"Title": _heading(comparison, title)})
    return written


@dataclass(frozen=True, eq=False)
class ValidatedRun(ComparedRun):
    """Error of the set on one run.

    ``remark``: a sentence if the run lies outside the range of the set, otherwise empty.
    """

    remark: str


@dataclass(frozen=True, eq=False)
class Validation(ComparedRuns):
    """Result of :func:`validate`: the set and its error on each run, in the given order.

    ``findings`` say what is wrong with the runs, and ``accepted`` whether this was accepted
    beforehand.
    """

    parameter_set: ParameterSet
    runs: tuple[ValidatedRun, ...]
    findings: tuple[Finding, ...] = ()
    accepted: bool = False

    @property
    def success(self) -> bool:
        """Whether no finding warns, or all were accepted beforehand."""
        return not self.warnings

    def document(self) -> dict[str, Any]:
        """The result as JSON-compatible values."""
        return {
            "bags": [run.document() | {"remark": run.remark} for run in self.runs],
            "success": self.success,
            "findings": [finding.document() for finding in self.findings],
        }

    def _blocks(self) -> list[str | Grid]:
        columns, rows = RUN_COLUMNS, [run.row for run in self.runs]
        if any(run.remark for run in self.runs):
            columns += ("remark",)
            rows = [(*run.row, run.remark) for run in self.runs]
        return [(columns, rows), *map(labelled, self.findings)]


@one_thread()
def validate(
    parameters: SetSource,
    *runs: RunSource,
    displacement: ArrayLike | None = None,
    force: ArrayLike | None = None,
    current: ArrayLike | None = None,
    period: float | None = None,
    accept_doubtful: bool = False,
    as_measured: bool = False,
    mass: float = 0.0,
) -> Validation:
    """Compare the predicted force of a parameter set with the measured force of runs.

    Parameters
    ----------
    parameters
        A parameter set of any model, or the path of its file.
    *runs, displacement, force, current, period, accept_doubtful, as_measured, mass
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
    run     RMSE [N]   NRMSE      R2  samples
    arrays     202.1  21.53%  0.9536     2000
    """
    parameters = given_set(parameters)
    measured = measured_runs(
        runs,
        (displacement, force, current, period),
        accept_doubtful=accept_doubtful,
        as_measured=as_measured,
    )
    measured = without_inertia(measured, mass)
    return Validation(
        parameters,
        tuple(ValidatedRun(compare(parameters, run), _remark(parameters, run)) for run in measured),
        findings_on(measured),
        accept_doubtful,
    )


def _remark(found: ParameterSet, run: MeasuredRun) -> str:
    """A sentence if a run lies outside the identified range plus the margins of the predictor."""
    speeds, currents = zip(*(window.operating_point for window in run.windows), strict=True)
    settings, known = PredictorSettings(), (found.peak_velocity_range, found.current_range)
    (slow, fast), share = known[0], settings.velocity_margin
    more = current_allowance(known[1], settings.current_margin)
    remarks = [
        f"{name} {_span(values)} {unit}, but the set holds for {_span((low, high))} {unit}"
        for name, unit, values, (low, high), below, above in (
            ("peak velocity", "m/s", speeds, known[0], slow * share, fast * share),
            ("current", "A", currents, known[1], more, more),
        )
        if not low - below <= min(values) <= max(values) <= high + above
    ]
    return f"OUT OF RANGE: {'; '.join(remarks)}" if remarks else ""


def _span(values: tuple[float, ...]) -> str:
    low, high = f"{min(values):.3g}", f"{max(values):.3g}"
    return low if low == high else f"{low} to {high}"
