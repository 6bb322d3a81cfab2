"""The nonlinear hysteretic biviscous model of Wereley, Pang and Kamath (1998)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.current_dependence import Coefficient, CurrentDependentModel
from mr_damper_ros.models.quantities import LoopReading, State
from mr_damper_ros.signals.arrays import Array


class NonlinearBiviscous(CurrentDependentModel):
    """Two post-yield lines, and between them a steep line for each branch of the loop."""

    name = "nonlinear_biviscous"
    title = "nonlinear biviscous"
    source = "Wereley, Pang and Kamath, J. Intelligent Material Systems and Structures 9, 1998"
    equation = (
        r"F = \min(\max(c_\mathrm{pre} (v - \operatorname{sgn}(a) v_0), c_\mathrm{post} v - f_y),"
        r" c_\mathrm{post} v + f_y) + f_0"
    )
    at_one_current = (
        Coefficient("c_post", "N s/m", 0.0, degree=1, meaning="damping after the yield"),
        Coefficient("c_pre", "N s/m", 0.0, degree=1, meaning="damping before the yield"),
        Coefficient("f_y", "N", 0.0, degree=2, meaning="yield force"),
        Coefficient("v0", "m/s", meaning="hysteresis velocity"),
        Coefficient("f0", "N", meaning="constant force"),
    )

    def force_at(
        self, coefficients: Sequence[Array], motion: Motion, period: float, state: State | None
    ) -> tuple[Array, State]:
        """Force [N]; it remembers nothing."""
        c_post, c_pre, f_y, v0, f0 = coefficients
        v = motion.velocity
        # Between the two post-yield lines the force follows the pre-yield line of its branch.
        pre = c_pre * (v - np.sign(motion.acceleration) * v0)
        return np.asarray(np.minimum(np.maximum(pre, c_post * v - f_y), c_post * v + f_y) + f0), ()

    def starts_at_one_current(self, reading: LoopReading) -> Array:
        """Some steepness between the lines, some width of the loop."""
        force, middle, speed, _ = reading
        return np.array(
            [
                [0.2 * force / speed, steepness * force / speed, 0.8 * force, shift * speed, middle]
                for steepness in (3.0, 10.0)
                for shift in (0.1, 0.3)
            ]
        )
