"""Validity and acceptance for dampers of foreign laws, identified and predicted online.

The benchmark measures wrong force that is called valid, correct force that is refused, and accepted
sets that are worse than their predecessors.

    python -m benchmarks.foreign_dampers           all combinations, with a line each
    python -m benchmarks.foreign_dampers --quick   every fifth combination
    python -m benchmarks.foreign_dampers 17 42     the combinations 17 and 42

Every law of :data:`~benchmarks.foreign_laws.LAWS` is combined with every motion. A seed distributes
currents, sensors, streams, faults, sizes and warming evenly over the combinations.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np

from benchmarks.figure import PROCESSES, Measured, in_processes, parts, table
from benchmarks.foreign_laws import LAWS, ForeignDamper
from benchmarks.other_dampers import chirp, random_motion, stairs
from benchmarks.stream_trial import (
    WRONG,
    StreamTrial,
    TrialResult,
    TrialSettings,
    WorseSet,
    at_rest,
    worse_sets,
)
from mr_damper_ros.control.linear_plant import IsoRoad, QuarterCar
from mr_damper_ros.emulation.emulator import CurrentSchedule, ThermalModel
from mr_damper_ros.emulation.faults import faults_of
from mr_damper_ros.emulation.motions import Excitation, SampledMotion, SineMotion
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.validity import DoubtKind
from studies.control.ground_motion import Shaking

DURATION, SLOW_DURATION = 24.0, 40.0
"""Duration of a trial [s], and of a trial with a slow motion [s]."""

BEGIN, END = 12.0, 15.0
"""Times at which a fault begins and is repaired [s]."""

GOOD = 0.25
"""Largest NRMSE of a good set against the true force."""

FOLLOWING = 4.0
"""Duration [s] of the comparison of two sets, starting when the new one takes effect."""

_OF_A_SET = 3.0
"""Duration [s] of the samples behind a set, which end when it takes effect."""

_FINE = 5e-3
_HIGHEST_CURRENT = 1.5


# -- motions ---------------------------------------------------------------------------------------


def _car_travel(seed: int) -> Excitation:
    """Suspension stroke of a quarter car with a passive damper on a road of class B."""
    car = QuarterCar()
    # The damper's force opposes the travel: F = c v.
    plant = car.plant
    dynamics = plant.dynamics + 1200.0 * np.outer(plant.by_force, plant.velocity)
    grid = _FINE * np.arange(round(DURATION / _FINE) + 1, dtype=np.float64)
    forcing = np.outer(IsoRoad("B", 15.0, seed).at(grid), car.plant.by_input)
    states = _simulated(dynamics, forcing, _FINE)
    return SampledMotion(_from_rest(states @ car.plant.displacement, 0.015, _FINE), _FINE)


def _earthquakes(seed: int) -> Excitation:
    """Storey drift of a building at 1.4 Hz under a series of earthquakes."""
    rate = 2.0 * math.pi * 1.4
    dynamics = np.array([[0.0, 1.0], [-(rate**2), -0.5 * rate]])
    drifts, every = [], _FINE
    for place in range(3):
        peak = (0.012, 0.006, 0.009)[place]
        ground = Shaking("some", 0.5, 2.0, 0.4, 1.5, 3.0, 1.8, seed=10 * seed + place).motion()
        every = ground.every
        states = _simulated(dynamics, np.outer(-ground.acceleration, [0.0, 1.0]), every)
        drifts.append(_from_rest(states[:, 0], peak, every))
    return SampledMotion(np.concatenate(drifts), every)


def _simulated(dynamics: Array, forcing: Array, period: float) -> Array:
    """States (n, m) from rest, by the trapezoidal rule; ``forcing`` has shape (n, m)."""
    half, unit = 0.5 * period * dynamics, np.eye(len(dynamics))
    step = np.linalg.solve(unit - half, unit + half)
    enters = np.linalg.inv(unit - half) * period
    states = np.zeros(forcing.shape)
    for place in range(1, len(forcing)):
        mean = 0.5 * (forcing[place - 1] + forcing[place])
        states[place] = step @ states[place - 1] + enters @ mean
    return states


def _from_rest(displacement: Array, peak: float, period: float) -> Array:
    """The motion scaled to ``peak`` [m], with half a second of smooth growth and fading."""
    place = period * np.arange(displacement.size)
    ramp = np.clip(np.minimum(place, place[-1] - place) / 0.5, 0.0, 1.0)
    factor = peak / float(np.max(np.abs(displacement)))
    return np.asarray(factor * displacement * np.sin(0.5 * np.pi * ramp) ** 2)


def _sine(amplitude: float, frequency: float, _: int) -> Excitation:
    return SineMotion(amplitude, frequency)


def _slow_sine(seed: int) -> Excitation:
    """At 0.05, 0.1 or 0.2 Hz."""
    return SineMotion(0.015, (0.05, 0.1, 0.2)[seed % 3])


_SLOW = "sine 0.05-0.2 Hz"

MOTIONS: dict[str, Callable[[int], Excitation]] = {
    _SLOW: _slow_sine,
    "sine 0.4 Hz": partial(_sine, 0.011, 0.4),
    "sine 2 Hz": partial(_sine, 0.006, 2.0),
    "sine 10 Hz": partial(_sine, 0.0015, 10.0),
    "chirp 0.3-8 Hz": lambda _: chirp(0.12, 0.009, 0.3, 8.0, DURATION),
    "amplitudes 4, 1, 8 mm": lambda _: stairs(4e-3, 1.5, (1.0, 0.25, 2.0) * 2, 5.0),
    "random 0.2-3 Hz": lambda seed: random_motion(4e-3, 0.2, 3.0, DURATION, seed),
    "random 0.5-8 Hz": lambda seed: random_motion(2e-3, 0.5, 8.0, DURATION, seed),
    "earthquakes": _earthquakes,
    "quarter car": _car_travel,
}
"""Functions by name that create a motion from a seed."""


# -- currents --------------------------------------------------------------------------------------


def _switched(longest: float, seed: int) -> CurrentSchedule:
    """Random levels, each for 0.2 s to ``longest`` [s]."""
    rng = np.random.default_rng(seed)
    times = np.concatenate([[0.0], np.cumsum(rng.uniform(0.2, longest, 400))])
    levels = rng.uniform(0.0, _HIGHEST_CURRENT, times.size)
    return CurrentSchedule(times.tolist(), levels.tolist())


def _stepped(seed: int) -> CurrentSchedule:
    """Four levels in a random order, each for 4 s."""
    rng = np.random.default_rng(seed)
    levels = np.concatenate([rng.permutation([0.0, 0.4, 0.9, 1.5]) for _ in range(6)])
    return CurrentSchedule((4.0 * np.arange(levels.size)).tolist(), levels.tolist())


def _wandering(seed: int) -> CurrentSchedule:
    """A random current with a correlation time of 0.5 s, set every 50 ms."""
    rng = np.random.default_rng(seed)
    kept, value, levels = math.exp(-0.05 / 0.5), 0.0, []
    for draw in rng.standard_normal(1200):
        value = kept * value + math.sqrt(1.0 - kept**2) * draw
        levels.append(min(max(0.7 + 0.4 * value, 0.0), _HIGHEST_CURRENT))
    return CurrentSchedule((0.05 * np.arange(len(levels))).tolist(), levels)


def _commanded(on: Callable[[Array, Array], Array], motion: Excitation) -> CurrentSchedule:
    """The current of a controller that uses displacement and velocity, every 10 ms."""
    grid = 0.01 * np.arange(round(SLOW_DURATION / 0.01), dtype=np.float64)
    found = motion.at(grid)
    levels = on(found.displacement - motion.centre, found.velocity)
    changed = np.concatenate([[True], np.diff(levels) != 0.0])
    return CurrentSchedule(grid[changed].tolist(), levels[changed].tolist())


def _bang_bang(displacement: Array, velocity: Array) -> Array:
    """Current on while the damper moves away from its centre."""
    return np.asarray(_HIGHEST_CURRENT * (displacement * velocity > 0.0))


def _skyhook(displacement: Array, velocity: Array) -> Array:
    """Current of a skyhook controller for a body that follows the slow part of the motion."""
    body = np.zeros(velocity.size)
    for place in range(1, body.size):
        body[place] = body[place - 1] + 0.01 / 0.15 * (velocity[place - 1] - body[place - 1])
    wanted = body / max(float(np.std(velocity)), 1e-6)
    level = np.where(wanted * velocity > 0.0, 0.7 * np.abs(wanted), 0.0)
    return np.asarray(np.round(np.minimum(level, _HIGHEST_CURRENT), 2))


CURRENTS: dict[str, Callable[[Excitation, int], CurrentSchedule]] = {
    "0.8 A": lambda _, __: CurrentSchedule.constant(0.8),
    "steps": lambda _, seed: _stepped(seed),
    "switched 0.2-1 s": lambda _, seed: _switched(1.0, seed),
    "bang-bang": lambda motion, _: _commanded(_bang_bang, motion),
    "skyhook": lambda motion, _: _commanded(_skyhook, motion),
    "wandering": lambda _, seed: _wandering(seed),
}
"""Functions by name that create a current schedule from a motion and a seed."""


# -- instruments, streams, faults ------------------------------------------------------------------


@dataclass(frozen=True)
class Sensors:
    """Noise of displacement [m] and force (relative to the size of the damper), faults as text."""

    displacement_noise: float = 1e-6
    force_noise: float = 0.005
    faults: str = ""


SENSORS = {
    "quiet": Sensors(),
    "noisy": Sensors(1e-5, 0.02),
    "coarse": Sensors(1e-6, 0.003, "force_coarse:8 displacement_coarse:5e-6"),
    "force 2 ms late": Sensors(faults="force_delay:0.002"),
    "jitter": Sensors(2e-6, 0.008, "stamp_jitter:0.4"),
}

BLOCKS = (1, 10, 100)

FAULTS = (
    # As many without any.
    *("",) * 11,
    *("force_spikes:4000", "force_stuck", "force_dropouts:3", "displacement_dropouts:3"),
    *("lost_blocks:0.05", "reordered_blocks:0.05", "current_missing", "coil_factor:0"),
    *("force_loss:0.5", "amplitude:0.3", "wear:0.7"),
)
"""Faults that last from :data:`BEGIN` to :data:`END`."""

_OF_THE_DAMPER = ("coil_factor", "force_loss", "wear")
"""Faults that produce the signals of a different damper."""


@dataclass(frozen=True)
class Combination:
    """One combination: names from the tables of this module, and the ``size`` of the damper [1].

    ``capacity`` [J/K] is the heat capacity of the damper; infinite if it does not heat.
    """

    number: int
    law: str
    motion: str
    current: str
    sensors: str
    block: int
    fault: str
    size: float
    capacity: float

    @property
    def changes_damper(self) -> bool:
        """Whether the fault gives the signals of a different damper."""
        return self.fault.partition(":")[0] in _OF_THE_DAMPER

    @property
    def name(self) -> str:
        """The combination in words."""
        warm = "" if math.isinf(self.capacity) else ", warming"
        fault = f", {self.fault}" if self.fault else ""
        return (
            f"{self.number}: {self.law} x{self.size:g}{warm}, {self.motion}, {self.current}, "
            f"{self.sensors}, blocks of {self.block}{fault}"
        )


def _combinations() -> tuple[Combination, ...]:
    rng = np.random.default_rng(20)
    pairs = list(product(MOTIONS, LAWS))  # every fifth has all laws

    def dealt(values: Sequence[object]) -> list[int]:
        return rng.permutation(np.arange(len(pairs)) % len(values)).tolist()

    sizes, capacities = (0.3, 0.7, 1.0, 1.5, 2.5), (math.inf, 80.0)
    columns = [
        [values[place] for place in dealt(values)]
        for values in (tuple(CURRENTS), tuple(SENSORS), BLOCKS, FAULTS, sizes, capacities)
    ]
    return tuple(
        Combination(number, law, motion, *entries)  # type: ignore[arg-type]
        for number, ((motion, law), *entries) in enumerate(zip(pairs, *columns, strict=True))
    )


COMBINATIONS = _combinations()
"""All of them."""


# -- results of the combinations -------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """Result of a combination.

    ``wrong_valid`` [s] is the total time of wrong but valid force, ``longest`` [s] its longest
    period and ``worst`` the largest error in it over the peak force. ``moving`` [s] is the time in
    motion after the first identified set. ``valid``, ``right`` and ``refused`` are the fractions of
    this time with valid force, correct force, and correct force that was refused [1].
    ``refused_for`` gives the seconds of refused correct force by DoubtKind. ``confirmed`` is the
    fraction of windows whose fit was accepted or confirmed the set in use.
    """

    combination: Combination
    wrong_valid: float
    longest: float
    worst: float
    moving: float
    valid: float
    right: float
    refused: float
    refused_for: dict[str, float]
    confirmed: float
    worse_sets: tuple[WorseSet, ...]
    sets: int
    seconds: float

    @property
    def told(self) -> str:
        """One line of text."""
        worse = "".join(
            f" {s.set_id}@{s.time:.1f}: {s.before:.0%}->{s.after:.0%}" for s in self.worse_sets
        )
        why = " ".join(f"{kind} {time:.1f}" for kind, time in self.refused_for.items())
        return (
            f"{self.combination.name}: wrong valid {self.wrong_valid:.2f} s (longest "
            f"{self.longest:.2f}, up to {self.worst:.0%}); valid {self.valid:.0%}, right "
            f"{self.right:.0%}, right refused {self.refused:.0%} ({why}); windows confirmed "
            f"{self.confirmed:.0%}; {self.sets} sets, worse:{worse or ' none'} "
            f"[{self.seconds:.0f} s]"
        )


def trial_of(given: Combination) -> tuple[StreamTrial, float]:
    """The trial of a combination before its start, and its duration [s]."""
    motion = MOTIONS[given.motion](given.number)
    sensors = SENSORS[given.sensors]
    faults = [f"{text}@0" for text in sensors.faults.split()]
    if given.fault:
        faults.append(f"{given.fault}@{BEGIN:g}-{END:g}")
    settings = TrialSettings(
        seed=given.number,
        block_size=given.block,
        force_noise=1000.0 * given.size * sensors.force_noise,
        displacement_noise=sensors.displacement_noise,
    )
    thermal = None
    if math.isfinite(given.capacity):
        # A large damper has more to heat.
        thermal = ThermalModel(initial=28.0, capacity=given.capacity * given.size, conductance=0.5)
    trial = StreamTrial(
        ForeignDamper(LAWS[given.law](given.size)),
        motion,
        CURRENTS[given.current](motion, given.number),
        faults=faults_of(faults, given.number),
        settings=settings,
        thermal=thermal,
    )
    return trial, SLOW_DURATION if given.motion == _SLOW else DURATION


def run(given: Combination) -> Outcome:
    """Run a combination."""
    began = time.monotonic()
    trial, duration = trial_of(given)
    return outcome_of(given, trial.run(duration), time.monotonic() - began)


def outcome_of(given: Combination, result: TrialResult, seconds: float = 0.0) -> Outcome:
    """Result of a finished trial of the combination.

    Sets are not compared if the damper itself changes during their window or the time after it.
    """
    changes = (BEGIN, END) if given.changes_damper else ()
    worse = [
        each
        for each in worse_sets(result, [(0.0, FOLLOWING)], GOOD)
        if not any(each.time - _OF_A_SET < edge < each.time + FOLLOWING for edge in changes)
    ]
    wrong = result.wrong_valid()
    identified = [taken.time for taken in result.sets[1:]]
    asked = (result.time >= (identified[0] if identified else 0.0)) & ~at_rest(result)
    right = asked & (result.error <= WRONG)
    refused = right & ~result.valid
    moving = max(int(np.count_nonzero(asked)), 1)
    kinds = np.bincount(result.doubts[refused & (result.doubts >= 0)], minlength=1)
    windows = [
        report.confirms for report in result.reports if report.window_start_ns < report.stamp_ns
    ]
    return Outcome(
        given,
        wrong.total,
        wrong.longest,
        wrong.worst,
        moving * result.period,
        float(np.count_nonzero(asked & result.valid)) / moving,
        float(np.count_nonzero(right)) / moving,
        # Nothing identified: all of it counts against it.
        float(np.count_nonzero(refused)) / moving if identified else 1.0,
        {
            DoubtKind(kind).name: float(kinds[kind]) * result.period
            for kind in np.argsort(-kinds)
            if kinds[kind]
        },
        float(np.mean(windows)) if windows else 0.0,
        tuple(worse),
        len(identified),
        seconds,
    )


def figures(every: int = 1) -> Measured:
    """Run all combinations, or one in ``every``."""
    return figures_of(in_processes(run, COMBINATIONS[::every]))


def figures_of(outcomes: Sequence[Outcome]) -> Measured:
    """Figures computed from the results of the combinations."""
    wrong = np.array([outcome.wrong_valid for outcome in outcomes])
    refused = 100.0 * np.array([outcome.refused for outcome in outcomes])
    worse = [(outcome, each) for outcome in outcomes for each in outcome.worse_sets]
    causes: Counter[str] = Counter()
    for outcome in outcomes:
        causes.update(outcome.refused_for)
    most = sorted(outcomes, key=lambda outcome: -outcome.wrong_valid)
    return {
        "foreign_wrong_valid_s": (
            [
                float(np.median(wrong)),
                float(np.quantile(wrong, 0.95)),
                max(outcome.longest for outcome in outcomes),
            ],
            f"{len(outcomes)} combinations. Most: "
            + "; ".join(f"{o.combination.name} ({o.wrong_valid:.2f} s)" for o in most[:3]),
        ),
        "foreign_right_refused_percent": (
            [float(np.median(refused)), float(np.quantile(refused, 0.9))],
            "By cause, in all: "
            + ", ".join(f"{kind} {seconds:.0f} s" for kind, seconds in causes.most_common())
            + f". Valid for less than 2 % of that time: {sum(o.valid < 0.02 for o in outcomes)}.",
        ),
        "foreign_worse_sets": (
            float(len(worse)),
            f"Of {sum(outcome.sets for outcome in outcomes)}. "
            + "; ".join(
                f"{o.combination.number}: {each.set_id} {each.before:.0%} to {each.after:.0%}"
                for o, each in worse
            ),
        ),
    }


SIZES = (1, 10, 100)
"""Block sizes that must give the same validity for the same stream."""


def block_size_figures(duration: float = 20.0, streams: int = 4) -> Measured:
    """Fraction of the time in motion with valid force, for several motions and block sizes.

    One combination of each motion runs without its faults.
    """
    motions = ("sine 0.4 Hz", "sine 2 Hz", "random 0.2-3 Hz", "quarter car")
    spreads, notes = [], []
    for place, motion in enumerate(motions[:streams]):
        first = next(each for each in COMBINATIONS[place:] if each.motion == motion)
        shares = []
        for size in SIZES:
            case = replace(first, fault="", sensors="noisy", block=size)
            result = trial_of(case)[0].run(duration)
            asked = (result.time >= result.sets[1].time) & ~at_rest(result)
            shares.append(100.0 * float(np.mean(result.valid[asked])))
        spreads.append(max(shares) - min(shares))
        told = ", ".join(f"{share:.1f}" for share in shares)
        notes.append(f"{first.law}, {motion}, {first.current}: {told}")
    return {"block_size_valid_spread": (max(spreads), "; ".join(notes))}


def _told(given: Combination) -> Outcome:
    outcome = run(given)
    print(outcome.told, flush=True)
    return outcome


def main() -> int:
    """Run the program; returns the exit code."""
    parser = argparse.ArgumentParser(prog="foreign_dampers", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="every fifth combination")
    parser.add_argument("--processes", type=int, default=PROCESSES)
    parser.add_argument("numbers", type=int, nargs="*", help="only these combinations")
    options = parser.parse_args()
    chosen: Sequence[Combination] = COMBINATIONS[:: 5 if options.quick else 1]
    if options.numbers:
        chosen = [COMBINATIONS[number] for number in options.numbers]
    began = time.monotonic()
    found = in_processes(_told, chosen, options.processes)
    print(table(parts("bench")["foreign_dampers"].figures_of(figures_of(found))))
    print(f"{len(found)} combinations, {time.monotonic() - began:.0f} s", file=sys.stderr)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
