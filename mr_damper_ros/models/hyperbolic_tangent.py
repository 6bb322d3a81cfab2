"""The hysteretic hyperbolic-tangent model of Kwok et al. (2006)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.current_dependence import Coefficient, CurrentDependentModel
from mr_damper_ros.models.quantities import LoopReading, State
from mr_damper_ros.signals.arrays import Array


class HyperbolicTangent(CurrentDependentModel):
    """A damper, a spring and a hysteresis that is a hyperbolic tangent of the velocity."""

    name = "hyperbolic_tangent"
    title = "hyperbolic tangent"
    source = "Kwok, Ha, Nguyen, Li and Samali, Sensors and Actuators A 132, 2006"
    equation = r"F = c v + k u + \alpha \tanh(\beta v + \delta \operatorname{sgn} u) + f_0"
    at_one_current = (
        Coefficient("c", "N s/m", degree=1, meaning="viscous damping"),
        Coefficient("k", "N/m", degree=1, meaning="stiffness"),
        Coefficient("alpha", "N", 0.0, degree=2, meaning="yield force"),
        Coefficient("beta", "s/m", 0.0, meaning="steepness"),
        Coefficient("delta", "1", degree=1, meaning="width of the hysteresis"),
        Coefficient("f0", "N", degree=1, meaning="constant force"),
    )

    def force_at(
        self, coefficients: Sequence[Array], motion: Motion, period: float, state: State | None
    ) -> tuple[Array, State]:
        """Force [N]; it remembers nothing."""
        c, k, alpha, beta, delta, f0 = coefficients
        v, u = motion.velocity, motion.displacement
        return np.asarray(c * v + k * u + alpha * np.tanh(beta * v + delta * np.sign(u)) + f0), ()

    def starts_at_one_current(self, reading: LoopReading) -> Array:
        """Some steepness and some hysteresis."""
        force, middle, speed, _ = reading
        return np.array(
            [
                [0.2 * force / speed, 0.0, 0.8 * force, steepness / speed, hysteresis, middle]
                for steepness in (2.0, 8.0)
                for hysteresis in (0.3, 1.0)
            ]
        )
