"""Profiles of a fit, and the fit once more from where a profile finds a lower minimum."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence

from mr_damper_ros.estimation.differential_evolution import (
    EvolutionSettings,
    GlobalProgress,
    Report,
)
from mr_damper_ros.estimation.global_fit import GlobalFit, identify_global
from mr_damper_ros.estimation.local_search import StopRequestedError
from mr_damper_ros.estimation.observability import parameter_ranges
from mr_damper_ros.estimation.profile_likelihood import Profile, ProfileLikelihood
from mr_damper_ros.estimation.record_levels import Level, LevelledProblem
from mr_damper_ros.estimation.separate_fits import levelled, thinned_for_search
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.operating_points import PooledProblem
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.process_pool import ProcessPool, Tell

_MOST_RESTARTS = 3
"""So often a fit starts again from what a profile has found."""

_POLL = 0.2
"""Seconds between two looks at whether a profile is to be given up."""

_Ranges = Mapping[str, tuple[float, float]]


def search_misfit(fit: GlobalFit, windows: Sequence[Window]) -> PooledProblem:
    """The misfit that the set was searched with."""
    found = fit.parameter_set
    few = thinned_for_search(windows)
    pooled = found.law.pooled_problem(few, fit.noise.tolist(), found.values)
    return levelled(pooled, fit.levels)


def record_levels(fit: GlobalFit, windows: Sequence[Window]) -> list[Level]:
    """The level of each record, by rising number; none where the records have none."""
    misfit = search_misfit(fit, windows)
    if not isinstance(misfit, LevelledProblem):
        return []
    return misfit.levels(fit.parameter_set.values, fit.covariance)


def profiles_of(
    fit: GlobalFit,
    windows: Sequence[Window],
    names: Sequence[str],
    processes: ProcessPool,
    report: Report | None = None,
) -> list[Profile]:
    """Profile likelihoods of the named parameters; those not begun when stopped are left out.

    Raises ValueError for a name that the law does not have.
    """
    law = fit.parameter_set.law.parameter_names
    for name in names:
        if name not in law:
            raise ValueError(f"there is no parameter '{name}' to profile: use {', '.join(law)}")
    misfit = search_misfit(fit, windows)
    ranges = parameter_ranges(fit.parameter_set.law, windows)
    listen = None if report is None else lambda _, news: report(news)
    tasks = [(fit.parameter_set, misfit, ranges, name) for name in names]
    return [profile for profile in processes.map(_profile, tasks, listen) if profile]


def profiled(
    fit: GlobalFit,
    windows: Sequence[Window],
    names: Sequence[str],
    settings: EvolutionSettings,
    processes: ProcessPool,
    report: Report | None = None,
) -> tuple[GlobalFit, list[Profile]]:
    """The profiles of the named parameters, and the fit that they are of.

    That is another one where the value found lies outside of its own interval: the fit then starts
    again from the lower minimum that the profile has found. Raises ValueError for a name that the
    law does not have.
    """
    for restarts in range(_MOST_RESTARTS + 1):
        found = profiles_of(fit, windows, names, processes, report)
        values, misfit = fit.parameter_set.as_dict(), search_misfit(fit, windows)
        lower = [each.lowest for each in found if not each.contains(values[each.name])]
        if not lower or restarts == _MOST_RESTARTS:
            break
        start = min(lower, key=misfit.mean_square)
        again = identify_global(
            fit.parameter_set.law,
            windows,
            start,
            settings,
            report,
            known=start,
            levels=fit.levels,
        )
        before, after = (misfit.mean_square(each.parameter_set.values) for each in (fit, again))
        if not after < before:
            break
        fit = again
    return fit, found


def _profile(task: tuple[ParameterSet, PooledProblem, _Ranges, str], tell: Tell) -> Profile | None:
    found, misfit, ranges, name = task
    told = time.monotonic()
    stopped = False

    def should_stop() -> bool:
        nonlocal told, stopped
        if time.monotonic() - told > _POLL:
            told = time.monotonic()
            stopped = not tell(GlobalProgress(f"profile of {name}", 0, 1, math.nan, math.nan))
        return stopped

    try:
        return ProfileLikelihood(
            found.law, misfit, found.values, found.observable, ranges, should_stop
        ).of(name)
    except StopRequestedError:
        return None
