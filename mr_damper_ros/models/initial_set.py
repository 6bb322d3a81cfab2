"""The set that a model starts from where nothing is known of the damper."""

from __future__ import annotations

from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet


def start_set(model: str) -> ParameterSet:
    """A set of the model to start from.

    Of the sigmoid law it is the one from the literature, of its extension the same without lag,
    stiffness and offset. Of any other model it is a mere form without any force, valid nowhere:
    the fit of the first window starts from what it reads off that window.
    """
    values, name, speed = MODELS[model].initial_values()
    return ParameterSet(
        values,
        set_id=name,
        source=name,
        peak_velocity_range=(speed, speed),
        current_range=(0.0, 0.0),
        model=model,
    )
