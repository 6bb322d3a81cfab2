"""Duration of wrong but valid force under many kinds of fault, for dampers of other laws."""

from __future__ import annotations

import math
import zlib
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks.figure import PROCESSES, Measured, in_processes
from benchmarks.other_dampers import DAMPERS, random_motion
from benchmarks.stream_trial import (
    WRONG,
    StreamTrial,
    Stretch,
    TrialResult,
    TrialSettings,
    worse_sets,
)
from mr_damper_ros.emulation.emulator import CurrentSchedule
from mr_damper_ros.emulation.faults import Fault, faults_of
from mr_damper_ros.emulation.motions import Excitation, SineMotion

BEGIN, END = 10.0, 14.0
"""Times at which a fault begins and is repaired, since the start of the stream [s]."""

STREAMS: dict[str, tuple[Callable[[], Excitation], float]] = {
    "sine": (partial(SineMotion, 0.005, 1.0), 1.5),
    "weak": (partial(SineMotion, 0.005, 1.0), 0.2),
    "off": (partial(SineMotion, 0.005, 1.0), 0.0),
    "random": (partial(random_motion, 0.003, 0.2, 3.0, 60.0, seed=3), 1.0),
}
"""Operation before the fault: a motion and a constant current [A]."""


@dataclass(frozen=True)
class Scenario:
    """Faults in a stream, as text without times.

    ``lasts``: the fault is not repaired. ``current``: the supply switches to this current [A] when
    the fault begins and back when it ends. ``unknowable``: the signals do not show the fault.
    ``other_damper``: the signals show a change, but a set identified during the fault fits a
    different damper equally well.
    """

    faults: str = ""
    stream: str = "sine"
    lasts: bool = False
    current: float | None = None
    unknowable: bool = False
    other_damper: bool = False
    begin: float = BEGIN
    end: float = END

    @property
    def name(self) -> str:
        """The faults and the stream in words."""
        moved = "" if self.current is None else f"current to {self.current:g} A"
        return f"{' '.join(filter(None, (moved, self.faults)))} ({self.stream})"

    def made(self, seed: int) -> list[Fault]:
        """The faults with their times."""
        times = f"@{self.begin:g}" + ("" if self.lasts else f"-{self.end:g}")
        return faults_of([text + times for text in self.faults.split()], seed)

    @property
    def schedule(self) -> CurrentSchedule | None:
        """Schedule of the current; None for a constant current."""
        if self.current is None:
            return None
        usual = STREAMS[self.stream][1]
        if self.lasts:
            return CurrentSchedule((0.0, self.begin), (usual, self.current))
        return CurrentSchedule((0.0, self.begin, self.end), (usual, self.current, usual))


def _all(*faults: str, stream: str = "sine", lasts: bool = False) -> list[Scenario]:
    return [Scenario(text, stream, lasts) for text in faults]


