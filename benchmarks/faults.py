"""Wrong force that is called valid, on faulty and healthy rigs, for dampers of other laws."""

from __future__ import annotations

import math
import zlib
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product, repeat

import numpy as np

from benchmarks.dampers import DAMPERS
from benchmarks.figure import Measured, in_processes, some_of
from benchmarks.motions import chirp, random_motion, stairs, stops
from benchmarks.streams import StreamTrial, Stretch, TrialResult, TrialSettings, at_rest, worse_sets
from mr_damper_ros.emulation.emulator import CurrentSchedule
from mr_damper_ros.emulation.faults import faults_of
from mr_damper_ros.emulation.motions import Excitation, SineMotion
from mr_damper_ros.tracking.engine import EngineSettings
from mr_damper_ros.tracking.window_assembler import WindowSettings

Moved = Callable[[int], Excitation]
"""A motion, made from a seed."""


def _sine(amplitude: float, frequency: float) -> Moved:
    return lambda _: SineMotion(amplitude, frequency)


def _random(rms: float, low: float, high: float, duration: float, first: int) -> Moved:
    return lambda seed: random_motion(rms, low, high, duration, first + seed)


STREAMS: dict[str, tuple[Moved, float]] = {
    "sine": (_sine(0.005, 1.0), 1.5),
    "weak": (_sine(0.005, 1.0), 0.2),
    "off": (_sine(0.005, 1.0), 0.0),
    "random": (_random(0.003, 0.2, 3.0, 60.0, 3), 1.0),
}
"""Operation before the fault: a motion and a constant current [A]."""


