"""For how long a wrong force is called valid, whatever goes wrong: dampers of other laws."""

from __future__ import annotations

import math
import zlib
from collections import defaultdict
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from multiprocessing import get_context

import numpy as np

from benchmarks.fault_scenarios import SCENARIOS, STREAMS, Scenario
from benchmarks.figure import Figure
from benchmarks.other_dampers import DAMPERS
from benchmarks.stream_trial import WRONG, StreamTrial, TrialResult, TrialSettings
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.parameter_set import ParameterSet

SETTINGS = TrialSettings(block_size=20)

PROCESSES = 2

_AFTER_REPAIR = 9.0
"""Longest time [s] for which a repaired rig is watched."""

_AFTER_CHANGE = 6.0
"""Time [s] for which one is watched that is not repaired."""

_GOOD = 0.15
"""A force is good again whose error (RMS) is below this part of the peak, all valid, for 1 s."""

_ALL, _USUAL_TIME, _AS_MUCH = 0.99, 4.0, 0.9
"""A force that was good for less than all of so many seconds before the fault is good again where
it is for this part of that."""

_GOOD_SET, _WORSE = 0.2, 0.05
"""A set is good that leaves at most so much of the true force unexplained (NRMSE), and one that
leaves so much more is worse."""


@dataclass(frozen=True)
class Outcome:
    """What came of a scenario with a damper.

    ``wrong_valid`` [s] is the longest stretch, ``worst`` the largest error in it over the peak, at
    ``at`` [s]; ``recovery`` [windows] after the repair, NaN where there is none; ``bad_sets``:
    names of the sets taken that are worse for the damper as it truly is.
    """

    scenario: Scenario
    damper: str
    wrong_valid: float
    worst: float
    at: float
    recovery: float
    bad_sets: tuple[str, ...]


def run(base: StreamTrial, scenario: Scenario, damper: str) -> Outcome:
    """Let things go wrong in a stream that has run until then."""
    seed = zlib.crc32(f"{scenario.name} {damper}".encode())
    trial = base.branch(scenario.made(seed), scenario.schedule)
    end = scenario.begin if scenario.lasts else scenario.end
    usual = usual_share(base.result(), scenario.begin)
    window = SETTINGS.windows.window
    trial.advance(end - trial.now)
    recovery = math.nan
    if scenario.lasts:
        trial.advance(_AFTER_CHANGE)
    else:
        while trial.now < end + _AFTER_REPAIR and math.isnan(recovery):
            trial.advance(1.0)
            since = good_since(trial.result(), end, usual)
            recovery = (since - end) / window
        if math.isnan(recovery):
            recovery = math.inf
    result = trial.result()
    stretch = result.wrong_valid(since=scenario.begin)
    return Outcome(
        scenario,
        damper,
        stretch.longest,
        stretch.worst,
        stretch.at,
        recovery,
        tuple(bad_sets(result, scenario.begin)),
    )


def usual_share(result: TrialResult, begin: float) -> float:
    """Part of the last seconds before a fault in which the force was valid and right."""
    right = result.valid & (result.error <= WRONG)
    asked = (result.time >= begin - _USUAL_TIME) & (result.time < begin)
    return float(np.mean(right[asked]))


def good_since(result: TrialResult, begin: float, usual: float = 1.0) -> float:
    """Time [s] from which the force has been valid and good to the end; NaN for less than 1 s.

    Where the law cannot follow the damper all the time it was so for a part of the time only before
    the fault, ``usual``: then that from which it is so for as large a part of a second.
    """
    error = np.where(result.valid, result.error, math.inf)
    count = round(1.0 / result.period)
    if usual < _ALL:
        right = (error <= WRONG) & (result.time >= begin)
        shares = np.convolve(right, np.full(count, 1.0 / count), mode="valid")
        places = np.flatnonzero(shares >= _AS_MUCH * usual)
        # The second may begin a little earlier: it need not be good throughout.
        return max(float(result.time[places[0]]), begin) if places.size else math.nan
    wrong = np.flatnonzero((error > WRONG) & (result.time >= begin))
    since = int(wrong[-1]) + 1 if wrong.size else int(np.searchsorted(result.time, begin))
    if result.time.size - since < count or np.sqrt(np.mean(error[since:] ** 2)) > _GOOD:
        return math.nan
    return float(result.time[since])


def bad_sets(result: TrialResult, since: float) -> Iterable[str]:
    """Names of the sets that are worse than a good one before, by the true motion and force.

    Worse both over a window before the set took effect and over the second after: a set that has
    just caught up with a change is worse for what came before it.
    """
    for before, after in pairwise(result.sets):
        if after.time < since:
            continue
        found = [
            (nrmse(before.parameters, truth), nrmse(after.parameters, truth))
            for truth in (
                _truth(result, after.time - SETTINGS.windows.window, after.time),
                _truth(result, after.time, after.time + 1.0),
            )
            if truth is not None
        ]
        if found and all(old <= _GOOD_SET and new > old + _WORSE for old, new in found):
            old, new = found[0]
            yield f"{after.parameters.set_id} ({old:.0%} to {new:.0%} at {after.time:.1f} s)"


def _truth(result: TrialResult, begin: float, end: float) -> Window | None:
    """The true motion and force between two times [s]; None where next to nothing moved."""
    part = slice(max(round(begin / result.period), 0), round(end / result.period))
    try:
        return Window.from_samples(
            result.displacement[part], result.true[part], result.current[part], result.period
        )
    except ValueError:
        return None


