"""Choice of the force law by cross-validation over motions.

Runs of about the same peak velocity, at all currents, are one motion and are left out together.
With fewer than three motions, single runs are left out. With fewer than five runs, segments of all
runs are left out, because the remaining runs would be too few to determine the current dependence.
A law is acceptable if its error exceeds the lowest error by at most one standard error of the
difference, or by a negligible amount. The acceptable law with the fewest parameters is chosen
(one-standard-error rule: Breiman et al., Classification and Regression Trees, 1984, section 3.4.3).
The rule uses differences between laws, because some motions are difficult for every law.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.estimation.covariance import ENOUGH_TO_COMPARE, SAME_MOTION
from mr_damper_ros.estimation.differential_evolution import (
    EvolutionSettings,
    GlobalProgress,
    ProgressClock,
    Report,
)
from mr_damper_ros.estimation.global_fit import AS_GOOD, GLOBAL_METHOD, GlobalSearch
from mr_damper_ros.estimation.local_search import StopRequestedError
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import known_model
from mr_damper_ros.models.quantities import GOOD_NRMSE
from mr_damper_ros.processes.process_pool import Notify, ProcessPool
from mr_damper_ros.signals.arrays import Array

MOST_FOLDS = 5

_SHORTEST_SEGMENT = 200
"""Smallest number of samples in a segment of a run."""


@dataclass(frozen=True, eq=False)
class Fold:
    """Training windows, and the validation samples as slices of windows.

    Training window k is the window ``owners[k]`` or a part of it.
    """

    training: tuple[Window, ...]
    owners: tuple[int, ...]
    judged: tuple[tuple[Window, slice], ...]


@dataclass(frozen=True, eq=False)
class LawTrial:
    """A law and its validation NRMSE for each fold, shape (k,); infinite: no fit."""

    model: str
    errors: Array

    @property
    def nrmse(self) -> float:
        """Mean NRMSE over the folds [1]."""
        return float(np.mean(self.errors))

    @property
    def parameter_count(self) -> int:
        """Number of parameters of the law, the measure of its complexity."""
        return len(MODELS[self.model].parameters)

    def behind(self, other: LawTrial) -> tuple[float, float]:
        """Mean difference of the error [1] from another law's error, and its standard error."""
        if not math.isfinite(self.nrmse):
            return math.inf, 0.0
        difference = self.errors - other.errors
        error = float(np.std(difference, ddof=1)) / math.sqrt(len(difference))
        return float(np.mean(difference)), error


@dataclass(frozen=True, eq=False)
class LawChoice:
    """The laws compared, best first.

    ``left_out``: the unit of cross-validation in one word; ``sinusoids``: whether all motions are
    sinusoids; ``untried``: names of the laws that were not compared, because the comparison was
    stopped.
    """

    trials: tuple[LawTrial, ...]
    left_out: str
    sinusoids: bool = False
    untried: tuple[str, ...] = ()

    @property
    def best(self) -> LawTrial:
        """The law with the lowest validation error of those compared."""
        return self.trials[0]

    @property
    def chosen(self) -> LawTrial | None:
        """The simplest law that is as good as the best one, by the one-standard-error rule.

        None if a law was not compared.
        """
        if self.untried:
            return None
        negligible = (math.sqrt(AS_GOOD) - 1.0) * self.best.nrmse
        compared = [(trial, *trial.behind(self.best)) for trial in self.trials]
        good = [trial for trial, behind, error in compared if behind <= max(error, negligible)]
        return min(good, key=lambda trial: (trial.parameter_count, trial.nrmse))

    def __str__(self) -> str:
        count = len(self.best.errors)
        lines = [
            f"NRMSE on {self.left_out} that were left out ({count} folds, each predicted from the "
            "others):",
            f"{'law':<22} {'parameters':>10} {'NRMSE':>8} {'above the best':>20}",
        ]
        for trial in self.trials:
            name = f"{trial.model:<22} {trial.parameter_count:>10}"
            if not math.isfinite(trial.nrmse):
                lines.append(f"{name} {'no fit':>8}")
                continue
            behind, error = trial.behind(self.best)
            told = "" if trial is self.best else f"{behind:+.2%} ± {error:.2%}"
            lines.append(f"{name} {trial.nrmse:>8.2%} {told:>20}".rstrip())
        lines += [f"{name:<22} {'not compared':>19}" for name in self.untried]
        chosen = self.chosen
        if chosen is None:
            lines.append(
                "NO LAW IS CHOSEN: the comparison was stopped before it had covered all laws."
            )
        elif self.best.nrmse > GOOD_NRMSE:
            lines.append(
                f"NO LAW PREDICTS THE DATA LEFT OUT: {chosen.model} is used, but the choice "
                "is uncertain; add runs at more amplitudes, frequencies and currents."
            )
        elif chosen is self.best:
            lines.append(f"The data support {self.best.model}.")
        else:
            lines.append(
                f"The data support {chosen.model}: the advantage of {self.best.model}, which "
                "has more parameters, is within one standard error, or negligible."
            )
        if self.sinusoids:
            lines.append(
                "All motions are sinusoids, which do not show how well a law predicts other "
                "motions: if the damper will be used in other motions, add such a run."
            )
        return "\n".join(lines)


