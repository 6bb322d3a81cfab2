"""The outcome of an identification: parameters with errors, statistics, tables, figures."""

from __future__ import annotations

import html
import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from mr_damper_ros.estimation.differential_evolution import Report
from mr_damper_ros.estimation.experiment_design import RigRange
from mr_damper_ros.estimation.multi_start import MultiStart
from mr_damper_ros.estimation.profiled_fit import profiles_of
from mr_damper_ros.estimation.record_levels import Level
from mr_damper_ros.interface import findings
from mr_damper_ros.interface.comparison import Comparison, error_entry, error_over
from mr_damper_ros.interface.estimates import (
    Estimate,
    as_json,
    html_estimates,
    html_table,
    parameter_estimates,
    text_table,
)
from mr_damper_ros.interface.findings import Findings
from mr_damper_ros.interface.measured_runs import MeasuredRun, all_windows
from mr_damper_ros.interface.temperature_map import temperature_maps
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.processes.process_pool import ProcessPool
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.error_sums import ErrorSums

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_LEFT = 0.3
"""A set that leaves more than this part of the force's standard deviation explains too little."""


_GIVEN_THE_REST = (
    "parameters (those with an error hold only together with the others, which one run cannot "
    "tell and which are those of the start):"
)


@dataclass(frozen=True, eq=False)
class FittedRun:
    """What the identified set makes of one run.

    ``operating_point``: peak velocity [m/s] and current [A] that stand for the run;
    ``coefficients``: those of the law there, by name; ``level``: force scale and zero of the run's
    own, None where none were asked for. The ``error`` is that of the set without them.
    """

    measured: MeasuredRun
    comparison: Comparison
    operating_point: tuple[float, float]
    coefficients: dict[str, Estimate]
    level: Level | None = None

    @property
    def name(self) -> str:
        """Name of the run: the path of its bag, or that of the recording."""
        return self.measured.name

    @property
    def error(self) -> ErrorSums:
        """RMSE, NRMSE and R² of the set on this run."""
        return self.comparison.error


