"""From recordings to windows to identify from, and the errors of a parameter set on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mr_damper_ros.estimation.model_fit import model_force
from mr_damper_ros.io.bags import read_bag
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.sigmoid.scale_misfit import Window
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.screening import Screening, fault_of_samples, fault_of_sign


@dataclass(frozen=True)
class BagWindows:
    """The windows of one bag, one for each stretch without a gap.

    ``temperatures``: of each window that of its samples (n,) [°C], None where it was not measured.
    """

    path: Path
    windows: tuple[Window, ...]
    temperatures: tuple[Array | None, ...]


@dataclass(frozen=True)
class Metrics:
    """Error of a prediction: ``rmse`` [N], ``nrmse`` = RMSE/std of the force, ``r2``."""

    rmse: float
    nrmse: float
    r2: float
    n_samples: int


def bag_windows(path: Path) -> BagWindows:
    """Windows of a bag; raises ValueError with a sentence where it cannot be used."""
    windows, temperatures = [], []
    for recording in read_bag(path):
        fault = fault_of_samples(
            recording.displacement,
            recording.force,
            recording.current,
            Screening(minimum_amplitude=1e-6, current_tolerance=np.inf),
        )
        if fault:
            raise ValueError(f"{path}: {fault}")
        window = Window.from_samples(
            recording.displacement, recording.force, recording.current, recording.period
        )
        fault = fault_of_sign(window.motion.velocity, window.force)
        if fault:
            raise ValueError(f"{path}: {fault}")
        windows.append(window)
        temperatures.append(recording.temperature)
    return BagWindows(path, tuple(windows), tuple(temperatures))


def metrics(found: ParameterSet, windows: Sequence[Window]) -> Metrics:
    """Error of a parameter set of any model on windows taken together.

    As the set is used in a prediction: with the peak velocity held within its range.
    """
    measured = np.concatenate([window.force for window in windows])
    held = [window.held_within(*found.peak_velocity_range) for window in windows]
    predicted = [model_force(found.law, window, found.values) for window in held]
    residual = np.concatenate(predicted) - measured
    rmse = float(np.sqrt(np.mean(residual**2)))
    nrmse = rmse / float(np.std(measured))
    return Metrics(rmse=rmse, nrmse=nrmse, r2=1.0 - nrmse**2, n_samples=int(measured.size))