def cross_validate(
    runs: Sequence[Sequence[Window]],
    models: Sequence[str] = tuple(MODELS),
    settings: EvolutionSettings | None = None,
    report: Report | None = None,
    processes: ProcessPool | None = None,
) -> LawChoice:
    """Compare force laws by cross-validation over the runs, each a sequence of windows.

    ``models`` are names of laws; ``settings`` apply to the global identification. ``report``
    receives the progress and may stop the comparison, which then covers the finished laws and
    chooses none. The result does not depend on the number of ``processes``.

    Raises ValueError if there are too few data for cross-validation, for an unknown law, and if the
    comparison was stopped before any law was finished.
    """
    left_out, parts = folds(runs)
    windows = tuple(window for run in runs for window in run)
    asked = settings or EvolutionSettings()
    tasks = [(known_model(name).name, windows, parts, asked) for name in models]
    done: dict[int, float] = {}

    def follow(place: int, part: float) -> bool:
        assert report is not None
        done[place] = part
        stage = f"comparing laws, {models[place]}, {sum(done.values()) / len(tasks):.0%} done"
        return report(GlobalProgress(stage, 0, 0, math.inf, math.inf))

    pool = processes or ProcessPool()
    found = pool.map(_left_out_errors, tasks, follow if report else None)
    trials = [
        LawTrial(name, errors)
        for name, errors in zip(models, found, strict=True)
        if errors is not None and not np.any(np.isnan(errors))
    ]
    if not any(math.isfinite(trial.nrmse) for trial in trials):
        raise ValueError(
            "no law was compared: the comparison was stopped before the first was finished, or "
            "none can be fitted to these runs"
        )
    sinusoids = all(not math.isnan(window.motion.frequency) for run in runs for window in run)
    best_first = sorted(trials, key=lambda trial: trial.nrmse)
    compared = {trial.model for trial in trials}
    untried = tuple(name for name in models if name not in compared)
    return LawChoice(tuple(best_first), left_out, sinusoids, untried)


