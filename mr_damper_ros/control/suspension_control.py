"""The controller of a suspension by its name, or one's own by where it is defined."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module

from mr_damper_ros.control.quarter_car import QuarterCar
from mr_damper_ros.control.semi_active import (
    Controller,
    Weights,
    acceleration_driven,
    groundhook,
    hybrid,
    linear_feedback,
    mixed_skyhook_add,
    optimal_gain,
    passive,
    skyhook,
)
from mr_damper_ros.settings.option_table import CheckedSettings, group, option


@dataclass(frozen=True)
class OptimalSettings(CheckedSettings):
    """The car that ``controller: optimal`` is for, and what it weighs."""

    body: float = option(400.0, "Mass [kg] above the spring.", minimum=1e-3, maximum=1e6)
    wheel: float = option(50.0, "Mass [kg] of the wheel.", minimum=1e-3, maximum=1e6)
    spring: float = option(20e3, "Stiffness [N/m] of the spring.", minimum=1.0, maximum=1e9)
    tyre: float = option(250e3, "Stiffness [N/m] of the tyre.", minimum=1.0, maximum=1e9)
    weight_acceleration: float = option(
        1.0, "Weight of the body's acceleration squared.", minimum=0.0, maximum=1e12
    )
    weight_travel: float = option(
        1e3, "Weight of the suspension's travel squared.", minimum=0.0, maximum=1e12
    )
    weight_tyre: float = option(
        1e4, "Weight of the tyre's travel squared.", minimum=0.0, maximum=1e12
    )
    weight_force: float = option(1e-9, "Weight of the force squared.", minimum=1e-15, maximum=1e6)


@dataclass(frozen=True)
class SuspensionSettings(CheckedSettings):
    """What force a suspension wants of its damper."""

    controller: str = option(
        "skyhook",
        "passive, skyhook, groundhook, hybrid (of those two), add (acceleration-driven), sh_add "
        "(skyhook for slow motion, acceleration-driven for fast), or optimal (linear-quadratic).",
        choices=("passive", "skyhook", "groundhook", "hybrid", "add", "sh_add", "optimal"),
        read_only=True,
    )
    function: str = option(
        "",
        "One's own controller in the place of it, as module:function. The function takes a "
        "mr_damper_ros.control.semi_active.Moment and returns the force [N] to want.",
        read_only=True,
    )
    damping: float = option(
        2500.0,
        "Damping [N s/m] of passive, skyhook, groundhook and hybrid.",
        minimum=0.0,
        maximum=1e6,
        read_only=True,
    )
    share: float = option(
        0.6,
        "Share of the skyhook in hybrid; the rest is groundhook.",
        minimum=0.0,
        maximum=1.0,
        read_only=True,
    )
    low: float = option(
        700.0, "Low damping [N s/m] of add and sh_add.", minimum=0.0, maximum=1e6, read_only=True
    )
    high: float = option(
        4000.0, "High damping [N s/m] of these.", minimum=0.0, maximum=1e6, read_only=True
    )
    crossover: float = option(
        12.0,
        "Frequency [rad/s] where the skyhook of sh_add meets the acceleration-driven part.",
        minimum=0.0,
        maximum=1e4,
        read_only=True,
    )
    optimal: OptimalSettings = group(OptimalSettings, read_only=True)


def controller_of(settings: SuspensionSettings) -> Controller:
    """The controller that is meant.

    Raises ValueError where one's own cannot be found, in a sentence.
    """
    if settings.function:
        return _own(settings.function)
    return _CONTROLLERS[settings.controller](settings)


def _optimal(settings: SuspensionSettings) -> Controller:
    given = settings.optimal
    car = QuarterCar(given.body, given.wheel, given.spring, given.tyre)
    weights = Weights(
        given.weight_acceleration, given.weight_travel, given.weight_tyre, given.weight_force
    )
    return linear_feedback(optimal_gain(car, weights))


_CONTROLLERS: dict[str, Callable[[SuspensionSettings], Controller]] = {
    "passive": lambda given: passive(given.damping),
    "skyhook": lambda given: skyhook(given.damping),
    "groundhook": lambda given: groundhook(given.damping),
    "hybrid": lambda given: hybrid(given.damping, given.share),
    "add": lambda given: acceleration_driven(given.low, given.high),
    "sh_add": lambda given: mixed_skyhook_add(given.low, given.high, given.crossover),
    "optimal": _optimal,
}


def _own(place: str) -> Controller:
    """A function by its module and its name."""
    module, _, name = place.partition(":")
    if not module or not name:
        raise ValueError(
            f"function is {place!r}: write it as module:function, such as mine:comfort"
        )
    try:
        found = getattr(import_module(module), name)
    except ImportError as error:
        raise ValueError(
            f"function is {place}, and the module cannot be imported ({error}): is its folder on "
            "PYTHONPATH?"
        ) from error
    except AttributeError as error:
        raise ValueError(f"function is {place}, but {module} has no {name}") from error
    if not callable(found):
        raise ValueError(f"function is {place}, which is no function")
    controller: Controller = found
    return controller
