"""The Bouc-Wen model of an MR damper."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.current_dependence import Coefficient
from mr_damper_ros.models.hysteresis import (
    HYSTERESIS,
    follow_yield,
    hysteresis_step,
    integrated,
    memory_length,
    step_derivatives,
)
from mr_damper_ros.models.known_derivatives import (
    DifferentiatedModel,
    accumulated,
    along,
    at_samples,
    driven,
)
from mr_damper_ros.models.machine_code import as_machine_code, run_loop
from mr_damper_ros.models.quantities import LoopReading, State
from mr_damper_ros.signals.arrays import Array


class BoucWen(DifferentiatedModel):
    """A damper, a spring and a hysteresis in parallel."""

    name = "bouc_wen"
    title = "Bouc–Wen"
    source = "Spencer, Dyke, Sain and Carlson, J. Engineering Mechanics 123, 1997; thesis eq. 1-2"
    equation = (
        r"F = c_0 v + k_0 u + f_0 + \alpha z,\quad"
        r" \dot z = \left(v - |z|^n (s v + (1 - s) |v| \operatorname{sgn} z)\right) / u_y"
    )
    at_one_current = (
        Coefficient("c0", "N s/m", 0.0, degree=1, meaning="viscous damping"),
        Coefficient("k0", "N/m", meaning="stiffness"),
        Coefficient("f0", "N", meaning="constant force"),
        *HYSTERESIS,
    )
    remembers = True
    memory = 2

    def force_at(
        self, coefficients: Sequence[Array], motion: Motion, period: float, state: State | None
    ) -> tuple[Array, State]:
        """Force [N]; remembered are z and the velocity of the last sample."""
        damping, stiffness, offset, strength, *hysteresis = coefficients
        z, kept = integrated(_yielded, hysteresis, motion, period, state, self.memory)
        viscous = damping * motion.velocity + stiffness * motion.displacement
        return np.asarray(viscous + offset + strength * z), kept

    def memory_length(self, parameters: Array, current: float) -> float:
        """Some ways to the yield."""
        return memory_length(self, parameters, current)

    @as_machine_code()
    @np.errstate(over="ignore", invalid="ignore")
    def window_derivatives(
        self, window: Window, parameters: Array, columns: Sequence[int]
    ) -> Array:
        """Derivatives (n, p) of :meth:`window_force` by the parameters of some columns."""
        motion, period, values, chain = along(self, window, parameters, columns)
        strength, length, share, power = values[3:]
        z = _yielded([length, share, power], motion, period, [math.nan, math.nan])
        steps = step_derivatives(z, motion.velocity, length, share, power, period)
        added = driven(dict(enumerate(steps[1:], start=4)), chain)
        result = chain[2] + strength[:, np.newaxis] * accumulated(steps.kept, added)
        for place, by in ((0, motion.velocity), (1, motion.displacement), (3, z)):
            result += by[:, np.newaxis] * chain[place]
        return at_samples(window, result)

    def starts_at_one_current(self, reading: LoopReading) -> Array:
        """Mostly yield, after a twentieth or a fifth of the amplitude."""
        force, middle, speed, amplitude = reading
        return np.array(
            [
                [0.2 * force / speed, 0.0, middle, 0.8 * force, part * amplitude, 0.5, 1.5]
                for part in (0.05, 0.2)
            ]
        )


def _yielded(
    coefficients: list[Array], motion: Motion, period: float, memory: list[float]
) -> Array:
    """State z at the samples, shape (n,); the memory holds the last z and the last velocity."""
    share, power = (float(c[0]) for c in coefficients[1:])
    lengths = np.broadcast_to(coefficients[0], motion.velocity.shape)
    given = motion.velocity, lengths
    (states,), memory[:] = run_loop(
        follow_yield, (hysteresis_step,), given, 1, period, share, power, *memory
    )
    return states