def folds(runs: Sequence[Sequence[Window]]) -> tuple[str, list[Fold]]:
    """The unit of cross-validation ("motions", "runs" or "segments") and the three to five folds.

    Raises ValueError if the runs are too few and too short.
    """
    windows = [window for run in runs for window in run]
    # Runs of about the same peak velocity, in order of increasing peak velocity.
    groups: list[list[Sequence[Window]]] = []
    for run in sorted(runs, key=_speed):
        if not groups or _speed(run) > (1.0 + SAME_MOTION) * _speed(groups[-1][0]):
            groups.append([])
        groups[-1].append(run)
    unit = "motions"
    if len(groups) < ENOUGH_TO_COMPARE:
        if len(runs) < MOST_FOLDS:
            return "segments", _folds_of_segments(windows)
        unit, groups = "runs", [[run] for run in runs]
    count = min(len(groups), MOST_FOLDS)
    result = []
    for place in range(count):
        left_out = [window for group in groups[place::count] for run in group for window in run]
        owners = tuple(k for k, w in enumerate(windows) if all(w is not out for out in left_out))
        judged = tuple((window, slice(None)) for window in left_out)
        result.append(Fold(tuple(windows[owner] for owner in owners), owners, judged))
    return unit, result


def _speed(run: Sequence[Window]) -> float:
    return max(window.operating_point[0] for window in run)


def _folds_of_segments(windows: Sequence[Window]) -> list[Fold]:
    """Folds that each leave out one segment of every window."""
    shortest = min(window.sample_count for window in windows)
    count = min(MOST_FOLDS, shortest // _SHORTEST_SEGMENT)
    if count < ENOUGH_TO_COMPARE:
        least = ENOUGH_TO_COMPARE * _SHORTEST_SEGMENT
        raise ValueError(
            f"a comparison of laws needs {MOST_FOLDS} runs, or at least {least} samples without a "
            f"gap in every run, but one has {shortest}: give more or longer runs, or name the law"
        )
    result = []
    for place in range(count):
        training: list[Window] = []
        owners, judged = [], []
        for owner, window in enumerate(windows):
            edges = np.linspace(0, window.sample_count, count + 1).astype(int).tolist()
            begin, end = edges[place], edges[place + 1]
            sides = [slice(0, begin), slice(end, window.sample_count)]
            parts = [window.part(side) for side in sides if side.stop > side.start]
            training += parts
            owners += [owner] * len(parts)
            judged.append((window, slice(begin, end)))
        result.append(Fold(tuple(training), tuple(owners), tuple(judged)))
    return result


_Task = tuple[str, Sequence[Window], Sequence[Fold], EvolutionSettings]
"""Name of a law, all windows, the folds, and the settings of the search."""


def _left_out_errors(task: _Task, notify: Notify) -> Array:
    """Validation NRMSE [1] of each fold; infinite if there is no fit, NaN after a stop.

    One search over all windows gives the start of each fold. The global minima of the folds are
    close to it, so a fold only needs the local search. On twenty records of a real damper, the
    errors of eight laws are within 1 % of those of complete searches.
    """
    name, windows, parts, settings = task
    law, done = MODELS[name], 0

    def report(progress: GlobalProgress) -> bool:
        part = progress.generation / max(progress.generations, 1)
        return notify((done + part) / (1 + len(parts)))

    def search_of(windows: Sequence[Window]) -> GlobalSearch:
        start = law.initial_values()[0]
        return GlobalSearch(law, windows, start, settings, ProgressClock(1, report))

    errors = []
    try:
        whole = search_of(windows)
        whole.search(GLOBAL_METHOD)
        for fold in parts:
            done += 1
            search = search_of(fold.training)
            search.refit(whole, fold.owners)
            errors.append(_error_left_out(search, fold))
    except StopRequestedError:
        return np.full(len(parts), math.nan)
    except ValueError:
        return np.full(len(parts), math.inf)
    return np.array(errors)


def _error_left_out(search: GlobalSearch, fold: Fold) -> float:
    errors = np.where(search.free, 0.0, math.nan)
    found = search.parameter_set(errors, errors, GLOBAL_METHOD)
    squares = []
    for window, places in fold.judged:
        residual = (found.window_force(window) - window.force)[places]
        settled = found.settled(window)[places]
        # The first segment of a run may depend on the unknown past as a whole.
        counted = residual[settled] if settled.any() else residual
        squares.append(float(np.mean(counted**2) / np.var(window.force)))
    error = math.sqrt(float(np.mean(squares)))
    return error if math.isfinite(error) else math.inf
