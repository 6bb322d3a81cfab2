"""The next run of a test machine, from the recordings of those that were made."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.force_knowledge import ForceGoal
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.estimation.planned_run import MachineLimits
from mr_damper_ros.estimation.run_planner import Plan, RunPlanner
from mr_damper_ros.interface.measured_runs import RunSource, all_windows, measured_runs
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL, ParameterSet, known_model
from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.signals.arrays import Array


@one_thread()
def advise_run(
    runs: Iterable[RunSource],
    goal: ForceGoal,
    limits: MachineLimits,
    model: str = DEFAULT_MODEL,
) -> Plan:
    """How well the force is known from the runs made so far, and which run comes next.

    Raises ValueError, in one sentence, where a run cannot be used.
    """
    windows = all_windows(measured_runs(runs))
    return planned(RunPlanner(known_model(model), goal, limits), windows)[1]


def planned(
    planner: RunPlanner,
    windows: list[Window],
    before: Array | None = None,
    evolution: EvolutionSettings | None = None,
) -> tuple[ParameterSet, Plan]:
    """The most probable set of windows, searched from the set (p,) of before, and the plan."""
    start = planner.model.initial_values()[0] if before is None else before
    fit = identify_global(
        planner.model, windows, start, evolution or EvolutionSettings(), known=before
    )
    found = fit.parameter_set
    values = planner.most_probable(windows, found.values)
    found = replace(found, values=values)
    return found, planner.next(windows, values, found.observable)
