"""Claimed against true errors of coefficients and force in motions that were not identified."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from benchmarks.dampers import LAWS, foreign_force
from benchmarks.figure import Measured
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.quantities import LoopReading
from mr_damper_ros.signals.arrays import Array
from studies import recordings

DAMPERS = 40
_PERIOD = 2e-3
_CURRENTS = (0.0, 0.4, 0.8, 1.2)
_SPEEDS = np.geomspace(0.02, 0.2, 5)
"""Peak velocities [m/s] of the five motions of a foreign damper, each scattered by 10 %."""

_FREQUENCIES = (0.5, 1.0, 1.0, 2.0, 3.0)
_NOISE = 0.02
"""Standard deviation of the noise relative to the root mean square of the force."""


def scores(
    law: str, known: Sequence[Window], left_out: Sequence[Window], seed: int
) -> tuple[Array, Array]:
    """True over claimed errors: of the coefficients (k, c) and of the force (k,) left out.

    A fit to the window alone gives the true coefficients that it determines; its errors count, too.
    """
    model = MODELS[law]
    fit = identify_global(model, known, model.initial_values()[0], EvolutionSettings(seed=seed))
    values = fit.parameter_set.values
    coefficients, forces = [], []
    for window in left_out:
        own = fit_window(model, window, values, method="least_squares")
        frequency = LoopReading.of(window).frequency
        found, errors, _ = fit.coefficients(own.operating_point, frequency)
        variances = np.diag(own.coefficient_errors)
        claimed = np.where(variances > 0.0, np.sqrt(errors**2 + variances), math.nan)
        coefficients.append((found - own.coefficients) / claimed)
        settled = model.settled(window, values)
        residual = (model.window_force(window, values) - window.force)[settled]
        forces.append(recordings.rms(residual) / recordings.rms(fit.force_error(window)[settled]))
    return np.array(coefficients), np.array(forces)


def _rms(values: Sequence[Array]) -> float:
    every = np.concatenate([np.ravel(each) for each in values])
    return recordings.rms(every[np.isfinite(every)])


def foreign_windows(seed: int) -> tuple[list[Window], list[Window]]:
    """Windows of a foreign damper: four motions at four currents, and those of a fifth motion."""
    rng = np.random.default_rng(seed)
    law = list(LAWS)[seed % len(LAWS)]
    size = math.exp(0.3 * rng.standard_normal())
    speeds = _SPEEDS * np.exp(0.1 * rng.standard_normal(_SPEEDS.size))
    frequencies = rng.permutation(_FREQUENCIES)
    out = int(rng.integers(_SPEEDS.size))
    known: list[Window] = []
    left_out: list[Window] = []
    for place, (speed, frequency) in enumerate(zip(speeds, frequencies, strict=True)):
        omega = 2.0 * math.pi * frequency
        count, begin = int(max(3.0 / frequency, 1.5) / _PERIOD), int(1.0 / frequency / _PERIOD)
        angle = omega * _PERIOD * np.arange(begin + count)
        u, v = speed / omega * np.sin(angle), speed * np.cos(angle)
        for current in _CURRENTS:
            moved = u, v, -(omega**2) * u
            force = foreign_force(law, moved, current, _PERIOD, size)[begin:]
            force = force + _NOISE * recordings.rms(force) * rng.standard_normal(count)
            measured = u[begin:] + 1e-6 * rng.standard_normal(count)
            window = Window.from_samples(measured, force, current, _PERIOD)
            (left_out if place == out else known).append(window)
    return known, left_out


def foreign_figures(
    dampers: int = DAMPERS, laws: Sequence[str] = tuple(MODELS), seed: int = 0
) -> Measured:
    """Foreign dampers, identified with one law after the other of the package."""
    chosen = range(seed * dampers, (seed + 1) * dampers)
    found = [scores(laws[k % len(laws)], *foreign_windows(k), seed) for k in chosen]
    figures: Measured = {}
    for key, place in (("coefficients", 0), ("force", 1)):
        each = [_rms([pair[place]]) for pair in found]
        figures[f"foreign_left_out_{key}"] = float(np.median(each))
        figures[f"foreign_left_out_{key}_most"] = float(np.quantile(each, 0.9))
    return figures


def recorded_figures(laws: Sequence[str] = tuple(MODELS), seed: int = 0) -> Measured:
    """The processed sinusoid records, each motion left out in turn."""
    place = recordings.folder()
    keys = "left_out_coefficients", "left_out_force"
    if place is None:
        return dict.fromkeys(keys, (None, recordings.NONE))
    motions = recordings.processed_motions(place)
    found = {}
    for law in laws:
        folds = []
        for out, windows in motions.items():
            known = [w for motion, each in motions.items() if motion != out for w in each]
            folds.append(scores(law, known, windows, seed))
        found[law] = [_rms(parts) for parts in zip(*folds, strict=True)]
    note = ", ".join(laws)
    return {
        key: ([pair[column] for pair in found.values()], note) for column, key in enumerate(keys)
    }
