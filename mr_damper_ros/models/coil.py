"""The coil's current, which follows that of the supply with a first-order lag.

The field, and with it the force, follows the current in the coil: du/dt = -eta (u - v) in Spencer,
Dyke, Sain and Carlson (1997); the time constant is 1/eta. Where the current is constant the lag
shows nowhere.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.first_order_lag import SETTLING, lagged, one_sample_later
from mr_damper_ros.models.quantities import Parameter
from mr_damper_ros.signals.arrays import Array

COIL = "coil_time_constant"
"""Name of the parameter of the coil's lag [s]."""

PLAUSIBLE_COIL = 0.2
"""Few coils are slower [s]."""

_SLOWEST_COIL = 1.0


def coil_parameter() -> Parameter:
    """The parameter of the lag: the last of a law, 0 where it is left out."""
    return Parameter(COIL, "s", 0.0, _SLOWEST_COIL, currents=2, default=0.0)


def coil_current(
    current: Array, time_constant: Array, period: float, before: tuple[Array, Array] | None
) -> Array:
    """Current [A] of the coil, shape (..., n), for the supply's (n,).

    ``time_constant`` (...) [s]; ``before``: the supply's and the coil's current of the sample
    before, None for a start at which both are the same.
    """
    every = np.broadcast_to(current, (*time_constant.shape, current.size))
    # A constant current, too: what a stream will need is loaded before it begins.
    constants = np.broadcast_to(time_constant[..., np.newaxis], every.shape)
    state = None if before is None else (*before, time_constant)
    return lagged(every, constants, period, state=state)


def few_in_coil(
    current: list[float], time_constant: float, period: float, before: tuple[float, float] | None
) -> tuple[list[float], tuple[float, float]]:
    """The same in plain numbers, and what is remembered: the supply's and the coil's current."""
    supplied, late = (current[0], current[0]) if before is None else before
    found = []
    for value in current:
        late = one_sample_later(value, time_constant, period, supplied, late, time_constant)
        supplied = value
        found.append(late)
    return found, (supplied, late)


def coil_state(remembered: tuple[Array, ...]) -> tuple[Array, Array] | None:
    """What a law remembers of supply and coil; None where its coil has not lagged so far."""
    return (remembered[0], remembered[1]) if remembered else None


def coil_shows(window: Window, time_constant: float) -> bool:
    """Whether a lag of so many seconds changes the current of a window, and its past is known."""
    has_past = (window.whole or window).period > 0.0
    return time_constant > 0.0 and has_past and not window.has_constant_current


def in_coil(window: Window, time_constant: float) -> Window:
    """The window with the current of the coil in place of the supply's."""
    if not coil_shows(window, time_constant):
        return window
    whole = window.whole or window
    late = coil_current(whole.current, np.array(time_constant), whole.period, None)
    if window.whole is None:
        return replace(window, current=late)
    assert window.places is not None
    current = np.interp(window.places, np.arange(late.size), late)
    return replace(window, current=current, whole=replace(whole, current=late))


def coil_unsettled(window: Window, time_constant: float) -> np.ndarray:
    """Mask (n,) of samples whose coil may still remember the current before the window."""
    if not coil_shows(window, time_constant):
        return np.zeros(window.sample_count, dtype=bool)
    return window.history.unsettled(SETTLING * time_constant)