SCENARIOS: tuple[Scenario, ...] = (
    # The load cell.
    *_all("force_gain:1000", "force_gain:0.001", "force_gain:10", "force_gain:0.1"),
    *_all("force_gain:-1", "force_gain:0", "force_stuck", "force_missing", "force_dropouts:5"),
    *_all("force_nan:2", "force_spikes:500", "force_noise:100", "force_clip:200"),
    *_all("force_coarse:200", "force_hum:200"),
    *_all("force_gain:1000", "force_gain:0.001", "force_gain:-1", lasts=True),
    # The displacement.
    *_all("displacement_gain:1000", "displacement_gain:0.001", "displacement_gain:-1"),
    *_all("displacement_gain:0"),
    # The signals are those of a damper that gives the same force at the scaled motion.
    Scenario("displacement_gain:10", other_damper=True),
    Scenario("displacement_gain:0.1", other_damper=True),
    *_all("displacement_stuck", "displacement_missing", "displacement_dropouts:5"),
    *_all("displacement_nan:2", "displacement_spikes:0.002", "displacement_noise:1e-4"),
    *_all("displacement_offset:0.01", "displacement_creep:0.001", "displacement_clip:0.003"),
    *_all("displacement_coarse:0.001", "displacement_hum:5e-5"),
    # A spring parallel to the damper would cause the same lead of the force.
    Scenario("displacement_delay:0.1", other_damper=True),
    Scenario("displacement_sluggish:0.1", other_damper=True),
    *_all("displacement_gain:-1", "displacement_stuck", lasts=True),
    # The current and its supply.
    *_all("current_gain:1000", "current_gain:0.001", "current_gain:-1", "current_missing"),
    *_all("current_nan:2", "current_spikes:1", "current_noise:0.2", "current_offset:0.5"),
    *_all("supply_clock:2", "supply_clock:-2", "supply_clock:3600"),
    *_all("coil_factor:0", "coil_factor:0.5", "coil_offset:-0.5"),
    Scenario("supply_clock:2", current=0.5),
    Scenario("supply_clock:-2", current=0.5),
    Scenario("current_stuck", current=0.5),
    Scenario("current_delay:1", current=0.5),
    Scenario(current=0.5),
    Scenario(current=1.42),
    Scenario(current=0.095, stream="off"),
    Scenario(current=0.29, stream="weak"),
    Scenario(current=1.5, stream="weak"),
    Scenario("current_stuck", current=1.5, stream="off"),
    # The thermometer.
    *_all("temperature_gain:10", "temperature_missing"),
    # Machine and damper.
    *_all("force_loss:0.5", "force_loss:0.1", "friction:200", "spring:5e4", "backlash:0.001"),
    *_all("end_stop:0.0045", "wear:0.6"),
    *_all("force_loss:0.5", "force_loss:0.2", lasts=True),
    *_all("amplitude:0.1", "amplitude:2", "tempo:0", "tempo:3", "tempo:0.1"),
    *_all("amplitude:0.1", "amplitude:10", "tempo:0.05", lasts=True),
    # The transmission path.
    *_all("lost_blocks:0.05", "lost_blocks:1", "doubled_blocks:0.2", "reordered_blocks:0.2"),
    *_all("late_blocks:0.3", "repeated_buffer", "stamp_jitter:0.4", "clock_jump:60"),
    *_all("clock_jump:-60", "clock_jump:1e6", "clock_drift:0.001", "wrong_period:2"),
    *_all("wrong_period:0.5", "wrong_period:1e6", "recount", "swapped"),
    # In random motion.
    *_all("force_gain:10", "force_gain:0.1", "force_gain:-1", "force_stuck", stream="random"),
    *_all("displacement_gain:-1", "displacement_stuck", stream="random"),
    Scenario("displacement_gain:10", stream="random", other_damper=True),
    *_all("coil_factor:0", "force_loss:0.4", "tempo:0", "lost_blocks:0.05", stream="random"),
    # The signals are those of a stronger or weaker damper, as after a change of temperature, ...
    Scenario("force_gain:0.5", unknowable=True, lasts=True),
    Scenario("force_gain:1.5", unknowable=True, lasts=True),
    # ... of another gas pressure, ...
    Scenario("force_creep:60", unknowable=True, lasts=True),
    Scenario("force_offset:300", unknowable=True),
    Scenario("crosstalk:200", unknowable=True),
    # ... or with a mount or a fluid that has become compressible.
    Scenario("force_delay:0.1", unknowable=True),
    Scenario("force_sluggish:0.1", unknowable=True),
)
"""All of them."""


SETTINGS = TrialSettings(block_size=20)

_AFTER_REPAIR = 9.0
"""Longest time [s] for which a rig is observed after its repair."""

_AFTER_CHANGE = 6.0
"""Time [s] for which a rig without repair is observed."""

_GOOD = 0.15
"""Largest RMS error of a recovered force, as a fraction of the peak, over 1 s of valid force."""

_ALL, _USUAL_TIME, _AS_MUCH = 0.99, 4.0, 0.9
"""If the force was good for only part of the first number of seconds before the fault, it has
recovered when it is good for the second number times that part."""

_GOOD_SET = 0.2
"""Largest NRMSE of a good set against the true force."""


@dataclass(frozen=True)
class Outcome:
    """Result of a scenario with a damper.

    ``wrong_valid`` [s] is the longest period of wrong but valid force. ``worst`` is the largest
    error in it over the peak force, at time ``at`` [s]. ``recovery`` is the number of windows after
    the repair, NaN without a repair. ``bad_sets`` names the accepted sets that describe the true
    damper worse than their predecessors.
    """

    scenario: Scenario
    damper: str
    wrong_valid: float
    worst: float
    at: float
    recovery: float
    bad_sets: tuple[str, ...]


