"""Validity and acceptance for dampers of foreign laws, identified and predicted online.

The benchmark measures wrong force that is called valid, correct force that is refused, and accepted
sets that are worse than their predecessors. Every foreign law is combined with every motion. A seed
distributes currents, sensors, streams, faults, sizes and warming evenly over the combinations.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from benchmarks.dampers import LAWS, ForeignDamper
from benchmarks.figure import Measured, in_processes, some_of
from benchmarks.motions import CURRENTS, DURATION, MOTIONS, SLOW, SLOW_DURATION
from benchmarks.streams import (
    StreamTrial,
    TrialResult,
    TrialSettings,
    WorseSet,
    at_rest,
    worse_sets,
)
from mr_damper_ros.emulation.emulator import ThermalModel
from mr_damper_ros.emulation.faults import faults_of
from mr_damper_ros.tracking.validity import DoubtKind

BEGIN, END = 12.0, 15.0
"""Times at which a fault begins and is repaired [s]."""

GOOD = 0.25
"""Largest NRMSE of a good set against the true force."""

FOLLOWING = 4.0
"""Duration [s] of the comparison of two sets, starting when the new one takes effect."""

_OF_A_SET = 3.0
"""Duration [s] of the samples behind a set, which end when it takes effect."""

SENSORS = {
    "quiet": (1e-6, 0.005, ""),
    "noisy": (1e-5, 0.02, ""),
    "coarse": (1e-6, 0.003, "force_coarse:8 displacement_coarse:5e-6"),
    "force 2 ms late": (1e-6, 0.005, "force_delay:0.002"),
    "jitter": (2e-6, 0.008, "stamp_jitter:0.4"),
}
"""Noise of displacement [m] and of force (relative to the size of the damper), and faults."""

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
    """One combination: names from the tables, and the ``size`` of the damper [1].

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
    def name(self) -> str:
        """The combination in words."""
        warm = "" if math.isinf(self.capacity) else ", warming"
        fault = f", {self.fault}" if self.fault else ""
        return (
            f"{self.number}: {self.law} x{self.size:g}{warm}, {self.motion}, {self.current}, "
            f"{self.sensors}, blocks of {self.block}{fault}"
        )

    def run(self, duration: float = math.inf) -> TrialResult:
        """Run the trial of the combination, for at most ``duration`` [s]."""
        motion = MOTIONS[self.motion](self.number)
        displacement_noise, force_noise, of_sensors = SENSORS[self.sensors]
        faults = [f"{text}@0" for text in of_sensors.split()]
        if self.fault:
            faults.append(f"{self.fault}@{BEGIN:g}-{END:g}")
        thermal = None
        if math.isfinite(self.capacity):
            # A large damper has more to heat.
            thermal = ThermalModel(heat_capacity=self.capacity * self.size)
        trial = StreamTrial(
            ForeignDamper(self.law, self.size),
            motion,
            CURRENTS[self.current](motion, self.number),
            faults=faults_of(faults, self.number),
            settings=TrialSettings(
                self.number, self.block, 1000.0 * self.size * force_noise, displacement_noise
            ),
            thermal=thermal,
        )
        return trial.run(min(duration, SLOW_DURATION if self.motion == SLOW else DURATION))


def combinations(seed: int = 0) -> tuple[Combination, ...]:
    """All combinations; their numbers, which seed motions, noise and faults, depend on the seed."""
    rng = np.random.default_rng(20 + seed)
    pairs = list(product(MOTIONS, LAWS))  # every fifth has all laws
    sizes, capacities = (0.3, 0.7, 1.0, 1.5, 2.5), (math.inf, 80.0)
    columns = [
        [values[place] for place in rng.permutation(np.arange(len(pairs)) % len(values))]
        for values in (tuple(CURRENTS), tuple(SENSORS), BLOCKS, FAULTS, sizes, capacities)
    ]
    return tuple(
        Combination(number, law, motion, *entries)  # type: ignore[arg-type]
        for number, ((motion, law), *entries) in enumerate(
            zip(pairs, *columns, strict=True), start=seed * len(pairs)
        )
    )


@dataclass(frozen=True)
class Outcome:
    """Result of a combination.

    ``wrong_valid`` [s] is the total time of wrong but valid force, and ``longest`` [s] its longest
    period. ``valid`` and ``refused`` are the fractions of the time in motion after the first
    identified set with valid force, and with correct force that was refused [1]. ``refused_for``
    gives the seconds of refused correct force by DoubtKind; ``sets`` counts the identified sets.
    """

    combination: Combination
    wrong_valid: float
    longest: float
    valid: float
    refused: float
    refused_for: dict[str, float]
    worse_sets: Sequence[WorseSet]
    sets: int


def asked(result: TrialResult) -> np.ndarray:
    """Mask (n,) of the samples in motion after the first identified set."""
    begin = result.sets[1].time if len(result.sets) > 1 else 0.0
    return np.asarray((result.time >= begin) & ~at_rest(result))


def run(given: Combination) -> Outcome:
    """Run a combination.

    Sets are not compared if the damper itself changes during their window or the time after it.
    """
    result = given.run()
    changes = (BEGIN, END) if given.fault.partition(":")[0] in _OF_THE_DAMPER else ()
    worse = [
        each
        for each in worse_sets(result, [(0.0, FOLLOWING)], GOOD)
        if not any(each.time - _OF_A_SET < edge < each.time + FOLLOWING for edge in changes)
    ]
    wrong, moving = result.wrong_valid(), asked(result)
    refused = moving & result.right & ~result.valid
    kinds = np.bincount(result.doubts[refused & (result.doubts >= 0)], minlength=1)
    count, sets = max(int(np.count_nonzero(moving)), 1), len(result.sets) - 1
    return Outcome(
        given,
        wrong.total,
        wrong.longest,
        float(np.count_nonzero(moving & result.valid)) / count,
        # Nothing identified: all of it counts against it.
        float(np.count_nonzero(refused)) / count if sets else 1.0,
        {
            DoubtKind(kind).name: float(kinds[kind]) * result.period
            for kind in np.argsort(-kinds)
            if kinds[kind]
        },
        worse,
        sets,
    )


def figures(every: int = 1, seed: int = 0) -> Measured:
    """Run all combinations, or one in ``every``."""
    outcomes = in_processes(run, some_of(combinations(seed), every, seed))
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


def block_size_figures(duration: float = 20.0, streams: int = 4, seed: int = 0) -> Measured:
    """Fraction of the time in motion with valid force, for several motions and block sizes.

    One combination of each motion runs without its faults.
    """
    motions = ("sine 0.4 Hz", "sine 2 Hz", "random 0.2-3 Hz", "quarter car")
    spreads, notes = [], []
    for place, motion in enumerate(motions[:streams]):
        first = next(each for each in combinations(seed)[place:] if each.motion == motion)
        shares = []
        for size in BLOCKS:
            result = replace(first, fault="", sensors="noisy", block=size).run(duration)
            shares.append(100.0 * float(np.mean(result.valid[asked(result)])))
        spreads.append(max(shares) - min(shares))
        told = ", ".join(f"{share:.1f}" for share in shares)
        notes.append(f"{first.law}, {motion}, {first.current}: {told}")
    return {"block_size_valid_spread": (max(spreads), "; ".join(notes))}
