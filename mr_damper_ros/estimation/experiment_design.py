"""Which run of the rig would determine what is still open: optimal design of experiments.

A run at peak velocity v and current i adds the Fisher information of its samples, which the
Jacobian of the law gives before the run is made. Of all runs within the rig's range, the one is
advised after which the determinant of the information is largest (D-optimality), prior ranges
counted as information: the greatest expected gain of knowledge (Lindley). The law is not linear,
so the gain is averaged over sets that fit the present data equally and differ in what these leave
open. See Chaloner and Verdinelli, "Bayesian experimental design: a review", Statistical Science
10, 1995. One run after another is added until nothing is open.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mr_damper_ros.estimation.covariance import triangular_factor
from mr_damper_ros.estimation.force_knowledge import PHASES, Cycles, open_sets, steady_cycle
from mr_damper_ros.estimation.observability import (
    determined_parameters,
    noise_level,
    operating_points_within,
    parameter_spans,
    varied_parameters,
)
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.misfit import Misfit
from mr_damper_ros.signals.arrays import Array

_SETS = 16
"""So many sets stand for what is open."""

_MOST_RUNS = 4
"""No more runs are advised at once: four currents are what the laws need."""

_SPEEDS = np.geomspace(0.1, 1.0, 6)
_CURRENTS = np.linspace(0.0, 1.0, 9)
"""Candidates, as parts of the largest peak velocity and current."""

_MAJORITY = 0.5
"""A run is said to determine what it determines for more than this part of the sets."""


@dataclass(frozen=True)
class RigRange:
    """What the rig may do: so much ``peak_velocity`` [m/s] and ``current`` [A], and less.

    Runs are advised at its ``amplitude`` [m]. Raises ValueError for values that no rig has.
    """

    amplitude: float
    peak_velocity: float
    current: float

    def __post_init__(self) -> None:
        for name in ("amplitude", "peak_velocity"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(
                    f"the rig's largest {name.replace('_', ' ')} is {getattr(self, name)}: "
                    "it must be positive"
                )
        if not 0.0 <= self.current < math.inf:
            raise ValueError(f"the rig's largest current is {self.current}: give it in ampere")

    @classmethod
    def of_windows(cls, windows: Sequence[Window]) -> RigRange:
        """No more than what was done already."""
        speeds, currents = operating_points_within(windows)
        return cls(
            amplitude=max(window.motion.amplitude for window in windows),
            peak_velocity=max(speeds),
            current=max(map(abs, currents)),
        )


@dataclass(frozen=True)
class ExtraRun:
    """A run that should be made: ``amplitude`` [m], ``frequency`` [Hz], ``current`` [A].

    ``determines``: the parameters that it would determine, after those advised before it.
    ``worst_error``: the largest standard error that would then be left, in spans (see
    :mod:`observability`), 1 where nothing but the plausible range is known.
    """

    amplitude: float
    frequency: float
    current: float
    determines: tuple[str, ...] = ()
    worst_error: float = 1.0

    @property
    def peak_velocity(self) -> float:
        """Largest speed [m/s]."""
        return 2.0 * math.pi * self.frequency * self.amplitude

    @property
    def sentence(self) -> str:
        """The advice in words."""
        gain = f"it would determine {', '.join(self.determines)}"
        if not self.determines:
            gain = "it would determine nothing alone, but the next run needs it"
        return (
            f"run {1e3 * self.amplitude:.3g} mm at {self.frequency:.3g} Hz "
            f"with {self.current:.3g} A: {gain}"
        )


def extra_runs(
    model: Model,
    misfit: Misfit,
    noise: float,
    parameters: Array,
    observable: np.ndarray,
    rig: RigRange,
) -> tuple[ExtraRun, ...]:
    """Runs to make, one after the other; none where all is known or nothing would help.

    ``misfit`` is that of the windows at hand, ``noise`` [N] what a run as long as these would
    leave of the force; ``parameters`` (p,) are the present set, of which ``observable`` (p,) are
    determined.
    """
    names = [name for law in model.shape_groups for name in law]
    known = {n for n, seen in zip(model.parameter_names, observable, strict=True) if seen}
    if set(names) <= known:
        return ()
    # What is common to all runs is not what another run is made for.
    every = [n for n in model.parameter_names if n in names or n in model.scale_names]
    places = model.places(every)
    speeds, currents = operating_points_within(misfit.windows)
    ranges = model.plausible_ranges(
        misfit.windows, max(max(speeds), rig.peak_velocity), max(rig.current, *currents)
    )
    sizes = {name: high - low for name, (low, high) in ranges.items()}
    candidates = _candidates(rig)
    share = misfit.sample_count / len(misfit.windows)
    cycles = Cycles(model, [steady_cycle(c.amplitude, c.frequency, c.current) for c in candidates])
    level = noise_level(misfit, parameters)
    weight = math.sqrt(share / PHASES) / noise
    spans = parameter_spans(model, misfit.jacobian(parameters), parameters, ranges)
    present: list[Array] = []
    added: list[Array] = []
    speed = max(rig.peak_velocity, *(window.operating_point[0] for window in misfit.windows))
    rng = np.random.default_rng(0)
    for values in open_sets(
        model, misfit.windows, parameters, known, (speed, rig.current), rng, _SETS
    ):
        jacobian = _only(misfit.jacobian(values), places) / level
        present.append(triangular_factor(jacobian))
        added.append(_only(cycles.gradient(values), places) / level * weight)
    gains = [np.einsum("cnp,cnq->cpq", a * spans, a * spans) for a in added]
    advised: list[ExtraRun] = []
    while len(advised) < _MOST_RUNS and not set(names) <= known:
        information = [np.eye(parameters.size) + _gram(r * spans) for r in present]
        after = np.array([m + g for m, g in zip(information, gains, strict=True)])
        best = int(np.argmax(np.mean(np.linalg.slogdet(after)[1], axis=0)))
        chosen = candidates[best]
        speeds, currents = [*speeds, chosen.peak_velocity], [*currents, chosen.current]
        varied = varied_parameters(model, speeds, currents) & set(every)
        present = [
            triangular_factor(np.vstack((r, a[best]))) for r, a in zip(present, added, strict=True)
        ]
        votes = [determined_parameters(model, r, varied, sizes) for r in present]
        determined = {n for n in names if np.mean([n in vote for vote in votes]) > _MAJORITY}
        variances = np.diagonal(np.linalg.inv(after[:, best]), axis1=-2, axis2=-1)
        advised.append(
            replace(
                chosen,
                determines=tuple(name for name in names if name in determined - known),
                worst_error=float(np.mean(np.sqrt(variances.max(axis=-1)))),
            )
        )
        known |= determined
    return _without_idle_end(advised)


def _only(jacobian: Array, places: np.ndarray) -> Array:
    """The Jacobian with nothing told of the parameters at other places."""
    result = np.zeros_like(jacobian)
    result[..., places] = jacobian[..., places]
    return result


def _without_idle_end(runs: Sequence[ExtraRun]) -> tuple[ExtraRun, ...]:
    """Runs after which nothing more is determined need not be made."""
    useful = [place for place, run in enumerate(runs) if run.determines]
    return tuple(runs[: useful[-1] + 1]) if useful else ()


def _candidates(rig: RigRange) -> list[ExtraRun]:
    """Runs that the rig can make, in round numbers."""
    amplitude = _round(rig.amplitude)
    top = rig.peak_velocity / (2.0 * math.pi * amplitude)
    frequencies = [_round(top * part) for part in _SPEEDS]
    currents = [_round(rig.current * part) for part in _CURRENTS]
    return [ExtraRun(amplitude, f, i) for f in frequencies for i in dict.fromkeys(currents)]


def _round(value: float) -> float:
    return float(f"{value:.2g}")


def _gram(matrix: Array) -> Array:
    return np.asarray(matrix.T @ matrix)