def run(base: StreamTrial, scenario: Scenario, damper: str) -> Outcome:
    """Apply the faults of a scenario to a stream that has run up to their beginning."""
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
    """Fraction of the last seconds before a fault with valid and correct force."""
    right = result.valid & (result.error <= WRONG)
    asked = (result.time >= begin - _USUAL_TIME) & (result.time < begin)
    return float(np.mean(right[asked]))


def good_since(result: TrialResult, begin: float, usual: float = 1.0) -> float:
    """Time [s] from which the force is valid and good to the end; NaN if that is less than 1 s.

    If the law cannot always follow the damper, the force was good only for the fraction ``usual``
    of the time before the fault. The result is then the start of the first second in which the
    force is good for as large a fraction of the time.
    """
    error = np.where(result.valid, result.error, math.inf)
    count = round(1.0 / result.period)
    if usual < _ALL:
        right = (error <= WRONG) & (result.time >= begin)
        shares = np.convolve(right, np.full(count, 1.0 / count), mode="valid")
        places = np.flatnonzero(shares >= _AS_MUCH * usual)
        # This second may begin a little earlier, because it need not be good throughout.
        return max(float(result.time[places[0]]), begin) if places.size else math.nan
    wrong = np.flatnonzero((error > WRONG) & (result.time >= begin))
    since = int(wrong[-1]) + 1 if wrong.size else int(np.searchsorted(result.time, begin))
    if result.time.size - since < count or np.sqrt(np.mean(error[since:] ** 2)) > _GOOD:
        return math.nan
    return float(result.time[since])


def bad_sets(result: TrialResult, since: float) -> list[str]:
    """Sets that are worse than a good predecessor, judged by the true motion and force.

    Such a set is worse both over the window before it took effect and over the second after.
    Comparing only the time before would count a set that has just followed a change of the damper.
    """
    spans = [(-SETTINGS.windows.window, 0.0), (0.0, 1.0)]
    return [
        f"{each.set_id} ({each.before:.0%} to {each.after:.0%} at {each.time:.1f} s)"
        for each in worse_sets(result, spans, _GOOD_SET)
        if each.time >= since
    ]


def measure(
    scenarios: Sequence[Scenario] = SCENARIOS,
    dampers: Sequence[str] = tuple(DAMPERS),
    processes: int = PROCESSES,
) -> list[Outcome]:
    """Run all scenarios with all dampers; scenarios share the stream up to the fault."""
    groups: dict[tuple[str, str, float, int], list[Scenario]] = defaultdict(list)
    for place, scenario in enumerate(scenarios):
        for damper in dampers:
            # Splitting the largest groups makes the processes end at about the same time.
            groups[damper, scenario.stream, scenario.begin, place % 2].append(scenario)
    found = in_processes(
        _run_group,
        [(damper, stream, begin, group) for (damper, stream, begin, _), group in groups.items()],
        processes,
    )
    return [outcome for group in found for outcome in group]


def _run_group(job: tuple[str, str, float, Sequence[Scenario]]) -> list[Outcome]:
    """Scenarios that share the stream up to their beginning."""
    damper, stream, begin, scenarios = job
    motion, current = STREAMS[stream]
    base = StreamTrial(DAMPERS[damper], motion(), current, settings=SETTINGS)
    # The rig is a few samples ahead of the samples that were processed.
    base.advance(begin - 0.5)
    return [run(base, scenario, damper) for scenario in scenarios]


