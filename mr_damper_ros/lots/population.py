"""Variation and outliers of a production lot.

The comparison uses forces at common operating points, not parameters, because undetermined
parameters scatter without meaning.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import compress
from statistics import NormalDist
from typing import Any

import numpy as np

from mr_damper_ros.estimation.experiment_design import Cycles, steady_cycle
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import NORMAL_MEDIAN, Array

LEAST_DAMPERS = 5
"""In lots of fewer dampers, no outliers are flagged."""


@dataclass(frozen=True, eq=False)
class KnownDamper:
    """An identified damper: its set, the covariance (p, p), and the NRMSE of the fit."""

    name: str
    parameter_set: ParameterSet
    covariance: Array
    nrmse: float

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> KnownDamper:
        """The damper described by a document of :func:`identify_group` without a failure."""
        return cls(
            document["damper"],
            ParameterSet.from_yaml(document["set"]),
            np.array(document["covariance"]),
            document["nrmse"],
        )

    def covers(self, peak_velocity: float, current: float) -> bool:
        """Whether the operating point lies in the identified range, to within 2 %."""
        ranges = self.parameter_set.peak_velocity_range, self.parameter_set.current_range
        return all(
            low - 0.02 * abs(high) <= value <= 1.02 * high
            for value, (low, high) in zip((peak_velocity, current), ranges, strict=True)
        )

    def peak_forces(self, points: Sequence[tuple[float, float]]) -> tuple[Array, Array]:
        """Largest force [N] in extension at each point (m/s, A), and its standard error, (k,)."""
        cycles = Cycles(self.parameter_set.law, [_cycle(*point) for point in points])
        values, rows = self.parameter_set.values, np.arange(len(points))
        force = cycles.force(values)
        largest = np.argmax(force, axis=1)
        slope = cycles.gradient(values)[rows, largest]
        errors = np.sqrt(np.einsum("kp,pq,kq->k", slope, self.covariance, slope))
        return force[rows, largest], errors


@lru_cache(maxsize=64)
def _cycle(peak_velocity: float, current: float) -> Window:
    amplitude = 0.01  # [m]; at one peak velocity, the force hardly depends on it
    return steady_cycle(amplitude, peak_velocity / (2.0 * math.pi * amplitude), current)


@dataclass(frozen=True, eq=False)
class Spread:
    """Variation of a quantity over the lot.

    ``label`` is its name, ``unit`` its unit; ``values`` and their standard ``errors`` (n,) are NaN
    for dampers without a value.
    """

    label: str
    unit: str
    values: Array
    errors: Array

    @property
    def known(self) -> Array:
        """The known values."""
        return self.values[np.isfinite(self.values)]

    @property
    def median(self) -> float:
        """Median over the lot; NaN without values."""
        return float(np.median(self.known)) if self.known.size else math.nan

    @property
    def deviation(self) -> float:
        """Robust standard deviation over the lot."""
        if not self.known.size:
            return math.nan
        return float(np.median(np.abs(self.known - self.median))) / NORMAL_MEDIAN

    @property
    def scores(self) -> Array:
        """Deviations from the median in standard deviations (n,), zero without variation."""
        if not self.deviation > 0.0:
            return np.zeros(self.values.size)
        return np.nan_to_num((self.values - self.median) / self.deviation)


@dataclass(frozen=True)
class Outlier:
    """An outlier in a quantity, ``score`` robust standard deviations from the median."""

    damper: str
    quantity: str
    unit: str
    value: float
    median: float
    score: float

    @property
    def sentence(self) -> str:
        """The deviation in words."""
        part = f" ({self.value / self.median - 1.0:+.0%})" if self.median else ""
        return (
            f"{self.damper}: {self.quantity} {self.value:.4g} {self.unit}".rstrip()
            + f", {abs(self.score):.1f} standard deviations of the lot from its median, "
            f"{self.median:.4g}{part}"
        )


class Population:
    """A lot of identified dampers."""

    def __init__(self, dampers: Sequence[KnownDamper]) -> None:
        self.dampers = tuple(dampers)

    @cached_property
    def points(self) -> list[tuple[float, float]]:
        """Operating points (m/s, A) within the identified range of most dampers."""
        if not self.dampers:
            return []
        ranges = [
            (d.parameter_set.peak_velocity_range, d.parameter_set.current_range)
            for d in self.dampers
        ]
        (slow, fast), (low, high) = np.median(np.array(ranges), axis=0).tolist()
        speeds = (slow, math.sqrt(slow * fast), fast)
        currents = (low, 0.5 * (low + high), high)
        rounded = [(_round(v), _round(i)) for i in currents for v in speeds if v > 0.0]
        return list(dict.fromkeys(rounded))

    @cached_property
    def forces(self) -> list[Spread]:
        """Spread of the largest force at each point, over the dampers identified there."""
        shape = len(self.dampers), len(self.points)
        values, errors = np.full(shape, math.nan), np.full(shape, math.nan)
        for row, damper in enumerate(self.dampers):
            known = [damper.covers(*point) for point in self.points]
            if any(known):
                chosen = list(compress(self.points, known))
                values[row, known], errors[row, known] = damper.peak_forces(chosen)
        return [
            Spread(f"force at {v:g} m/s and {i:g} A", "N", values[:, k], errors[:, k])
            for k, (v, i) in enumerate(self.points)
        ]

    @cached_property
    def limit(self) -> float:
        """Smallest deviation of an outlier, in robust standard deviations.

        In a lot without outliers, the expected number of false outliers is one half. The least
        limit is 3.5 (Iglewicz and Hoaglin, "How to detect and handle outliers", 1993).
        """
        comparisons = max(len(self.dampers) * (len(self.points) + 1), 1)
        chance = 0.5 / comparisons  # on both sides together
        return max(3.5, NormalDist().inv_cdf(1.0 - 0.5 * chance))

    @cached_property
    def outliers(self) -> list[Outlier]:
        """Outliers in force, each at the point of largest deviation; then outliers in misfit."""
        in_force = [outlier for spread in self.forces for outlier in self._beyond(spread)]
        worst: dict[str, Outlier] = {}
        for outlier in sorted(in_force, key=lambda one: -abs(one.score)):
            worst.setdefault(outlier.damper, outlier)
        # The residual of a poor fit exceeds one and a half times the median of the lot.
        logarithms = np.array([math.log(max(damper.nrmse, 1e-9)) for damper in self.dampers])
        fits = Spread("NRMSE", "", logarithms, np.zeros(logarithms.size))
        poor = [
            replace(one, value=math.exp(one.value), median=math.exp(one.median))
            for one in self._beyond(fits)
            if one.value - one.median > math.log(1.5)
        ]
        return [*worst.values(), *sorted(poor, key=lambda one: -one.score)]

    def _beyond(self, spread: Spread) -> list[Outlier]:
        if spread.known.size < LEAST_DAMPERS:
            return []
        # An outlier deviates by three of its own standard errors, too.
        own = np.abs(spread.values - spread.median) > 3.0 * spread.errors
        beyond = (np.abs(spread.scores) > self.limit) & own
        rows = zip(self.dampers, spread.values.tolist(), spread.scores.tolist(), strict=True)
        return [
            Outlier(damper.name, spread.label, spread.unit, value, spread.median, score)
            for damper, value, score in compress(rows, beyond)
        ]


def _round(value: float) -> float:
    return float(f"{value:.3g}")
