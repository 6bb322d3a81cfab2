"""The set that a model starts from where nothing is known of the damper."""

from __future__ import annotations

import math

import numpy as np

from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import LITERATURE
from mr_damper_ros.models.sigmoid.sigmoid_model import is_sigmoid

_LITERATURE_PEAK_VELOCITY = 2.0 * math.pi * 1.0 * 2.5e-3
"""Peak velocity [m/s] of the test that the literature's set is for: 1 Hz, 2.5 mm, at 0 A."""

_USUAL_RUN = (1000.0, 0.0, 2.0 * math.pi * 1.0 * 5e-3, 5e-3)
"""Half span and middle of the force [N], peak velocity [m/s] and amplitude [m] of a usual run."""


def start_set(model: str) -> ParameterSet:
    """A set of the model to start from.

    Of the sigmoid law it is the one from the literature, of its extension the same without lag,
    stiffness and offset. Of any other model it is a mere form without any force, valid nowhere:
    the fit of the first window starts from what it reads off that window.
    """
    law = MODELS[model]
    if is_sigmoid(law):
        values = np.zeros(len(law.parameters))
        values[: LITERATURE.size] = LITERATURE
        name, speed = "literature", _LITERATURE_PEAK_VELOCITY
    else:
        values = law.scale_starts(*_USUAL_RUN)[0]
        values[law.strength_indices] = 0.0
        values = np.clip(values, *law.bounds)
        name, speed = "unknown", 0.0
    return ParameterSet(
        values,
        set_id=name,
        source=name,
        peak_velocity_range=(speed, speed),
        current_range=(0.0, 0.0),
        model=model,
    )