@dataclass(frozen=True)
class Scenario:
    """Faults in a stream, as text without times; they begin and are repaired at these times [s].

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
    begin: float = 10.0
    end: float = 14.0

    @property
    def name(self) -> str:
        """The faults and the stream in words."""
        moved = "" if self.current is None else f"current to {self.current:g} A"
        return f"{' '.join(filter(None, (moved, self.faults)))} ({self.stream})"

    def branch(self, base: StreamTrial, seed: int) -> StreamTrial:
        """The trial with these faults."""
        times = f"@{self.begin:g}" + ("" if self.lasts else f"-{self.end:g}")
        schedule = None
        if self.current is not None:
            usual, count = STREAMS[self.stream][1], 2 if self.lasts else 3
            steps, levels = (0.0, self.begin, self.end), (usual, self.current, usual)
            schedule = CurrentSchedule(steps[:count], levels[:count])
        return base.branch(
            faults_of([text + times for text in self.faults.split()], seed), schedule
        )


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
    # Within one sample, as no damper changes.
    *_all("force_gain:0.5", "force_gain:1.5", lasts=True),
    *_all("force_offset:300"),
    # The signals are those of a damper of another gas pressure, ...
    Scenario("force_creep:60", unknowable=True, lasts=True),
    Scenario("crosstalk:200", unknowable=True),
    # ... or with a mount or a fluid that has become compressible.
    Scenario("force_delay:0.1", unknowable=True),
    Scenario("force_sluggish:0.1", unknowable=True),
)
"""All scenarios."""

_WINDOW = WindowSettings.window
"""Length [s] of a window of the identifier."""

_AFTER_REPAIR, _AFTER_CHANGE = 9.0, 6.0
"""Longest time [s] for which a rig is observed after its repair, or without a repair."""

LONGEST_RECOVERY = _AFTER_REPAIR / _WINDOW
"""The same after its repair, in windows; a longer recovery is infinite."""

_GOOD = 0.15
"""Largest RMS error of a recovered force, as a fraction of the peak, over 1 s of valid force."""

_ALL, _USUAL_TIME, _AS_MUCH = 0.99, 4.0, 0.9
"""If the force was good for only part of the first number of seconds before the fault, it has
recovered when it is good for the second number times that part."""

_GOOD_SET = 0.2
"""Largest NRMSE of a good set against the true force."""


@dataclass(frozen=True)
class Outcome:
    """Result of a scenario with a damper: the time of ``wrong`` but valid force.

    ``recovery`` is the number of windows after the repair, NaN without a repair. ``bad_sets`` names
    the accepted sets that describe the true damper worse than their predecessors.
    """

    scenario: Scenario
    damper: str
    wrong: Stretch
    recovery: float
    bad_sets: Sequence[str]

    def __str__(self) -> str:
        lasting = " for good" if self.scenario.lasts else ""
        return (
            f"{self.scenario.name}{lasting}, {self.damper}: {self.wrong.longest:.2f} s, "
            f"up to {self.wrong.worst:.0%} of the peak"
        )


def run(base: StreamTrial, scenario: Scenario, damper: str, seed: int = 0) -> Outcome:
    """Apply the faults of a scenario to a stream that has run up to their beginning."""
    trial = scenario.branch(base, zlib.crc32(f"{scenario.name} {damper}".encode()) + seed)
    end = scenario.begin if scenario.lasts else scenario.end
    usual = _usual_share(base.result(), scenario.begin)
    trial.advance(end - trial.now)
    recovery = math.nan
    if scenario.lasts:
        trial.advance(_AFTER_CHANGE)
    else:
        while trial.now < end + _AFTER_REPAIR and math.isnan(recovery):
            trial.advance(1.0)
            recovery = (_good_since(trial.result(), end, usual) - end) / _WINDOW
        if math.isnan(recovery):
            recovery = math.inf
    result = trial.result()
    wrong, bad = result.wrong_valid(since=scenario.begin), _bad_sets(result, scenario.begin)
    return Outcome(scenario, damper, wrong, recovery, bad)


def _usual_share(result: TrialResult, begin: float) -> float:
    """Fraction of the last seconds before a fault with valid and correct force."""
    asked = (result.time >= begin - _USUAL_TIME) & (result.time < begin)
    return float(np.mean((result.valid & result.right)[asked]))


def _good_since(result: TrialResult, begin: float, usual: float) -> float:
    """Time [s] from which the force is valid and good to the end; NaN if that is less than 1 s.

    If the law cannot always follow the damper, the force was good only for the fraction ``usual``
    of the time before the fault. The result is then the start of the first second in which the
    force is good for as large a fraction of the time.
    """
    right, asked = result.valid & result.right, result.time >= begin
    count = round(1.0 / result.period)
    if usual < _ALL:
        shares = np.convolve(right & asked, np.full(count, 1.0 / count), mode="valid")
        places = np.flatnonzero(shares >= _AS_MUCH * usual)
        # This second may begin a little earlier, because it need not be good throughout.
        return max(float(result.time[places[0]]), begin) if places.size else math.nan
    wrong = np.flatnonzero(~right & asked)
    since = int(wrong[-1]) + 1 if wrong.size else int(np.searchsorted(result.time, begin))
    error = result.error[since:]
    if error.size < count or np.sqrt(np.mean(error**2)) > _GOOD:
        return math.nan
    return float(result.time[since])


def _bad_sets(result: TrialResult, since: float) -> list[str]:
    """Sets that are worse than a good predecessor, judged by the true motion and force.

    Such a set is worse both over the window before it took effect and over the second after.
    Comparing only the time before would count a set that has just followed a change of the damper.
    """
    return [
        f"{each.set_id} ({each.before:.0%} to {each.after:.0%} at {each.time:.1f} s)"
        for each in worse_sets(result, [(-_WINDOW, 0.0), (0.0, 1.0)], _GOOD_SET)
        if each.time >= since
    ]


def _run_group(job: tuple[str, str, Sequence[Scenario], int]) -> list[Outcome]:
    """Scenarios that share the stream up to their beginning."""
    damper, stream, scenarios, seed = job
    motion, current = STREAMS[stream]
    settings = TrialSettings(seed, block_size=20)
    base = StreamTrial(DAMPERS[damper], motion(seed), current, settings=settings)
    # The rig is a few samples ahead of the samples that were processed.
    base.advance(scenarios[0].begin - 0.5)
    return [run(base, scenario, damper, seed) for scenario in scenarios]


def figures(every: int = 1, dampers: Sequence[str] = tuple(DAMPERS), seed: int = 0) -> Measured:
    """Run all scenarios, or one in ``every``, with these dampers."""
    groups: dict[tuple[str, str, int], list[Scenario]] = defaultdict(list)
    chosen = some_of(SCENARIOS, every, seed)
    for (place, scenario), damper in product(enumerate(chosen), dampers):
        # Splitting the largest groups makes the processes end at about the same time.
        groups[damper, scenario.stream, place % 2].append(scenario)
    jobs = [(damper, stream, group, seed) for (damper, stream, _), group in groups.items()]
    return figures_of([each for found in in_processes(_run_group, jobs) for each in found])


def figures_of(outcomes: Sequence[Outcome]) -> Measured:
    """Figures computed from the outcomes of the scenarios."""
    ordered = sorted(outcomes, key=lambda o: -o.wrong.longest)
    knowable = [o for o in ordered if not o.scenario.unknowable]
    unknowable = [str(o) for o in outcomes if o.scenario.unknowable]
    # The first of each scenario is its worst damper.
    worst = {(o.scenario.name, o.scenario.lasts): o for o in reversed(knowable)}
    longest = sorted(worst.values(), key=lambda o: -o.wrong.longest)
    slowest = sorted((o for o in knowable if not math.isnan(o.recovery)), key=lambda o: -o.recovery)
    bad = [o for o in knowable if o.bad_sets and not o.scenario.other_damper]
    taken = sum(len(o.bad_sets) for o in bad)
    doubtful = sum(len(o.bad_sets) for o in outcomes) - taken
    return {
        "fault_cases": (
            float(len(knowable)),
            f"Not counted, with the longest time: {'; '.join(unknowable)}.",
        ),
        "wrong_valid_s": float(np.median([o.wrong.longest for o in longest])),
        "wrong_valid_longest_s": (
            longest[0].wrong.longest,
            f"Worst: {'; '.join(map(str, longest[:5]))}.",
        ),
        "recovery_windows": (
            slowest[0].recovery if slowest else None,
            f"{sum(o.recovery > 4.0 for o in slowest)} of {len(slowest)} take longer than four. "
            "Slowest: "
            + "; ".join(f"{o.scenario.name}, {o.damper}: {o.recovery:.1f}" for o in slowest[:5]),
        ),
        "bad_set_taken": (
            float(taken),
            "; ".join(f"{o.scenario.name}, {o.damper}: {', '.join(o.bad_sets)}" for o in bad[:5])
            + f" Not counted, because the signals are those of another damper: {doubtful}.",
        ),
    }


# -- wild samples of the load cell, then a loss of force -------------------------------------------

SPIKES = (3000, 8000, 20_000)
"""Sizes [N] of the outliers, which occur five times a second for one second."""

_LOST = 0.3
"""Fraction of the force that remains after its loss, half a second after the last outlier."""

SPIKED: dict[str, tuple[Moved, float]] = {
    "0.05 Hz": (_sine(0.01, 0.05), 70.0),
    "0.5 Hz": (_sine(0.01, 0.5), 14.0),
    "1 Hz": (_sine(0.005, 1.0), 12.0),
    "5 Hz": (_sine(0.003, 5.0), 12.0),
    "random 0.2-3 Hz": (_random(3e-3, 0.2, 3.0, 40.0, 5), 16.0),
}
"""Motions by name, each with the time [s] of the outliers."""


def spike_figures(names: Sequence[str] = tuple(SPIKED), seed: int = 0) -> Measured:
    """Run each size of outlier in each stream.

    The error of a force must be judged by the span of the measured force, which a few outliers must
    not change.
    """
    found: list[tuple[Stretch, str]] = []
    for name in names:
        motion, at = SPIKED[name]
        base = StreamTrial(DAMPERS["viscous_tanh"], motion(seed), 1.2, settings=TrialSettings(seed))
        base.advance(at)
        for size in SPIKES:
            faults = f"force_spikes:{size}@{at:g}-{at + 1:g}", f"force_loss:{_LOST}@{at + 1.5:g}"
            trial = base.branch(faults_of(faults, seed=size + seed))
            found.append((trial.run(12.0).wrong_valid(since=at), f"{name}, {size} N"))
    found.sort(key=lambda spoilt: -spoilt[0].longest)
    told = [f"{name}: {each.longest:.2f} s, up to {each.worst:.0%}" for each, name in found[:4]]
    return {"spike_wrong_valid_s": (found[0][0].longest, f"Most: {'; '.join(told)}")}


# -- healthy dampers -------------------------------------------------------------------------------

HEALTHY_LAWS = ("sigmoid", "sigmoid_lag")
"""Identified laws: the default, and the law for any motion."""

_TOP_SPEED, _LARGEST = 0.1, 0.01
"""Limits of the machine: velocity [m/s] and displacement [m]."""


def _steady(frequency: float) -> tuple[Moved, float, float]:
    amplitude = min(_LARGEST, _TOP_SPEED / (2.0 * np.pi * frequency))
    # Long enough to identify the slow motions and continue for some time.
    return _sine(amplitude, frequency), max(15.0, 4.0 / frequency), 0.0


PROGRAMMES: dict[str, tuple[Moved, float, float]] = {
    **{f"{f:g} Hz": _steady(f) for f in (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)},
    "random 0.2-3 Hz": (_random(3e-3, 0.2, 3.0, 40.0, 5), 40.0, 0.0),
    "random 0.5-8 Hz": (_random(2e-3, 0.5, 8.0, 40.0, 6), 40.0, 0.0),
    "chirp 0.2-20 Hz": (lambda _: chirp(_TOP_SPEED, 5e-3, 0.2, 20.0, 48.0), 48.0, 24.0),
    "amplitudes 5, 1, 8 mm": (lambda _: stairs(5e-3, 1.0, (1.0, 0.2, 1.6) * 3, 6.0), 54.0, 18.0),
    "stops": (lambda _: stops(SineMotion(5e-3, 1.0), 8.0, 4.0, 3), 36.0, 0.0),
}
"""Motions with their duration [s], and the time [s] by which every part of them has occurred."""


def _healthy(job: tuple[str, str, str], seed: int) -> tuple[float, float, Stretch]:
    """Time asked and valid [s], and the time of wrong but valid force."""
    programme, damper, law = job
    motion, duration, known_from = PROGRAMMES[programme]
    settings = TrialSettings(seed, engine=EngineSettings().for_law(law))
    result = StreamTrial(DAMPERS[damper], motion(seed), 1.2, settings=settings).run(duration)
    # If nothing was ever valid, all of the time counts as a failure.
    begin = max(float(result.time[np.argmax(result.valid)]), known_from)
    asked = (result.time >= begin) & ~at_rest(result)
    times = [
        float(np.count_nonzero(mask)) * result.period for mask in (asked, asked & result.valid)
    ]
    return times[0], times[1], result.wrong_valid()


def healthy_figures(
    programmes: Sequence[str] = tuple(PROGRAMMES),
    dampers: Sequence[str] = tuple(DAMPERS),
    seed: int = 0,
) -> Measured:
    """Run these programmes with these dampers, once for each law."""
    jobs = list(product(programmes, dampers, HEALTHY_LAWS))
    found = dict(zip(jobs, in_processes(_healthy, jobs, repeat(seed)), strict=True))
    shares = []
    for law in HEALTHY_LAWS:
        of_law = [found[job] for job in jobs if job[2] == law]
        shares.append(100.0 * sum(each[1] for each in of_law) / sum(each[0] for each in of_law))
    names = {job: ", ".join(job) for job in jobs}
    least = sorted(jobs, key=lambda job: found[job][1] / max(found[job][0], 1e-9))
    wrong = sorted(((found[job][2], names[job]) for job in jobs), key=lambda each: -each[0].total)
    return {
        "healthy_valid_percent": (
            shares,
            f"{len(found)} streams. Least: "
            + "; ".join(f"{names[j]}: {found[j][1]:.1f} of {found[j][0]:.1f} s" for j in least[:5]),
        ),
        "healthy_wrong_valid_s": (
            sum(each.total for each, _ in wrong),
            "Most: "
            + "; ".join(f"{n}: {w.total:.2f} s, up to {w.worst:.0%}" for w, n in wrong[:5]),
        ),
    }
