"""Machine time until the force is known to a given accuracy: planned runs against random runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from benchmarks.dampers import LAWS, SIXTEEN, foreign_force
from benchmarks.figure import Measured
from mr_damper_ros.campaign.course import planned
from mr_damper_ros.emulation.emulator import (
    CurrentSchedule,
    EmulatedDamper,
    EmulatedRig,
    RigSettings,
)
from mr_damper_ros.estimation.experiment_design import (
    Cycles,
    ForceGoal,
    MachineLimits,
    Plan,
    PlannedRun,
    PlanState,
    PointErrors,
    RunPlanner,
    first_run,
)
from mr_damper_ros.kinematics.periodic_motion import PHASES, MotionKind
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet
from mr_damper_ros.models.plausibility import check_plausible
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording
from studies.recordings import rms

_LAW = MODELS["sigmoid"]

_SCALES, _SHAPES = 0.3, 0.2
"""Standard deviations of the logarithms of scale and shape parameters."""


class DamperKind(NamedTuple):
    """Mean parameters (16,) of a kind of damper, and the relevant ranges [m/s] and [A]."""

    centre: Array
    peak_velocity: tuple[float, float]
    current: tuple[float, float]


KINDS = (
    # Forces, speeds and currents of the thesis' damper; all laws show within the range.
    DamperKind(SIXTEEN.values, (0.02, 0.2), (0.0, 1.5)),
    # Identified by this package from the sinusoid records of a commercial damper in a press.
    DamperKind(
        np.array(
            [
                *(66.55, -0.4804, 0.492, 663.6, 1.161, 3.238, 1.45, -13.86),
                *(77.78, 2.138, 2.31, 10.68, 2.022, -0.07457, -0.01317, -0.01237),
            ]
        ),
        (0.015, 0.063),
        (0.0, 1.0),
    ),
)


def random_damper(kind: DamperKind, seed: int) -> Array:
    """Parameters (16,) of the damper of this seed."""
    rng = np.random.default_rng(seed)
    spread = np.array(
        [_SCALES if name in _LAW.scale_names else _SHAPES for name in _LAW.parameter_names]
    )
    while True:
        values = kind.centre * np.exp(spread * rng.standard_normal(spread.size))
        try:
            check_plausible(
                ParameterSet(
                    values, peak_velocity_range=kind.peak_velocity, current_range=kind.current
                )
            )
        except ParameterError:
            continue
        return np.asarray(values)


_ERROR, _NOISE = 0.01, 0.02
"""Accuracy and noise as a fraction of the root mean square force over the range of the goal."""

_DURATION = 4.0
_AMPLITUDE = 0.01
_HEADROOM = 1.25
"""Force limit of the machine, as a fraction of the largest force of the damper within the goal."""

_MOST_RUNS = 25
"""Largest number of runs of a campaign; a campaign that needs more counts as infinite."""


class _Reached(NamedTuple):
    """``runs`` until the goal was claimed and truly met (or infinity), and the first claim.

    The claim has the ``claimed`` and the ``true`` worst error, and the ``bound`` that was claimed
    with 95 % confidence.
    """

    runs: float
    claimed: float = math.nan
    true: float = math.nan
    bound: float = math.nan


class _RandomPlanner(RunPlanner):
    """Chooses runs at random: a sine at one current within the goal, as in a list of conditions.

    All these runs are within the limits of the machine, which a plan must find out first.
    """

    def __init__(self, goal: ForceGoal, limits: MachineLimits, seed: int) -> None:
        super().__init__(_LAW, goal, replace(limits, motions=(MotionKind.SINE,), steps=False))
        self._rng = np.random.default_rng((seed, 1))

    def draw(self) -> PlannedRun:
        """One of the list."""
        return self.candidates[int(self._rng.integers(len(self.candidates)))]

    def plan_on(
        self, windows: Sequence[Window], parameters: Array, observable: np.ndarray, now: PointErrors
    ) -> Plan:
        return Plan(PlanState.RUN, now, self.draw())


class _Machine:
    """An emulated damper in a machine that checks the limits at every sample."""

    def __init__(self, truth: Array, noise: float, limits: MachineLimits, seed: int) -> None:
        self.inside = True
        self._truth, self._noise, self._limits = truth, noise, limits
        self._seed, self._made = seed, 0

    def perform(self, run: PlannedRun) -> Recording:
        """Make a run; the motion is measured without errors, the force with noise."""
        times = [place * run.stretch for place in range(len(run.currents))]
        rig = EmulatedRig(
            EmulatedDamper(self._truth),
            run.motion,
            CurrentSchedule(times, run.currents),
            settings=RigSettings(force_noise=0.0),
        )
        clean, limits = rig.record(run.duration), self._limits
        self.inside = self.inside and bool(
            np.max(np.abs(clean.displacement)) <= limits.amplitude
            and run.motion.growing_velocity <= limits.peak_velocity
            and np.max(np.abs(clean.force)) <= limits.force
            and np.max(clean.current) <= limits.current
            and run.duration <= limits.duration
        )
        self._made += 1
        rng = np.random.default_rng((self._seed, self._made))
        noise = rng.normal(0.0, self._noise, clean.force.size)
        return replace(clean, force=clean.force + noise, temperature=None)


def trial(kind: DamperKind, seed: int) -> tuple[_Reached, float, bool]:
    """One damper from no knowledge to the goal.

    Returns the result of planned runs, the number of runs chosen at random over that of planned
    ones (1 if both are infinite), and whether no sample of a planned run exceeded the limits.
    """
    truth = random_damper(kind, seed)
    goal = ForceGoal(_ERROR, kind.peak_velocity, kind.current)
    force = Cycles(_LAW, goal.cycles()).force(truth)
    noise = _NOISE * rms(force)
    limits = MachineLimits(
        amplitude=_AMPLITUDE,
        peak_velocity=kind.peak_velocity[1],
        force=_HEADROOM * float(np.max(np.abs(force))),
        current=kind.current[1],
        duration=_DURATION,
        motions=tuple(MotionKind),
    )
    machine, by_chance = (_Machine(truth, noise, limits, seed) for _ in range(2))
    course = _campaign(RunPlanner(_LAW, goal, limits), first_run(goal, limits), machine, truth)
    at_random = _RandomPlanner(goal, limits, seed)
    random = _campaign(at_random, at_random.draw(), by_chance, truth).runs
    return course, 1.0 if random == course.runs else random / course.runs, machine.inside


def _worst_error(cycles: Cycles, values: Array, truth: Array) -> float:
    """Largest error of the force over the peak force (k, phases) [N], worst operating point."""
    missed = np.max(np.abs(cycles.force(values) - truth), axis=1)
    return float(np.max(missed / np.max(np.abs(truth), axis=1)))


def _campaign(planner: RunPlanner, first: PlannedRun, machine: _Machine, truth: Array) -> _Reached:
    """Make runs until the goal is claimed and truly met; after a false claim, the runs continue.

    Each run after the ``first`` is chosen after an identification from all previous runs.
    """
    goal = planner.goal
    cycles = Cycles(planner.model, goal.cycles())
    force = cycles.force(truth)
    run: PlannedRun | None = first
    windows: list[Window] = []
    before: Array | None = None
    first_claim = _Reached(math.inf)
    for count in range(1, _MOST_RUNS + 1):
        assert run is not None
        windows += run.windows(machine.perform(run))
        found, plan = planned(planner, windows, before)
        before = found.values
        error = _worst_error(cycles, before, force)
        if plan.state is PlanState.MET:
            if math.isnan(first_claim.claimed):
                first_claim = _Reached(math.inf, plan.now.worst, error, plan.now.bound)
            if error <= goal.error:
                return first_claim._replace(runs=float(count))
            plan = planner.plan_on(windows, before, found.observable, plan.now)
        run = plan.run
    return first_claim


def figures(dampers: int = 30, seed: int = 0) -> Measured:
    """Measure a number of dampers, half of each kind."""
    each = dampers // len(KINDS)
    trials = [trial(kind, seed * each + place) for kind in KINDS for place in range(each)]
    courses, saved, inside = zip(*trials, strict=True)
    within = sum(course.true <= _ERROR for course in courses)
    true = float(np.median([course.true for course in courses]))
    return {
        "planned_runs": (
            float(np.median([course.runs for course in courses])),
            f"Of {len(trials)}. Where it is claimed first, the true error is {true:.2%} (median) "
            f"and within {_ERROR:.0%} for {within}.",
        ),
        "planned_runs_saved": float(np.median(saved)),
        "planned_runs_inside": float(np.mean(inside)),
        "planned_runs_claim": float(np.median([c.claimed / c.true for c in courses])),
        "planned_runs_bound": float(np.mean([c.true <= c.bound for c in courses])),
    }


# -- foreign laws ----------------------------------------------------------------------------------

_GOAL = ForceGoal(_ERROR, (0.02, 0.2), (0.0, 1.5), amplitude=0.008)
_LIMITS = MachineLimits(0.008, 0.2, 1e5, 1.5, _DURATION)
_RUNS, _STAIRS = 4, 3
"""Number of runs, and the smallest number of currents in each run after the first."""

_RATE, _REST = 1000, 1000
"""Sample rate [Hz], and the samples before a run in which the damper settles to its cycle."""


def _foreign_run(law: str, run: PlannedRun, rng: np.random.Generator) -> Recording:
    """Measurements of the machine for a damper whose law is not in the package."""
    time = np.arange(round(run.duration * _RATE) + _REST) / _RATE
    moved, current = run.motion.at(time), run.current_at(np.maximum(time - _REST / _RATE, 0.0))
    force = foreign_force(law, moved, current, 1.0 / _RATE)[_REST:]
    force = force + rng.normal(0.0, _NOISE * rms(force), force.size)
    return Recording(law, 0, 1.0 / _RATE, moved[0][_REST:], force, current[_REST:])


def _foreign_cycles(law: str) -> Array:
    """Its force (k, phases) [N] over settled cycles at the points of the goal."""
    forces = []
    for speed, current in _GOAL.points:
        omega = speed / _GOAL.amplitude
        steps = math.ceil(2.0 * math.pi / omega * _RATE / PHASES)
        count = PHASES * steps
        phase = 2.0 * math.pi * (np.arange(-2 * count, count) / steps + 0.5) / PHASES
        u, v = _GOAL.amplitude * np.sin(phase), speed * np.cos(phase)
        period = 2.0 * math.pi / omega / count
        force = foreign_force(law, (u, v, -(omega**2) * u), current, period)
        forces.append(force[2 * count :: steps])
    return np.array(forces)


def foreign_figures(laws: int = len(LAWS), seed: int = 0) -> Measured:
    """Compare the true worst error of several foreign laws with the claimed one."""
    planner = RunPlanner(_LAW, _GOAL, _LIMITS)
    cycles = Cycles(_LAW, _GOAL.cycles())
    stairs = [run for run in planner.candidates if len(run.currents) >= _STAIRS]
    ratios = []
    for number, law in enumerate(list(LAWS)[:laws], start=seed * len(LAWS)):
        rng = np.random.default_rng(number)
        chosen = rng.choice(len(stairs), _RUNS - 1, replace=False)
        runs = [first_run(_GOAL, _LIMITS), *(stairs[place] for place in chosen)]
        windows = [w for run in runs for w in run.windows(_foreign_run(law, run, rng))]
        found, plan = planned(planner, windows)
        error = _worst_error(cycles, found.values, _foreign_cycles(law))
        ratios.append(error / plan.now.worst)
    return {
        "foreign_claim": float(np.quantile(ratios, 0.9)),
        "foreign_claim_median": float(np.median(ratios)),
    }
