"""An invented damper for cars that are emulated: what is known of it is the truth.

It has the size of the thesis' damper, a coil, and the extended sigmoid law.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mr_damper_ros.models import MODELS
from mr_damper_ros.models.first_order_lag import COIL
from mr_damper_ros.models.parameter_set import ParameterSet

HOT_FORCE = 989.0 / 1332.0
"""What the thesis' damper keeps of its force at 71 °C: tables 8 and 9, 5 mm, 1 Hz, 1.5 A."""

HIGHEST_CURRENT = 1.6

_VALUES = {
    "f0": 40.0,
    "I0": -0.35,
    "I1": -0.25,
    "a0": 900.0,
    "a1": 2.5,
    "a2": 4.0,
    "a3": 3.0,
    "a4": 2.0,
    "k0": 9.0,
    "k1c": 4.0,
    "k1e": 6.0,
    "k2": 18.0,
    "k3": -0.45,
    "k4": -0.11,
    "k5": 0.06,
    "k6": 0.012,
    "compliance": 3e-8,
    "stiffness": 2000.0,
    "offset": -40.0,
}


def invented_damper(coil_time_constant: float) -> ParameterSet:
    """What is known of it at 28 °C, with a coil that lags by so many seconds."""
    values = {**_VALUES, COIL: coil_time_constant}
    names = MODELS["sigmoid_lag"].parameter_names
    return replace(
        ParameterSet(
            np.array([values[name] for name in names]), set_id="invented", model="sigmoid_lag"
        ),
        peak_velocity_range=(0.0, 2.0),
        current_range=(0.0, HIGHEST_CURRENT),
    )
