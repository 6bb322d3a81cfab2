"""Semi-active controllers of a suspension by name, and the gain of the optimal one.

A controller is a function from the state of a suspension to the desired damper force [N], tension
positive; users may provide their own. The inverse model clips the force to the attainable range. A
positive force pulls the body down and the wheel up; it is dissipative while the body moves away
from the wheel.

For the linear-quadratic regulator see Anderson and Moore, Optimal Control: Linear Quadratic
Methods, 1990. Clipped to attainable forces, it is the clipped-optimal control of Dyke, Spencer,
Sain and Carlson, Smart Materials and Structures 5, 1996.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module

import numpy as np

from mr_damper_ros.control.linear_plant import LinearPlant, QuarterCar
from mr_damper_ros.settings.option_table import CheckedSettings, group, option
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import SuspensionState


def regulator_gain(
    plant: LinearPlant, outputs: Array, direct: Array, weights: Array, effort: float
) -> Array:
    """Gain (n,) that minimises the cost of F = -gain x.

    The outputs are ``outputs`` (k, n) x + ``direct`` (k,) F. The cost is the integral of their
    squares times ``weights`` (k,), plus ``effort`` F².
    """
    from scipy.linalg import solve_continuous_are  # imported late: see entry_points

    states = outputs.T @ (weights[:, np.newaxis] * outputs)
    crossed = (outputs.T @ (weights * direct))[:, np.newaxis]
    squares = np.array([[float(weights @ direct**2) + effort]])
    column = plant.by_force[:, np.newaxis]
    cost = solve_continuous_are(plant.dynamics, column, states, squares, s=crossed)
    return np.asarray(np.linalg.solve(squares, column.T @ cost + crossed.T)[0])


Controller = Callable[[SuspensionState], float]


def passive(damping: float) -> Controller:
    """A viscous damper [N s/m]."""
    return lambda now: damping * now.extension


def skyhook(damping: float) -> Controller:
    """A damper [N s/m] between the body and an inertial reference (the sky).

    Karnopp, Crosby and Harwood, J. Engineering for Industry 96, 1974.
    """
    return lambda now: damping * now.body


def groundhook(damping: float) -> Controller:
    """A damper [N s/m] between the wheel and the ground.

    Valasek, Novak, Sika and Vaculin, Vehicle System Dynamics 28, 1997.
    """
    return lambda now: -damping * now.wheel


def hybrid(damping: float, share: float) -> Controller:
    """Weighted sum of skyhook (this share) and groundhook [N s/m].

    Ahmadian and Pare, J. Intelligent Material Systems and Structures 11, 2000.
    """
    return lambda now: damping * (share * now.body - (1.0 - share) * now.wheel)


def acceleration_driven(low: float, high: float) -> Controller:
    """ADD: high damping [N s/m] while it reduces the body acceleration, otherwise low damping.

    Savaresi, Silani and Bittanti, J. Dynamic Systems, Measurement and Control 127, 2005.
    """

    def force(now: SuspensionState) -> float:
        return (high if now.acceleration * now.extension > 0.0 else low) * now.extension

    return force


def mixed_skyhook_add(low: float, high: float, crossover: float) -> Controller:
    """SH-ADD: skyhook for slow motion, ADD for fast motion, divided at ``crossover`` [rad/s].

    Savaresi and Spelta, J. Dynamic Systems, Measurement and Control 129, 2007.
    """

    def force(now: SuspensionState) -> float:
        fast = now.acceleration**2 > (crossover * now.body) ** 2
        driving = now.acceleration if fast else now.body
        return (high if driving * now.extension > 0.0 else low) * now.extension

    return force


def linear_feedback(gain: Array) -> Controller:
    """Feedback of the states (stroke, body, tyre, wheel), for example by :func:`optimal_gain`."""
    by_stroke, by_body, by_tyre, by_wheel = gain.tolist()
    return lambda now: (
        -by_stroke * now.stroke - by_body * now.body - by_tyre * now.tyre - by_wheel * now.wheel
    )


@dataclass(frozen=True)
class Weights(CheckedSettings):
    """Weights of the cost of the linear-quadratic regulator of a car."""

    weight_acceleration: float = option(
        1.0, "Weight of the squared body acceleration.", within=(0.0, 1e12)
    )
    weight_travel: float = option(
        1e3, "Weight of the squared suspension stroke.", within=(0.0, 1e12)
    )
    weight_tyre: float = option(1e4, "Weight of the squared tyre deflection.", within=(0.0, 1e12))
    weight_force: float = option(1e-9, "Weight of the squared force.", within=(1e-15, 1e6))


def optimal_gain(car: QuarterCar, weights: Weights) -> Array:
    """Gain (4,) of the linear-quadratic regulator of a car, for :func:`linear_feedback`.

    If the states are estimated rather than measured, the gain is the same (separation principle).
    """
    plant = car.plant
    # The body acceleration is the derivative of the second state and depends on the force.
    outputs = np.stack([plant.dynamics[1], np.eye(4)[0], np.eye(4)[2]])
    direct = np.array([plant.by_force[1], 0.0, 0.0])
    squares = np.array([weights.weight_acceleration, weights.weight_travel, weights.weight_tyre])
    return regulator_gain(plant, outputs, direct, squares, weights.weight_force)


@dataclass(frozen=True)
class OptimalSettings(CheckedSettings):
    """Car and weights of ``controller: optimal``."""

    car: QuarterCar = group(QuarterCar, flat=True)
    weights: Weights = group(Weights, flat=True)


@dataclass(frozen=True)
class SuspensionSettings(CheckedSettings):
    """Options of the desired force of a suspension."""

    controller: str = option(
        "skyhook",
        "passive, skyhook, groundhook, hybrid (skyhook and groundhook), add (acceleration-driven), "
        "sh_add (skyhook for slow motion, add for fast motion), or optimal (linear-quadratic).",
        choices=("passive", "skyhook", "groundhook", "hybrid", "add", "sh_add", "optimal"),
    )
    function: str = option(
        "",
        "Your own controller instead, as module:function. The function takes a "
        "mr_damper_ros.control.semi_active.SuspensionState and returns the desired force [N].",
    )
    damping: float = option(
        2500.0, "Damping [N s/m] of passive, skyhook, groundhook and hybrid.", within=(0.0, 1e6)
    )
    share: float = option(
        0.6, "Share of the skyhook in hybrid; the rest is groundhook.", within=(0.0, 1.0)
    )
    low: float = option(700.0, "Low damping [N s/m] of add and sh_add.", within=(0.0, 1e6))
    high: float = option(4000.0, "High damping [N s/m] of add and sh_add.", within=(0.0, 1e6))
    crossover: float = option(
        12.0,
        "Crossover frequency [rad/s] of sh_add between skyhook and acceleration-driven control.",
        within=(0.0, 1e4),
    )
    optimal: OptimalSettings = group(OptimalSettings)


def controller_of(settings: SuspensionSettings) -> Controller:
    """The controller of these settings; raises ValueError if a user's controller is missing."""
    if settings.function:
        return _import_controller(settings.function)
    return _CONTROLLERS[settings.controller](settings)


