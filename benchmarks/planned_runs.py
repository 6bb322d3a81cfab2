"""Machine time from no knowledge to a known force: planned runs against random ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks.figure import Figure
from benchmarks.random_dampers import KINDS, DamperKind, random_damper
from mr_damper_ros.estimation.force_knowledge import Cycles, ForceGoal
from mr_damper_ros.estimation.planned_run import MachineLimits, PlannedRun
from mr_damper_ros.estimation.run_planner import RunPlanner
from mr_damper_ros.interface.force_campaign import ForceCampaign, run_campaign
from mr_damper_ros.models import MODELS
from mr_damper_ros.rig.emulator import ConstantDamper, CurrentSchedule, EmulatedRig, RigSettings
from mr_damper_ros.rig.excitation import SineMotion
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording

_ERROR = 0.01
_NOISE = 0.02
"""Of the force's root mean square over the range of the goal."""

_DURATION = 4.0
_AMPLITUDE = 0.01
_HEADROOM = 1.25
"""The machine's force limit, of the largest force of the damper within the goal."""

_MOST_RANDOM = 100


@dataclass(frozen=True)
class PlannedTrial:
    """What came of one damper.

    ``runs`` until the goal was met, infinite where it was not; ``claimed`` and ``true`` worst error
    at the end; ``inside``: whether no sample left the limits; ``random``: runs in random order,
    judged at the true set.
    """

    kind: str
    runs: float
    claimed: float
    true: float
    inside: bool
    random: float


class _Machine:
    """An emulated damper in a machine that looks at every sample."""

    def __init__(self, truth: Array, noise: float, limits: MachineLimits, seed: int) -> None:
        self.inside = True
        self._truth = truth
        self._noise = noise
        self._limits = limits
        self._seed = seed
        self._made = 0

    def perform(self, run: PlannedRun) -> Recording:
        """Make a run; the force is that of the damper, before it is measured."""
        schedule = CurrentSchedule(
            [place * run.stretch for place in range(len(run.currents))], run.currents
        )
        motion = SineMotion(run.amplitude, run.frequency)
        damper = ConstantDamper(self._truth)
        clean = EmulatedRig(damper, motion, schedule, settings=RigSettings(force_noise=0.0)).record(
            run.duration
        )
        limits = self._limits
        self.inside = self.inside and bool(
            np.max(np.abs(clean.displacement)) <= limits.amplitude
            and run.peak_velocity <= limits.peak_velocity
            and np.max(np.abs(clean.force)) <= limits.force
            and np.max(clean.current) <= limits.current
            and run.duration <= limits.duration
        )
        self._made += 1
        noise = np.random.default_rng((self._seed, self._made)).normal(
            0.0, self._noise, clean.force.size
        )
        return Recording(
            clean.name,
            clean.start_ns,
            clean.period,
            clean.displacement,
            clean.force + noise,
            clean.current,
        )


def trial(kind: DamperKind, seed: int) -> PlannedTrial:
    """One damper from no knowledge to the goal."""
    model = MODELS["sigmoid"]
    truth = random_damper(kind, seed)
    goal = ForceGoal(_ERROR, kind.peak_velocity, kind.current)
    force = Cycles(model, goal.cycles()).force(truth)
    noise = _NOISE * math.sqrt(float(np.mean(force**2)))
    limits = MachineLimits(
        amplitude=_AMPLITUDE,
        peak_velocity=kind.peak_velocity[1],
        force=_HEADROOM * float(np.max(np.abs(force))),
        current=kind.current[1],
        duration=_DURATION,
    )
    machine = _Machine(truth, noise, limits, seed)
    found = run_campaign(goal, limits, machine.perform)
    missed = Cycles(model, goal.cycles()).force(found.parameter_set.values) - force
    true = float(np.max(np.max(np.abs(missed), axis=1) / np.max(np.abs(force), axis=1)))
    return PlannedTrial(
        kind.name,
        _runs_needed(found),
        found.steps[-1].plan.now.worst,
        true,
        machine.inside,
        _random_order(RunPlanner(model, goal, limits), truth, noise, seed),
    )


def _runs_needed(found: ForceCampaign) -> float:
    return float(len(found.steps)) if found.reached else math.inf


def _random_order(planner: RunPlanner, truth: Array, noise: float, seed: int) -> float:
    """Sines at one current in random order until the true set would be known well enough."""
    rng = np.random.default_rng((seed, 1))
    sines = [run for run in planner.candidates if len(run.currents) == 1]
    order = rng.integers(len(sines), size=_MOST_RANDOM)
    return planner.runs_until_known(truth, noise, [sines[place] for place in order])


def measure(seeds: Sequence[int], kinds: Sequence[DamperKind] = KINDS) -> list[PlannedTrial]:
    """A trial of each kind with each seed."""
    return [trial(kind, seed) for kind in kinds for seed in seeds]


def figures(dampers: int = 30) -> list[Figure]:
    """So many dampers, half of each kind."""
    return figures_of(measure(range(dampers // len(KINDS))))


def figures_of(trials: Sequence[PlannedTrial]) -> list[Figure]:
    """The figures of these trials."""
    count = len(trials)
    of = partial(_median, trials)
    runs, ratio = of("runs"), float(np.median([t.random / t.runs for t in trials]))
    missed = [t for t in trials if not t.true <= _ERROR]
    return [
        Figure(
            "planned_runs",
            runs,
            f"Runs of {_DURATION:g} s from no knowledge to a worst relative standard error of the "
            f"force of {_ERROR:.0%}, median of {count} random dampers, noise {_NOISE:.0%}; at the "
            "end the true worst error is "
            f"{of('true'):.2%} (median) and within {_ERROR:.0%} for {count - len(missed)}.",
            (0.0, 12.0),
        ),
        Figure(
            "planned_runs_saved",
            ratio,
            "Runs at one current in random order, judged at the true set, over the planned ones "
            "(median).",
            (3.0, math.inf),
        ),
        Figure(
            "planned_runs_inside",
            float(sum(t.inside for t in trials)),
            f"Dampers of {count} with which no sample of any run left the limits of stroke, "
            "velocity, force, current and duration.",
            (float(count), float(count)),
        ),
        Figure(
            "planned_runs_claim",
            float(np.median([t.claimed / t.true for t in trials])),
            "Claimed worst standard error over the true worst error at the end (median).",
            (0.8, 1.5),
        ),
    ]


def _median(trials: Sequence[PlannedTrial], name: str) -> float:
    return float(np.median([getattr(trial, name) for trial in trials]))
