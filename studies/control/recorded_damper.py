"""The damper of the buildings: a real damper, identified from its recordings.

This package identified the extended sigmoid law from twenty sinusoid records of an MR damper in a
test machine (github.com/DanielMaurelE/vRTHS_AMBC_MRdamper, MIT licence, © 2022 mequiroz). One set
fits all records to 6 %. The currents of the records are constant, so they give no information about
the coil.
"""

from __future__ import annotations

import numpy as np

from mr_damper_ros.models import MODELS
from mr_damper_ros.models.first_order_lag import COIL
from mr_damper_ros.models.parameter_set import ParameterSet

_VALUES = {
    "f0": 64.595135,
    "I0": -0.47949810,
    "I1": 0.492,
    "a0": 695.36189,
    "a1": 0.036241897,
    "a2": 3.2626734,
    "a3": 82.907410,
    "a4": -9.4422296,
    "k0": 73.941558,
    "k1c": 3.6203654,
    "k1e": 3.8709135,
    "k2": 10.685450,
    "k3": -67.9,
    "k4": -0.043652854,
    "k5": -0.014642521,
    "k6": -0.014359756,
    "compliance": 1.5061225e-07,
    "stiffness": 797.75380,
    "offset": -0.34959565,
}


def recorded_damper(coil_time_constant: float) -> ParameterSet:
    """Parameter set of the damper, with the time constant of the coil [s]."""
    values = {**_VALUES, COIL: coil_time_constant}
    return ParameterSet(
        np.array([values[name] for name in MODELS["sigmoid_lag"].parameter_names]),
        set_id="recorded",
        model="sigmoid_lag",
        peak_velocity_range=(0.0148, 0.0630),
        current_range=(0.0, 1.0),
    )