_CONTROLLERS: dict[str, Callable[[SuspensionSettings], Controller]] = {
    "passive": lambda given: passive(given.damping),
    "skyhook": lambda given: skyhook(given.damping),
    "groundhook": lambda given: groundhook(given.damping),
    "hybrid": lambda given: hybrid(given.damping, given.share),
    "add": lambda given: acceleration_driven(given.low, given.high),
    "sh_add": lambda given: mixed_skyhook_add(given.low, given.high, given.crossover),
    "optimal": lambda given: linear_feedback(
        optimal_gain(given.optimal.car, given.optimal.weights)
    ),
}


def _import_controller(place: str) -> Controller:
    """Import a function by module and name."""
    module, _, name = place.partition(":")
    if not module or not name:
        raise ValueError(
            f"function is {place!r}: write it as module:function, such as mine:comfort"
        )
    try:
        imported = import_module(module)
    except ImportError as error:
        raise ValueError(
            f"function is {place}, but the module cannot be imported ({error}): is its folder on "
            "PYTHONPATH?"
        ) from error
    if not hasattr(imported, name):
        raise ValueError(f"function is {place}, but {module} has no {name}")
    controller: Controller = getattr(imported, name)
    if not callable(controller):
        raise ValueError(f"function is {place}, which is not a function")
    return controller
