"""Dampers of known parameters that differ from each other: about the thesis' and about a real one.

Drawn, not measured: the parameters scatter about two sets, and draws that no damper could have are
left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mr_damper_ros.models import MODELS
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet
from mr_damper_ros.models.plausibility import check_plausible
from mr_damper_ros.signals.arrays import Array

_SCALES, _SHAPES = 0.3, 0.2
"""Standard deviations of the logarithms of scale and shape parameters."""


@dataclass(frozen=True)
class DamperKind:
    """Parameters (16,) that dampers scatter about, and the ranges [m/s], [A] that matter."""

    name: str
    centre: tuple[float, ...]
    peak_velocity: tuple[float, float]
    current: tuple[float, float]


KINDS = (
    # Forces, speeds and currents of the thesis' damper; all laws show within the range.
    DamperKind(
        "thesis-like",
        (
            *(40.0, -0.35, -0.25, 900.0, 2.5, 4.0, 3.0, 2.0),
            *(9.0, 4.0, 6.0, 18.0, -0.45, -0.11, 0.06, 0.012),
        ),
        (0.02, 0.2),
        (0.0, 1.5),
    ),
    # What this package identifies from the sinusoid records of a commercial damper in a press.
    DamperKind(
        "utfsm-like",
        (
            *(66.55, -0.4804, 0.492, 663.6, 1.161, 3.238, 1.45, -13.86),
            *(77.78, 2.138, 2.31, 10.68, 2.022, -0.07457, -0.01317, -0.01237),
        ),
        (0.015, 0.063),
        (0.0, 1.0),
    ),
)


def random_damper(kind: DamperKind, seed: int) -> Array:
    """Parameters (16,) of the damper of this seed."""
    model: Model = MODELS["sigmoid"]
    rng = np.random.default_rng(seed)
    spread = np.array(
        [_SCALES if name in model.scale_names else _SHAPES for name in model.parameter_names]
    )
    while True:
        values = np.array(kind.centre) * np.exp(spread * rng.standard_normal(spread.size))
        try:
            check_plausible(
                ParameterSet(
                    values, peak_velocity_range=kind.peak_velocity, current_range=kind.current
                )
            )
        except ParameterError:
            continue
        return np.asarray(values)
