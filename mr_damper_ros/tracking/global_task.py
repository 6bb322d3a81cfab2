"""The work of a global task: one identification over the windows of the reservoir."""

from __future__ import annotations

from collections.abc import Callable

from mr_damper_ros.estimation.global_fit import GlobalProgress, identify_global
from mr_damper_ros.estimation.set_error import error_of_set
from mr_damper_ros.models.sigmoid.sigmoid_model import is_sigmoid
from mr_damper_ros.tracking.acceptance import Judgement, Verdict, fault_of_data
from mr_damper_ros.tracking.tasks import GlobalResult, GlobalTask


def run_global(
    task: GlobalTask, report: Callable[[GlobalProgress], bool] | None = None
) -> GlobalResult:
    """Global identification of a task's windows; ``report`` returning False stops it early."""
    start = task.start
    if not is_sigmoid(start.law):
        return GlobalResult(
            Judgement(
                Verdict.FAILED,
                f"model '{start.model}' does not tell how the force depends on the current: "
                "it has no global identification, every window is fitted on its own",
            )
        )
    try:
        fit = identify_global(task.windows, start.values, task.settings, report)
    except ValueError as error:
        return GlobalResult(fault_of_data(str(error)))
    before, after = (
        error_of_set(found, task.windows).nrmse for found in (start, fit.parameter_set)
    )
    return GlobalResult(None, fit, before, after)