def nrmse(parameters: ParameterSet, window: Window) -> float:
    """RMSE/std of the force that a set predicts on a window."""
    predicted = parameters.law.window_force(window, parameters.values)
    error = float(np.sqrt(np.mean((predicted - window.force) ** 2)) / np.std(window.force))
    return error if math.isfinite(error) else math.inf


def measure(
    scenarios: Sequence[Scenario] = SCENARIOS,
    dampers: Sequence[str] = tuple(DAMPERS),
    processes: int = PROCESSES,
) -> list[Outcome]:
    """All scenarios with all dampers; a stream up to the fault is run once."""
    groups: dict[tuple[str, str, float, int], list[Scenario]] = defaultdict(list)
    for place, scenario in enumerate(scenarios):
        for damper in dampers:
            # The largest groups are split, so that the processes end together.
            groups[damper, scenario.stream, scenario.begin, place % 2].append(scenario)
    jobs = [(damper, stream, begin, group) for (damper, stream, begin, _), group in groups.items()]
    if processes == 1:
        found = [_run_group(*job) for job in jobs]
    else:
        with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
            found = list(pool.map(_run_group, *zip(*jobs, strict=True)))
    return [outcome for group in found for outcome in group]


def _run_group(
    damper: str, stream: str, begin: float, scenarios: Sequence[Scenario]
) -> list[Outcome]:
    """Scenarios that share the stream up to their beginning."""
    before = STREAMS[stream]
    base = StreamTrial(DAMPERS[damper], before.motion(), before.current, settings=SETTINGS)
    # The rig is a few samples ahead of what has been taken.
    base.advance(begin - 0.5)
    return [run(base, scenario, damper) for scenario in scenarios]


def worst_of_each(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Of each scenario the damper with the longest stretch, the longest first."""
    worst: dict[str, Outcome] = {}
    for outcome in outcomes:
        key = outcome.scenario.name + str(outcome.scenario.lasts)
        if key not in worst or outcome.wrong_valid > worst[key].wrong_valid:
            worst[key] = outcome
    return sorted(worst.values(), key=lambda outcome: -outcome.wrong_valid)


def told(outcome: Outcome) -> str:
    """A sentence on an outcome."""
    lasting = " for good" if outcome.scenario.lasts else ""
    return (
        f"{outcome.scenario.name}{lasting}, {outcome.damper}: {outcome.wrong_valid:.2f} s, "
        f"up to {outcome.worst:.0%} of the peak"
    )


def figures(
    scenarios: Sequence[Scenario] = SCENARIOS, dampers: Sequence[str] = tuple(DAMPERS)
) -> list[Figure]:
    """``fault_cases``, ``wrong_valid_s``, ``recovery_windows`` and ``bad_set_taken``."""
    return figures_of(measure(scenarios, dampers))


def figures_of(outcomes: Sequence[Outcome]) -> list[Figure]:
    """The figures of what came of the scenarios."""
    knowable = [outcome for outcome in outcomes if not outcome.scenario.unknowable]
    unknowable = [outcome for outcome in outcomes if outcome.scenario.unknowable]
    worst = worst_of_each(knowable)
    recoveries = [o for o in knowable if not math.isnan(o.recovery)]
    slowest = sorted(recoveries, key=lambda o: -o.recovery)
    bad = [o for o in knowable if o.bad_sets and not o.scenario.other_damper]
    doubtful = sum(len(o.bad_sets) for o in outcomes) - sum(len(o.bad_sets) for o in bad)
    return [
        Figure(
            "fault_cases",
            float(len(knowable)),
            "Scenarios of trouble times dampers of laws unlike the sixteen, without those whose "
            "signals cannot tell (doc/faults.md).",
            (180.0, math.inf),
            f"Not counted, with the longest time: {'; '.join(map(told, unknowable))}.",
        ),
        Figure(
            "wrong_valid_s",
            float(np.median([o.wrong_valid for o in worst])),
            "Longest time [s] for which a force wrong by more than 20 % of the peak of the last "
            "10 s is called valid: of each scenario the worst damper, of these the median.",
            (0.0, 0.5),
        ),
        Figure(
            "wrong_valid_longest_s",
            worst[0].wrong_valid,
            "The longest of them.",
            (0.0, 2.0),
            f"Worst: {'; '.join(map(told, worst[:5]))}.",
        ),
        Figure(
            "recovery_windows",
            slowest[0].recovery if slowest else None,
            "Time from the repair until the force is valid and right within 20 % of the peak, and "
            f"within {_GOOD:.0%} (RMS), for at least 1 s, in windows of "
            f"{SETTINGS.windows.window:g} s: the longest. Where the law followed the damper for a "
            f"part of the last {_USUAL_TIME:g} s before the fault only: for {_AS_MUCH:.0%} of that "
            "part of a second.",
            (0.0, 4.0),
            f"{sum(o.recovery > 4.0 for o in recoveries)} of {len(recoveries)} take longer. "
            "Slowest: "
            + "; ".join(f"{o.scenario.name}, {o.damper}: {o.recovery:.1f}" for o in slowest[:5])
            + ".",
        ),
        Figure(
            "bad_set_taken",
            float(sum(len(o.bad_sets) for o in bad)),
            "Sets taken that leave more of the true force unexplained than the good one before "
            f"(NRMSE up to {_GOOD_SET:.0%}), by more than {_WORSE:.0%}, over the true motion of "
            "the window before they took effect and of the second after.",
            (0.0, 0.0),
            "; ".join(f"{o.scenario.name}, {o.damper}: {', '.join(o.bad_sets)}" for o in bad[:5])
            + f" Not counted, because the signals are those of another damper: {doubtful}.",
        ),
    ]
