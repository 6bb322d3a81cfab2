"""How the force falls with temperature, from runs in which it was measured."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.interface.measured_runs import MeasuredRun
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.fluid_temperature import TemperatureMaps
from mr_damper_ros.tracking.force_scale import Baselines, force_scale

_CYCLES = 2.0
"""Cycles of a piece; of a motion that is no sine a piece takes ``_DURATION`` seconds."""

_DURATION = 4.0
_MOST_PIECES = 300
_SAMPLES = 500
"""Samples of a piece are thinned to about so many."""

_STEADY_CURRENT = 0.02
"""Change [A] of the current that a piece may have."""


def temperature_maps(runs: Sequence[MeasuredRun], found: ParameterSet) -> TemperatureMaps:
    """Maps from all runs together; ``found`` is the set identified from them.

    Each run is cut into pieces of a few cycles, whose fitted scales give the force scale. Pieces
    whose force cannot be fitted are left out.
    """
    maps, baselines = TemperatureMaps(), Baselines()
    for run in runs:
        for window, celsius in zip(run.windows, run.temperatures, strict=True):
            if celsius is None:
                continue
            for piece, mean in _pieces(window, celsius):
                try:
                    fit = fit_window(found.law, piece, found.values, method="least_squares")
                except ValueError:
                    continue
                baselines.add(fit)
                maps.add(fit.operating_point, mean, force_scale(found.law, piece, fit, baselines))
    return maps


def _pieces(window: Window, celsius: Array) -> Iterator[tuple[Window, float]]:
    """Pieces of a window with their mean temperature [°C]."""
    frequency = window.motion.frequency
    duration = _CYCLES / frequency if np.isfinite(frequency) else _DURATION
    count = int(window.sample_count * window.period / duration)
    edges = np.linspace(0, window.sample_count, min(max(count, 1), _MOST_PIECES) + 1).astype(int)
    for first, last in pairwise(edges):
        place = slice(int(first), int(last))
        if float(np.ptp(window.current[place])) <= _STEADY_CURRENT:
            yield window.part(place).thinned(_SAMPLES), float(np.mean(celsius[place]))
