"""The sigmoid law as a model, and the law extended by a compliance, a stiffness and an offset."""

from __future__ import annotations

import numpy as np

from mr_damper_ros.models.force_model import Model, MotionLike, Parameter, State
from mr_damper_ros.models.sigmoid.extension import (
    COMPLIANCE,
    EXTENSION_NAMES,
    SIGMOID_COUNT,
    Extension,
    force_and_damping,
    lagged,
)
from mr_damper_ros.models.sigmoid.law import (
    PARAMETER_NAMES,
    SCALE_PARAMETER_NAMES,
    force_from_coefficients,
    operating_point_coefficients,
)
from mr_damper_ros.signals.arrays import Array


def _sigmoid(
    parameters: Array, motion: MotionLike, current: Array, period: float, state: State | None
) -> tuple[Array, State]:
    coefficients = operating_point_coefficients(parameters, motion.peak_velocity, current)
    return force_from_coefficients(coefficients, motion.velocity, motion.acceleration), ()


def _extended(
    parameters: Array, motion: MotionLike, current: Array, period: float, state: State | None
) -> tuple[Array, State]:
    sixteen = parameters[..., :SIGMOID_COUNT]
    coefficients = operating_point_coefficients(sixteen, motion.peak_velocity, current)
    plain, damping = force_and_damping(coefficients, motion.velocity, motion.acceleration)
    extension = Extension(*np.moveaxis(parameters[..., SIGMOID_COUNT:, np.newaxis], -2, 0))
    time_constant = extension.time_constant(damping)
    late = lagged(plain, time_constant, period, state=state)
    force = np.asarray(late + extension.stiffness * motion.displacement + extension.offset)
    return force, (plain[..., -1], late[..., -1], time_constant[..., -1])


def _starts(half_span: float, middle: float, speed: float, amplitude: float) -> Array:
    starts = []
    for steepness in (3.0, 10.0, 30.0):
        for hysteresis in (-0.3, -0.1):
            # f0 counts twice where a1 is zero.
            values = {
                "f0": 0.4 * half_span,
                "a0": steepness / speed,
                "k1c": 0.2 / speed,
                "k1e": 0.2 / speed,
                "k4": hysteresis,
                "k5": -middle / half_span,
            }
            starts.append([values.get(name, 0.0) for name in PARAMETER_NAMES])
    return np.array(starts)


def _extended_starts(half_span: float, middle: float, speed: float, amplitude: float) -> Array:
    plain = _starts(half_span, middle, speed, amplitude)
    compliance = 0.02 * amplitude / half_span
    return np.hstack([plain, np.tile([compliance, 0.0, 0.0], (len(plain), 1))])


_UNITS = {
    **dict.fromkeys(("a0", "a1", "a4", "k0", "k1c", "k1e"), "s/m"),
    **dict.fromkeys(("k2", "k3", "k4", "k5", "k6"), "1"),
    # The thesis prints (m/s)^-1 for a3, which multiplies a current.
    **dict.fromkeys(("a2", "a3"), "1/A"),
    **dict.fromkeys(("I0", "I1"), "A"),
    "f0": "N",
}

_SIGMOID_PARAMETERS = tuple(Parameter(name, _UNITS[name]) for name in PARAMETER_NAMES)
_WANG = (
    "Wang, Ma, Rakheja and Su, 43rd IEEE Conference on Decision and Control, 2004; "
    "thesis eq. 7-11 and appendix D"
)

SIGMOID = Model(
    "sigmoid",
    "sigmoid",
    _SIGMOID_PARAMETERS,
    _sigmoid,
    _WANG,
    _starts,
    free_in_one_run=SCALE_PARAMETER_NAMES,
    strength=("f0",),
)

EXTENDED_SIGMOID = Model(
    "sigmoid_lag",
    "sigmoid with lag, stiffness, offset",
    (
        *_SIGMOID_PARAMETERS,
        *(
            Parameter(name, unit, 0.0 if name == COMPLIANCE else -np.inf)
            for name, unit in zip(EXTENSION_NAMES, ("m/N", "N/m", "N"), strict=True)
        ),
    ),
    _extended,
    f"{_WANG}; the extension is this package's",
    _extended_starts,
    free_in_one_run=(*SCALE_PARAMETER_NAMES, *EXTENSION_NAMES),
    remembers=True,
    strength=("f0",),
)


def is_sigmoid(model: Model) -> bool:
    """Whether a model is the sigmoid law or its extension, which has operating-point coefficients.

    These have fits of their own, of one window and of many.
    """
    return model.parameter_names[: len(PARAMETER_NAMES)] == PARAMETER_NAMES