def worst_of_each(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """The worst damper of each scenario, sorted by the period of wrong but valid force."""
    worst: dict[str, Outcome] = {}
    for outcome in outcomes:
        key = outcome.scenario.name + str(outcome.scenario.lasts)
        if key not in worst or worst[key].wrong_valid < outcome.wrong_valid:
            worst[key] = outcome
    return sorted(worst.values(), key=lambda outcome: -outcome.wrong_valid)


def told(outcome: Outcome) -> str:
    """One-sentence description of an outcome."""
    lasting = " for good" if outcome.scenario.lasts else ""
    return (
        f"{outcome.scenario.name}{lasting}, {outcome.damper}: {outcome.wrong_valid:.2f} s, "
        f"up to {outcome.worst:.0%} of the peak"
    )


def figures(every: int = 1, dampers: Sequence[str] = tuple(DAMPERS)) -> Measured:
    """Run all scenarios, or one in ``every``."""
    return figures_of(measure(SCENARIOS[::every], dampers))


def figures_of(outcomes: Sequence[Outcome]) -> Measured:
    """Figures computed from the outcomes of the scenarios."""
    knowable = [outcome for outcome in outcomes if not outcome.scenario.unknowable]
    unknowable = [outcome for outcome in outcomes if outcome.scenario.unknowable]
    worst = worst_of_each(knowable)
    recoveries = [o for o in knowable if not math.isnan(o.recovery)]
    slowest = sorted(recoveries, key=lambda o: -o.recovery)
    bad = [o for o in knowable if o.bad_sets and not o.scenario.other_damper]
    doubtful = sum(len(o.bad_sets) for o in outcomes) - sum(len(o.bad_sets) for o in bad)
    return {
        "fault_cases": (
            float(len(knowable)),
            f"Not counted, with the longest time: {'; '.join(map(told, unknowable))}.",
        ),
        "wrong_valid_s": float(np.median([o.wrong_valid for o in worst])),
        "wrong_valid_longest_s": (
            worst[0].wrong_valid,
            f"Worst: {'; '.join(map(told, worst[:5]))}.",
        ),
        "recovery_windows": (
            slowest[0].recovery if slowest else None,
            f"{sum(o.recovery > 4.0 for o in recoveries)} of {len(recoveries)} take longer than "
            "four. Slowest: "
            + "; ".join(f"{o.scenario.name}, {o.damper}: {o.recovery:.1f}" for o in slowest[:5]),
        ),
        "bad_set_taken": (
            float(sum(len(o.bad_sets) for o in bad)),
            "; ".join(f"{o.scenario.name}, {o.damper}: {', '.join(o.bad_sets)}" for o in bad[:5])
            + f" Not counted, because the signals are those of another damper: {doubtful}.",
        ),
    }


# -- wild samples of the load cell, then a loss of force -------------------------------------------

SPIKES = (3000, 8000, 20_000)
"""Sizes [N] of the outliers, which occur five times a second for one second."""

_LOST = 0.3
"""Fraction of the force that remains after its loss, half a second after the last outlier."""

SPIKED: dict[str, tuple[Callable[[], Excitation], float]] = {
    "0.05 Hz": (partial(SineMotion, 0.01, 0.05), 70.0),
    "0.5 Hz": (partial(SineMotion, 0.01, 0.5), 14.0),
    "1 Hz": (partial(SineMotion, 0.005, 1.0), 12.0),
    "5 Hz": (partial(SineMotion, 0.003, 5.0), 12.0),
    "random 0.2-3 Hz": (partial(random_motion, 3e-3, 0.2, 3.0, 40.0, 5), 16.0),
}
"""Motions by name, each with the time [s] of the outliers."""


def spike_figures(names: Sequence[str] = tuple(SPIKED)) -> Measured:
    """Run each size of outlier in each stream.

    The error of a force must be judged by the span of the measured force, which a few outliers must
    not change.
    """
    found: list[tuple[Stretch, str]] = []
    for name in names:
        motion, at = SPIKED[name]
        base = StreamTrial(DAMPERS["viscous_tanh"], motion(), 1.2)
        base.advance(at)
        for size in SPIKES:
            spikes = f"force_spikes:{size}@{at:g}-{at + 1:g}"
            trial = base.branch(faults_of([spikes, f"force_loss:{_LOST}@{at + 1.5:g}"], seed=size))
            found.append((trial.run(12.0).wrong_valid(since=at), f"{name}, {size} N"))
    found.sort(key=lambda spoilt: -spoilt[0].longest)
    return {
        "spike_wrong_valid_s": (
            found[0][0].longest,
            "Most: "
            + "; ".join(f"{name}: {s.longest:.2f} s, up to {s.worst:.0%}" for s, name in found[:4]),
        )
    }
