"""Extent of the study of the force laws."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mr_damper_ros.models import MODELS
from studies import recordings
from studies.program import Campaign


@dataclass(frozen=True)
class Extent:
    """Extent of the study.

    ``laws`` are the laws under test, and ``online`` those with the identifier running. ``every`` is
    the stride over the currents of the sinusoid records. ``currents`` [A] and ``longest`` [s] apply
    to the earthquakes. The other values are the sample ``count``, the steps per sample and the
    duration of a sweep [s] of the benchmark.
    """

    laws: tuple[str, ...] = tuple(MODELS)
    online: tuple[str, ...] = tuple(MODELS)
    every: int = 1
    currents: tuple[float, ...] = recordings.EARTHQUAKE_CURRENTS
    longest: float = math.inf
    count: int = 8192
    steps: int = 20
    sweep: float = math.inf


SHORT = Extent(
    laws=("hyperbolic_tangent", "sigmoid", "sigmoid_lag", "series_springs"),
    online=("sigmoid",),
    every=4,
    currents=(0.6,),
    longest=20.0,
    count=1024,
    steps=5,
    sweep=10.0,
)
"""Short variant that checks whether everything works; its figures are not representative."""


def extent_of(campaign: Campaign) -> Extent:
    """The extent of this call."""
    return SHORT if campaign.quick else Extent()
