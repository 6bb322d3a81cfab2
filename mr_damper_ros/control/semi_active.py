"""What force to want: semi-active controllers of a suspension, each a plain function.

A controller is a function from the moment of a suspension to the force [N] that the damper should
have, tension positive; one's own is one more. What no damper can give is left to the inverse, which
takes the nearest that it can: so they are clipped.

The damper pulls the body down and the wheel up with a positive force, and resists where the body
moves away from the wheel.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mr_damper_ros.control.linear_quadratic import regulator_gain
from mr_damper_ros.control.quarter_car import QuarterCar
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import Moment

Controller = Callable[[Moment], float]


def passive(damping: float) -> Controller:
    """A viscous damper [N s/m]."""
    return lambda now: damping * now.extension


def skyhook(damping: float) -> Controller:
    """A damper [N s/m] between the body and the sky.

    Karnopp, Crosby and Harwood, J. Engineering for Industry 96, 1974.
    """
    return lambda now: damping * now.body


def groundhook(damping: float) -> Controller:
    """A damper [N s/m] between the wheel and the ground.

    Valasek, Novak, Sika and Vaculin, Vehicle System Dynamics 28, 1997.
    """
    return lambda now: -damping * now.wheel


def hybrid(damping: float, share: float) -> Controller:
    """Skyhook to this share, groundhook for the rest [N s/m].

    Ahmadian and Pare, J. Intelligent Material Systems and Structures 11, 2000.
    """
    return lambda now: damping * (share * now.body - (1.0 - share) * now.wheel)


def acceleration_driven(low: float, high: float) -> Controller:
    """ADD: the high damping [N s/m] where it slows the body's acceleration, else the low one.

    Savaresi, Silani and Bittanti, J. Dynamic Systems, Measurement and Control 127, 2005.
    """

    def force(now: Moment) -> float:
        return (high if now.acceleration * now.extension > 0.0 else low) * now.extension

    return force


def mixed_skyhook_add(low: float, high: float, crossover: float) -> Controller:
    """SH-ADD: skyhook for slow motion, ADD for fast; they meet at ``crossover`` [rad/s].

    Savaresi and Spelta, J. Dynamic Systems, Measurement and Control 129, 2007.
    """

    def force(now: Moment) -> float:
        fast = now.acceleration**2 > (crossover * now.body) ** 2
        driving = now.acceleration if fast else now.body
        return (high if driving * now.extension > 0.0 else low) * now.extension

    return force


def linear_feedback(gain: Array) -> Controller:
    """Feedback of the states (apart, body, tyre, wheel), such as :func:`optimal_gain` gives."""
    by_apart, by_body, by_tyre, by_wheel = gain.tolist()
    return lambda now: (
        -by_apart * now.apart - by_body * now.body - by_tyre * now.tyre - by_wheel * now.wheel
    )


class Weights(NamedTuple):
    """Weights of the squares of body acceleration, suspension travel, tyre travel and force."""

    acceleration: float = 1.0
    apart: float = 1e3
    tyre: float = 1e4
    force: float = 1e-9


def optimal_gain(car: QuarterCar, weights: Weights) -> Array:
    """Gain (4,) of the linear-quadratic regulator of a car, for :func:`linear_feedback`.

    See :mod:`mr_damper_ros.control.linear_quadratic`. An estimator, where the states are not
    measured, changes nothing of it (the separation principle).
    """
    # The acceleration of the body is the second state's derivative, which the force enters.
    outputs = np.stack([car.dynamics[1], np.eye(4)[0], np.eye(4)[2]])
    direct = np.array([car.by_force[1], 0.0, 0.0])
    squares = np.array([weights.acceleration, weights.apart, weights.tyre])
    return regulator_gain(car.plant, outputs, direct, squares, weights.force)
