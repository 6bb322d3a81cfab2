"""Which run of the test machine comes next, so that the force is soon known well enough.

Of all runs within the limits of the machine, that one is chosen after which the force is expected
to be known best where it is known worst. A run is a sine, a swept sine or random motion, at one
current or at a staircase of currents. All last equally long, so that the fewest runs are the least
time of the machine. The law is not linear, so what a run is worth is averaged over sets that fit
the present data equally and differ in what these leave open; the worst point is softened to a high
norm, since one run alone often does nothing for the very worst.

See Pukelsheim, "Optimal design of experiments", 1993 (G-optimality), and Chaloner and Verdinelli,
"Bayesian experimental design: a review", Statistical Science 10, 1995.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from mr_damper_ros.estimation.force_knowledge import (
    FEW,
    Cycles,
    ForceGoal,
    PointErrors,
    cycle_errors,
    most_probable,
    noise_of,
    open_sets,
    point_errors,
    prior_information,
    relative_gradient,
    repeated_error,
    window_information,
)
from mr_damper_ros.estimation.planned_run import (
    CandidateRuns,
    MachineLimits,
    PlannedRun,
    candidate_runs,
)
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.signals.arrays import Array

_SETS = 6
"""So many sets stand for what is open."""

_STARTS, _FITS = 3, 24
"""From so many others the most probable set is searched too; from more, of few windows: so many
windows are fitted."""

_ROUNDS = 6
_SETTLED = 0.01
"""Rounds in which set and noise are found together, at most, and the fall of the noise (relative)
that is no gain any more."""

_NORM = 8.0
"""Norm over the points that stands for the worst of them."""

_FEW_PHASES = 4
"""Every so many phases of a cycle tell which run is best."""

_FASTER = 5.0
"""The next run is at most so many times as fast as the fastest before."""

_CURRENT_STEP = 0.5
"""The next run goes at most this part of the range beyond the largest current before."""

_MARGIN = 1.1
"""The force of a run, as it is known, may be so many times as large and still be allowed."""

_LOOK_AHEAD = 12
"""Runs that are planned on to tell whether the goal can be met."""


class PlanState(Enum):
    """What there is to do: a run, nothing any more, or nothing that would help."""

    RUN = "run"
    MET = "met"
    OUT_OF_REACH = "out of reach"


@dataclass(frozen=True, eq=False)
class Plan:
    """The next run, if there is one, and how well the force is known now.

    ``now``: the errors at the points of the goal; ``expected``: the worst error [1] after the run;
    ``runs_left``: runs until the goal is met, None where that cannot be told or it cannot be met;
    ``reason``: why it is met or cannot be, in words. A goal out of reach may still have a run that
    helps.
    """

    state: PlanState
    now: PointErrors
    run: PlannedRun | None = None
    expected: float = math.nan
    runs_left: int | None = 0
    reason: str = ""


class RunPlanner:
    """Plans towards a goal within the limits of a machine, for dampers of one model.

    ``candidates`` are the runs that it chooses from.
    """

    def __init__(self, model: Model, goal: ForceGoal, limits: MachineLimits) -> None:
        self.model = model
        self.goal = goal
        self.limits = limits
        self._goal_cycles = Cycles(model, goal.cycles())
        self._top = goal.peak_velocity[1], goal.current[1]
        self.candidates = candidate_runs(goal, limits)
        self._candidates = CandidateRuns(model, self.candidates, limits.sample_rate)

    def shortcoming(self) -> str:
        """Why the goal lies beyond the machine, in words; empty where it does not."""
        goal, limits = self.goal, self.limits
        if goal.peak_velocity[1] > limits.peak_velocity:
            return (
                f"the goal reaches to {goal.peak_velocity[1]:g} m/s and the machine to "
                f"{limits.peak_velocity:g} m/s"
            )
        if goal.current[1] > limits.current:
            return (
                f"the goal reaches to {goal.current[1]:g} A and the supply to {limits.current:g} A"
            )
        return "" if self.candidates else "no run within the limits of the machine holds a cycle"

    def most_probable(self, windows: Sequence[Window], parameters: Array) -> Array:
        """The most probable set (p,), from the one identified.

        It is looked for from a few others, too, of any shape. The noise of each window is found
        with the set: what a wrong one leaves would pass for noise, and the set stay.
        """
        prior = prior_information(self.model, self._goal_cycles, parameters, self.goal)
        rng = np.random.default_rng(len(windows))
        count = max(_STARTS, _FITS // len(windows))
        others = open_sets(self.model, windows, parameters, (), self._top, rng, count)
        few = [window.thinned(FEW) for window in windows]
        first = self._noise(windows, parameters)
        found = [
            self._with_noise(windows, few, first, prior, parameters, start)
            for start in (parameters, *others)
        ]
        _, values, noise = min(found, key=lambda one: one[0])
        # Few samples tell where the best set is, and only all of them how it lies exactly.
        return most_probable(self.model, windows, noise, prior, parameters, values)[0]

    def _with_noise(
        self,
        windows: Sequence[Window],
        few: Sequence[Window],
        noise: Sequence[float],
        prior: Array,
        about: Array,
        values: Array,
    ) -> tuple[float, Array, Sequence[float]]:
        """How much noise is left (a likelihood), and the set (p,) and its noise, from a start."""
        sizes = np.array([window.sample_count for window in windows], dtype=float)
        least = math.inf
        for _ in range(_ROUNDS):
            values, _ = most_probable(self.model, few, noise, prior, about, values)
            noise = self._noise(windows, values)
            left = float(sizes @ np.log(noise)) / float(sizes.sum())
            if left > least - _SETTLED:
                break
            least = left
        return left, values, noise

    def _noise(self, windows: Sequence[Window], parameters: Array) -> list[float]:
        return [noise_of(self.model, window, parameters) for window in windows]

    def errors(self, windows: Sequence[Window], parameters: Array) -> PointErrors:
        """How well the force is known from windows to which ``parameters`` (p,) were fitted."""
        noise = self._noise(windows, parameters)
        return self._errors(parameters, self._information(windows, noise, parameters))

    def knowledge(self, windows: Sequence[Window], parameters: Array) -> PointErrors:
        """As :meth:`errors`; where the goal seems to be met, that is made sure of."""
        now = self.errors(windows, parameters)
        return self._confirmed(now, windows, parameters) if now.worst <= self.goal.error else now

    def next(self, windows: Sequence[Window], parameters: Array, observable: np.ndarray) -> Plan:
        """What to do next; ``observable`` (p,) tells which parameters the windows determine."""
        now = self.knowledge(windows, parameters)
        if now.worst <= self.goal.error:
            return Plan(PlanState.MET, now, reason=f"the goal is met: {now.sentence}")
        return self.plan_on(windows, parameters, observable, now)

    def plan_on(
        self,
        windows: Sequence[Window],
        parameters: Array,
        observable: np.ndarray,
        now: PointErrors,
    ) -> Plan:
        """The plan as :meth:`next` has it, as if the goal were not met; ``now``: what is known."""
        beyond = self.shortcoming()
        if beyond:
            return Plan(PlanState.OUT_OF_REACH, now, runs_left=None, reason=beyond)
        sets = self.possible_sets(windows, parameters, observable)
        allowed = self.allowed(windows, sets)
        if not allowed.any():
            return Plan(
                PlanState.OUT_OF_REACH,
                now,
                runs_left=None,
                reason="every run that would help may leave the limits of force or heat",
            )
        noise = self._noise(windows, parameters)
        present = self._information(windows, noise, parameters)
        sigma = _noise_by_motion(windows, noise)
        scores = np.where(allowed, 0.0, math.inf)
        for values in sets:
            before = present if values is parameters else self._information(windows, noise, values)
            gradient = relative_gradient(self._goal_cycles, values)[:, ::_FEW_PHASES]
            after = before + self._candidates.gains(values, *sigma)[allowed]
            scores[allowed] += np.log(_soft_worst(cycle_errors(gradient, after)))
        place = int(np.argmin(scores))
        best = self.candidates[place]
        left, expected, reached = self._look_ahead(parameters, present, sigma, place)
        # As long as a law is open, what it will cost to know it cannot be told.
        if left is None and len(sets) == 1:
            return Plan(
                PlanState.OUT_OF_REACH,
                now,
                run=best,
                expected=expected,
                runs_left=None,
                reason=f"{_LOOK_AHEAD} more runs would leave an error of {reached:.2%}: allow "
                "longer runs, or a larger error",
            )
        return Plan(PlanState.RUN, now, best, expected, left)

    def _confirmed(
        self, now: PointErrors, windows: Sequence[Window], parameters: Array
    ) -> PointErrors:
        """The errors, the worst no smaller than by identifying again: the goal is met for sure."""
        prior = prior_information(self.model, self._goal_cycles, parameters, self.goal)
        noise = self._noise(windows, parameters)
        again = repeated_error(self.model, windows, noise, prior, parameters, self._goal_cycles)
        larger = max(again / now.worst, 1.0)
        return replace(now, worst=larger * now.worst, bound=larger * now.bound)

    def _errors(self, parameters: Array, information: Array) -> PointErrors:
        gradient = relative_gradient(self._goal_cycles, parameters)
        return point_errors(self.goal, gradient, information)

    def _information(
        self, windows: Sequence[Window], noise: Sequence[float], parameters: Array
    ) -> Array:
        prior = prior_information(self.model, self._goal_cycles, parameters, self.goal)
        return prior + window_information(self.model, windows, noise, parameters)

    def possible_sets(
        self, windows: Sequence[Window], parameters: Array, observable: np.ndarray
    ) -> list[Array]:
        """Sets that may be true: that identified, and others where something is open."""
        names, rng = np.array(self.model.parameter_names), np.random.default_rng(0)
        known = names[observable].tolist()
        others = open_sets(self.model, windows, parameters, known, self._top, rng, _SETS)
        return [parameters, *others]

    def allowed(self, windows: Sequence[Window], sets: Sequence[Array]) -> np.ndarray:
        """Candidates (m,) that stay within the limits whichever set is true, and are no leap."""
        fastest = max(window.motion.peak_velocity.max() for window in windows)
        highest = max(window.current.max() for window in windows)
        low, high = self.goal.current
        top = highest + _CURRENT_STEP * (high - low) + 1e-9
        gentle = [
            run.peak_velocity <= _FASTER * fastest and max(run.currents) <= top
            for run in self.candidates
        ]
        force, heat = self._candidates.demands(sets)
        within = (_MARGIN * force <= self.limits.force) & (_MARGIN * heat <= self.limits.heat)
        return np.asarray(gentle & within)

    def _look_ahead(
        self, parameters: Array, present: Array, sigma: tuple[float, float], first: int
    ) -> tuple[int | None, float, float]:
        """Runs until the goal is met, the worst error after the first, and after the last."""
        gradient = relative_gradient(self._goal_cycles, parameters)
        gains = self._candidates.gains(parameters, *sigma)
        information = present + gains[first]
        expected = worst = point_errors(self.goal, gradient, information).worst
        for count in range(1, _LOOK_AHEAD + 1):
            if worst <= self.goal.error:
                return count, expected, worst
            after = information + gains
            errors = cycle_errors(gradient[:, ::_FEW_PHASES], after)
            information = after[int(np.argmin(_soft_worst(errors)))]
            worst = point_errors(self.goal, gradient, information).worst
        return None, expected, worst


def _noise_by_motion(windows: Sequence[Window], noise: Sequence[float]) -> tuple[float, float]:
    """Noise [N] of a run that is a sine, and of any other, which a law may follow less well."""
    steady = [sigma for w, sigma in zip(windows, noise, strict=True) if w.motion.sine is not None]
    broad = [sigma for w, sigma in zip(windows, noise, strict=True) if w.motion.sine is None]
    return float(np.median(steady or broad)), float(np.median(broad or steady))


def _soft_worst(errors: Array) -> Array:
    """Norm (m,) of errors (m, k) that stands for the worst of them."""
    return np.asarray(np.mean(errors**_NORM, axis=1) ** (1.0 / _NORM))