@dataclass(frozen=True, eq=False)
class Identification:
    """Outcome of :func:`identify`.

    ``parameter_set`` is what was found, ``runs`` how it fits each run, in the order given;
    ``searches`` holds every search that was made; ``duration`` [s] is what they took; ``remarks``
    say what seems wrong with the runs. ``profiles`` are those that were asked for.
    """

    parameter_set: ParameterSet
    runs: tuple[FittedRun, ...]
    searches: MultiStart
    method: str
    duration: float
    remarks: tuple[str, ...] = ()
    profiles: Findings = field(default_factory=lambda: Findings([], {}))

    @property
    def parameters(self) -> dict[str, Estimate]:
        """Value, standard error, unit and whether the data determined it, by name."""
        return parameter_estimates(self.parameter_set)

    @property
    def coefficients(self) -> dict[str, Estimate]:
        """The operating-point coefficients of the first run, by name.

        Those of the others are in ``runs[k].coefficients``.
        """
        return self.runs[0].coefficients

    @property
    def covariance(self) -> Array:
        """Covariance (p, p) of the parameters, zero where one was held."""
        return self.searches.best.covariance

    @property
    def error(self) -> ErrorSums:
        """RMSE, NRMSE and R² of the set on the samples of all runs together."""
        return error_over(run.comparison for run in self.runs)

    @property
    def rmse(self) -> float:
        """Root mean square error of the force over all runs [N]."""
        return self.error.rmse

    @property
    def nrmse(self) -> float:
        """RMSE over the standard deviation of the force [1], all runs together."""
        return self.error.nrmse

    @property
    def evaluations(self) -> int:
        """Evaluations of the force law, or of its cheaper stand-ins, by the best search."""
        return self.searches.best.evaluations

    @property
    def explains(self) -> bool:
        """Whether the set leaves no more than 30 % of the force's standard deviation, in each run.

        With the level of each run, where the runs have any.
        """
        return not self._unexplained

    @property
    def _unexplained(self) -> list[tuple[float, str]]:
        """NRMSE and name of the runs of which the set leaves too much, the worst first."""
        left = [((run.level or run.error).nrmse, run.name) for run in self.runs]
        return sorted((entry for entry in left if entry[0] > MOST_LEFT), reverse=True)

    @property
    def success(self) -> bool:
        """Whether the search came to its end and the set explains the force."""
        return self.searches.best.success and self.explains

    @property
    def message(self) -> str:
        """How it ended, in words."""
        ended = self.searches.best.message
        if self.explains:
            return ended
        (worst, name), *others = self._unexplained
        where = f"{name} and {len(others)} more" if others else name
        return (
            f"{ended}, but THE SET EXPLAINS TOO LITTLE OF THE FORCE of {where}: NRMSE {worst:.1%}, "
            f"where {MOST_LEFT:.0%} is the most; are columns, units, signs and currents right, and "
            "are all runs of one damper?"
        )

    @one_thread()
    def determination(
        self, *, top_velocity: float | None = None, top_current: float | None = None
    ) -> Findings:
        """What the runs determine, and which further runs would determine the rest.

        ``top_velocity`` [m/s] and ``top_current`` [A]: the most that a run may ask of the rig;
        without them no more than was done already.
        """
        windows = all_windows([run.measured for run in self.runs])
        done = RigRange.of_windows(windows)
        rig = RigRange(
            amplitude=done.amplitude,
            peak_velocity=done.peak_velocity if top_velocity is None else top_velocity,
            current=done.current if top_current is None else top_current,
        )
        return findings.determined(self.searches.best, windows, rig)

    @one_thread()
    def profile(self, *names: str, workers: int = 1, report: Report | None = None) -> Findings:
        """Profile likelihood of the named parameters, with 95 % intervals.

        An interval may lie off the value found: then there is a lower minimum, from which
        ``identify(..., profile=names)`` searches again. Raises ValueError for a name that the model
        does not have.
        """
        windows, fit = all_windows([run.measured for run in self.runs]), self.searches.best
        with ProcessPool(workers) as processes:
            found = profiles_of(fit, windows, names, processes, report)
        return findings.profiles(fit, found)

    @one_thread()
    def temperature_maps(self) -> Findings:
        """How the force falls with temperature, from runs in which it was measured."""
        measured = [run.measured for run in self.runs]
        if all(celsius is None for run in measured for celsius in run.temperatures):
            return Findings([], {})
        found = temperature_maps(measured, self.parameter_set)
        return findings.temperatures(found.identified)

    def plot(self, run: int = 0) -> Figure:
        """Figure of one run: both loops, the force and the residual over time, its histogram."""
        from mr_damper_ros.interface.figures import comparison_figure

        return comparison_figure(self.runs[run].comparison)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the parameter set as YAML, for ``ParameterSet.load``, ``validate`` and the nodes.

        Raises OSError where the file cannot be written.
        """
        self.parameter_set.save(path)

    def document(self) -> dict[str, Any]:
        """The result as JSON can hold it."""
        return {
            "model": self.parameter_set.model,
            "parameters": self.parameter_set.as_dict(),
            "standard_errors": {n: as_json(e.standard_error) for n, e in self.parameters.items()},
            "discrepancies": {n: as_json(e.discrepancy) for n, e in self.parameters.items()},
            "observable": {n: e.observable for n, e in self.parameters.items()},
            "metrics": error_entry(self.error),
            "evaluations": self.evaluations,
            "duration_s": self.duration,
            "method": self.method,
            "success": self.success,
            "message": self.message,
            "remarks": list(self.remarks),
            "bags": [_entry(run) for run in self.runs],
        }

    def __str__(self) -> str:
        parts = []
        if len(self.runs) == 1 and self.coefficients:
            parts += [self._at_point, text_table("coefficient", self.coefficients), ""]
            if not all(entry.observable for entry in self.parameters.values()):
                parts.append(_GIVEN_THE_REST)
        parts += [text_table("parameter", self.parameters), ""]
        parts += [_line(run) for run in self.runs]
        parts.append(
            f"{self.method}: {self.evaluations} evaluations in {self.duration:.2f} s, "
            f"{self.message}"
        )
        parts += [f"WARNING: {remark}" for remark in self.remarks]
        return "\n".join(parts)

    def _repr_html_(self) -> str:
        parts = []
        if len(self.runs) == 1 and self.coefficients:
            parts += [f"<p>{self._at_point}</p>", html_estimates("coefficient", self.coefficients)]
        parts.append(html_estimates("parameter", self.parameters))
        rows = [(run.name, f"{run.error.rmse:.4g}", f"{run.error.nrmse:.2%}") for run in self.runs]
        parts += [html_table(("run", "RMSE [N]", "NRMSE"), rows), f"<p>{self.message}</p>"]
        parts += [f"<p>WARNING: {html.escape(remark)}</p>" for remark in self.remarks]
        return "".join(parts)

    @property
    def _at_point(self) -> str:
        speed, current = self.runs[0].operating_point
        return f"the loop at a peak velocity of {speed:.4g} m/s and {current:.4g} A:"


def _entry(run: FittedRun) -> dict[str, Any]:
    speed, current = run.operating_point
    return {
        "bag": run.name,
        "metrics": error_entry(run.error),
        "operating_point": {"peak_velocity": speed, "current": current},
        "coefficients": {name: entry.value for name, entry in run.coefficients.items()},
        "coefficient_standard_errors": {
            name: as_json(entry.standard_error) for name, entry in run.coefficients.items()
        },
        "coefficient_discrepancies": {
            name: as_json(entry.discrepancy) for name, entry in run.coefficients.items()
        },
        **({} if run.level is None else {"level": run.level._asdict()}),
    }


def _line(run: FittedRun) -> str:
    error, level = run.error, run.level
    line = f"{run.name}: RMSE {error.rmse:.4g} N, NRMSE {error.nrmse:.2%} ({error.count} samples)"
    if level is None:
        return line
    return (
        f"{line}; at its level {level.nrmse:.2%}: force scale {level.scale:.4f} ± "
        f"{level.scale_error:.4f}, zero {level.zero:.1f} ± {level.zero_error:.1f} N"
    )
