"""The work of a global task: one identification over the windows of the reservoir.

Of every window a quarter of the samples, all over it, is held back from the identification and
judges the set.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from mr_damper_ros.estimation.covariance import NoiseModel
from mr_damper_ros.estimation.differential_evolution import GlobalProgress
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.estimation.set_error import error_of_set
from mr_damper_ros.kinematics.motion import DataError
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.tracking.acceptance import failed, fault_of_data
from mr_damper_ros.tracking.held_back import Lead, held_back_samples
from mr_damper_ros.tracking.tasks import GlobalResult, GlobalTask


def run_global(
    task: GlobalTask, report: Callable[[GlobalProgress], bool] | None = None
) -> GlobalResult:
    """Global identification of a task's windows; ``report`` returning False stops it early."""
    start = task.start
    held_back = [held_back_samples(window.sample_count) for window in task.windows]
    pairs = list(zip(task.windows, held_back, strict=True))
    try:
        fit = identify_global(
            start.law,
            [window.part(~judges) for window, judges in pairs],
            start.values,
            task.settings,
            report,
        )
    except DataError as error:
        return GlobalResult(fault_of_data(str(error)))
    except (ValueError, ArithmeticError) as error:
        return GlobalResult(failed(error))
    # Of a few samples none is held back.
    judged = [window.part(judges) for window, judges in pairs if judges.any()]
    before, after = (error_of_set(found, judged).nrmse for found in (start, fit.parameter_set))
    last = judged[-max(task.recent, 1) :]
    recent = tuple(error_of_set(each, last).nrmse for each in (start, fit.parameter_set))
    lead = _lead(start, fit.parameter_set, task.windows, held_back)
    return GlobalResult(None, fit, before, after, lead, (recent[0], recent[1]))


def _lead(
    before: ParameterSet,
    after: ParameterSet,
    windows: Sequence[Window],
    held_back: Sequence[np.ndarray],
) -> float:
    """How far one set is ahead of another on the held-back samples of windows."""
    leads = []
    for window, judges in zip(windows, held_back, strict=True):
        old, new = before.force(window), after.force(window)
        if not np.isfinite(old).all():
            return math.inf
        noise = NoiseModel.of(new - window.force)
        leads.append(Lead.of(old, new, window.force, judges, noise))
    return Lead.together(leads)
