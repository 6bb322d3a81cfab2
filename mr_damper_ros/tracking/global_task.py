"""The work of a global task: one identification over the windows of the reservoir."""

from __future__ import annotations

from collections.abc import Callable

from mr_damper_ros.estimation.differential_evolution import GlobalProgress
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.estimation.set_error import error_of_set
from mr_damper_ros.tracking.acceptance import fault_of_data
from mr_damper_ros.tracking.tasks import GlobalResult, GlobalTask


def run_global(
    task: GlobalTask, report: Callable[[GlobalProgress], bool] | None = None
) -> GlobalResult:
    """Global identification of a task's windows; ``report`` returning False stops it early."""
    start = task.start
    try:
        fit = identify_global(start.law, task.windows, start.values, task.settings, report)
    except ValueError as error:
        return GlobalResult(fault_of_data(str(error)))
    before, after = (
        error_of_set(found, task.windows).nrmse for found in (start, fit.parameter_set)
    )
    newest = task.windows[-1:]
    running, found = (error_of_set(each, newest).nrmse for each in (start, fit.parameter_set))
    return GlobalResult(None, fit, before, after, (running, found))
