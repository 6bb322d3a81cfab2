"""The work of a global task: one identification over the windows of the reservoir."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mr_damper_ros.estimation.global_fit import GlobalProgress, identify_global
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.sigmoid.scale_misfit import Window
from mr_damper_ros.models.sigmoid.sigmoid_model import is_sigmoid
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.tasks import GlobalResult, GlobalTask


def run_global(
    task: GlobalTask, report: Callable[[GlobalProgress], bool] | None = None
) -> GlobalResult:
    """Global identification of a task's windows; ``report`` returning False stops it early."""
    if not is_sigmoid(MODELS[task.model]):
        return GlobalResult(
            task,
            f"model '{task.model}' does not tell how the force depends on the current: "
            "it has no global identification, every window is fitted on its own",
        )
    try:
        fit = identify_global(task.windows, task.start, task.settings, report)
    except ValueError as error:
        return GlobalResult(task, str(error))
    before = [_nrmse(window, task.start) for window in task.windows]
    return GlobalResult(task, "", fit, float(np.median(before)))


def _nrmse(window: Window, parameters: Array) -> float:
    residual = window.predicted_force(parameters) - window.force
    return float(np.sqrt(np.mean(residual**2)) / np.std(window.force))
