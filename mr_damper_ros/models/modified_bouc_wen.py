"""The modified Bouc-Wen model of Spencer, Dyke, Sain and Carlson (1997)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.current_dependence import Coefficient, CurrentDependentModel
from mr_damper_ros.models.hysteresis import (
    HYSTERESIS,
    follow_inner_point,
    hysteresis_step,
    integrated,
    memory_length,
    relaxation,
)
from mr_damper_ros.models.machine_code import run_loop
from mr_damper_ros.models.quantities import LoopReading, State
from mr_damper_ros.signals.arrays import Array


class ModifiedBoucWen(CurrentDependentModel):
    """A Bouc-Wen model in series with a damper, both in parallel with a spring."""

    name = "modified_bouc_wen"
    title = "modified Bouc–Wen"
    source = "Spencer, Dyke, Sain and Carlson, J. Engineering Mechanics 123, 1997; thesis eq. 3-6"
    equation = (
        r"F = c_1 \dot y + k_1 u + f_0,\quad"
        r" \dot y = \frac{\alpha z + c_0 v + k_0 (u - y)}{c_0 + c_1},\quad"
        r" \dot z = \left(w - |z|^n (s w + (1 - s) |w| \operatorname{sgn} z)\right) / u_y,"
        r"\quad w = v - \dot y"
    )
    at_one_current = (
        Coefficient("c0", "N s/m", 0.0, degree=1, meaning="damping at high velocity"),
        Coefficient("k0", "N/m", 0.0, meaning="inner stiffness"),
        Coefficient("c1", "N s/m", 1e-3, degree=1, meaning="damping in series"),
        Coefficient("k1", "N/m", meaning="stiffness of the gas"),
        Coefficient("f0", "N", meaning="constant force"),
        *HYSTERESIS,
    )
    remembers = True
    memory = 3

    def force_at(
        self, coefficients: Sequence[Array], motion: Motion, period: float, state: State | None
    ) -> tuple[Array, State]:
        """Force [N]; remembered are z, the inner spring's length and the last velocity."""
        outer_damping, stiffness, offset = coefficients[2:5]
        inner, kept = integrated(_inner_velocity, coefficients, motion, period, state, self.memory)
        return np.asarray(outer_damping * inner + stiffness * motion.displacement + offset), kept

    def memory_length(self, parameters: Array, current: float) -> float:
        """Some ways to the yield."""
        return memory_length(self, parameters, current)

    def starts_at_one_current(self, reading: LoopReading) -> Array:
        """Mostly yield, early or late, in series with a soft or a stiff damper."""
        force, middle, speed, amplitude = reading
        viscous = force / speed
        return np.array(
            [
                [0.2 * viscous, 0.0, stiff * viscous, 0.0]
                + [middle, 0.8 * force, part * amplitude, 0.5, 1.5]
                for stiff in (2.0, 8.0)
                for part in (0.01, 0.1)
            ]
        )


def _inner_velocity(
    coefficients: list[Array], motion: Motion, period: float, memory: list[float]
) -> Array:
    """Velocity [m/s] of the inner point, shape (n,).

    The memory holds z, the displacement s of the rod against the inner point, and the velocity of
    the last sample. Only s enters the equations, so the centre of the motion may move.
    """
    # The dampings, the force of full yield and the way to it may follow the current.
    c0s, c1s, alphas, lengths = (coefficients[place] for place in (0, 2, 5, 6))
    k0, share, power = (float(coefficients[place][0]) for place in (1, 7, 8))
    rates = -0.5 * period * k0 / (c0s + c1s)
    easings = 0.5 * period * np.array([relaxation(rate) for rate in rates.tolist()])
    each = motion.velocity, c0s, c0s + c1s, alphas, easings, lengths
    velocity, *numbers = np.broadcast_arrays(*each)
    given = velocity, np.stack(numbers, axis=-1)
    (inner,), memory[:] = run_loop(
        follow_inner_point, (hysteresis_step,), given, 1, period, k0, share, power, *memory
    )
    return inner
