"""The sigmoid law as a model, and its extension by a lag, a stiffness and an offset.

The extension: F_s is the sigmoid force, and tau dF_l/dt + F_l = F_s with tau = tau0 + tau1 |i|;
the force is F_l + stiffness u + offset. The lag is the coil's and the fluid's, the stiffness and
the offset are those of the gas (thesis 3.2; the thesis adds 100 N to its records by hand).
"""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from mr_damper_ros.damper.models.base import Model, MotionLike, Parameter
from mr_damper_ros.damper.sigmoid import (
    PARAMETER_NAMES,
    SCALE_PARAMETER_NAMES,
    Array,
    force,
)

_SIGMOID_COUNT = len(PARAMETER_NAMES)


def _sigmoid(parameters: Array, motion: MotionLike, current: Array, period: float) -> Array:
    return force(parameters, motion.displacement, motion.velocity, motion.acceleration, current)


def lagged(values: Array, time_constant: Array, period: float) -> Array:
    """First-order lag of a signal of shape (..., n), which starts settled.

    ``time_constant`` [s] has the shape (..., n) or broadcasts to it. Exact where the signal is
    linear between samples, whatever the period; a time constant of 0 changes nothing.
    """
    tau = np.maximum(np.broadcast_to(time_constant, values.shape), 1e-9 * period)
    ratio = period / tau
    decay = np.exp(-ratio)
    mean = -np.expm1(-ratio) / ratio  # weight of the line between two samples
    before, now = mean - decay, 1.0 - mean
    if np.ptp(tau, axis=-1).max(initial=0.0) == 0.0:
        flat = values.reshape(-1, values.shape[-1])
        rows = [
            lfilter([b1, b0], [1.0, -d], row, zi=[row[0] * (1.0 - b1)])[0]
            for row, b1, b0, d in zip(
                flat,
                now[..., 0].ravel(),
                before[..., 0].ravel(),
                decay[..., 0].ravel(),
                strict=True,
            )
        ]
        return np.asarray(np.reshape(rows, values.shape))
    result = np.array(values)
    for step in range(1, values.shape[-1]):
        result[..., step] = (
            decay[..., step] * result[..., step - 1]
            + before[..., step] * values[..., step - 1]
            + now[..., step] * values[..., step]
        )
    return result


def _extended(parameters: Array, motion: MotionLike, current: Array, period: float) -> Array:
    plain = _sigmoid(parameters[..., :_SIGMOID_COUNT], motion, current, period)
    tau0, tau1, stiffness, offset = (
        parameters[..., _SIGMOID_COUNT + place, np.newaxis] for place in range(4)
    )
    late = lagged(plain, tau0 + tau1 * np.abs(current), period)
    return np.asarray(late + stiffness * motion.displacement + offset)


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
    lag = 0.02 * amplitude / speed
    return np.hstack([plain, np.tile([lag, 0.0, 0.0, 0.0], (len(plain), 1))])


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
)

EXTENDED_SIGMOID = Model(
    "sigmoid_lag",
    "sigmoid with lag, stiffness, offset",
    (
        *_SIGMOID_PARAMETERS,
        Parameter("tau0", "s", 0.0, 1.0),
        Parameter("tau1", "s/A", 0.0, 1.0),
        Parameter("stiffness", "N/m"),
        Parameter("offset", "N"),
    ),
    _extended,
    f"{_WANG}; the extension is this package's",
    _extended_starts,
    free_in_one_run=(*SCALE_PARAMETER_NAMES, "tau0", "stiffness", "offset"),
)
