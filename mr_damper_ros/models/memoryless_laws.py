"""Laws without memory: Bingham, hyperbolic tangent, nonlinear biviscous."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.current_dependence import CurrentDependentModel
from mr_damper_ros.models.quantities import Coefficient, LoopReading, State
from mr_damper_ros.signals.arrays import Array


class Bingham(CurrentDependentModel):
    """Yield force, viscous damping, and a constant gas force."""

    name = "bingham"
    title = "Bingham"
    source = "Stanway, Sproston and Stevens, J. Electrostatics 20, 1987"
    equation = r"F = f_y \operatorname{sgn} v + c_0 v + f_0"
    at_one_current = (
        Coefficient("f_y", "N", 0.0, degree=2, meaning="yield force"),
        Coefficient("c0", "N s/m", 0.0, degree=1, meaning="viscous damping"),
        Coefficient("f0", "N", meaning="constant force"),
    )

    def force_at(
        self, coefficients: Sequence[Array], motion: Motion, period: float, state: State | None
    ) -> tuple[Array, State]:
        """Force [N]; the state is empty."""
        f_y, c0, f0 = coefficients
        v = motion.velocity
        return np.asarray(f_y * np.sign(v) + c0 * v + f0), ()

    def starts_at_one_current(self, reading: LoopReading) -> Array:
        """One start, dominated by the yield force."""
        force, middle, speed, _ = reading
        return np.array([[0.8 * force, 0.2 * force / speed, middle]])


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
        """Force [N]; the state is empty."""
        c, k, alpha, beta, delta, f0 = coefficients
        v, u = motion.velocity, motion.displacement
        return np.asarray(c * v + k * u + alpha * np.tanh(beta * v + delta * np.sign(u)) + f0), ()

    def starts_at_one_current(self, reading: LoopReading) -> Array:
        """Starts with different values of steepness and hysteresis."""
        force, middle, speed, _ = reading
        return np.array(
            [
                [0.2 * force / speed, 0.0, 0.8 * force, steepness / speed, hysteresis, middle]
                for steepness in (2.0, 8.0)
                for hysteresis in (0.3, 1.0)
            ]
        )


class NonlinearBiviscous(CurrentDependentModel):
    """Two post-yield lines, connected by a steep line for each branch of the loop."""

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
        """Force [N]; the state is empty."""
        c_post, c_pre, f_y, v0, f0 = coefficients
        v = motion.velocity
        # Between the two post-yield lines the force follows the pre-yield line of its branch.
        pre = c_pre * (v - np.sign(motion.acceleration) * v0)
        return np.asarray(np.minimum(np.maximum(pre, c_post * v - f_y), c_post * v + f_y) + f0), ()

    def starts_at_one_current(self, reading: LoopReading) -> Array:
        """Starts with different slopes between the post-yield lines, and different loop widths."""
        force, middle, speed, _ = reading
        return np.array(
            [
                [0.2 * force / speed, steepness * force / speed, 0.8 * force, shift * speed, middle]
                for steepness in (3.0, 10.0)
                for shift in (0.1, 0.3)
            ]
        )
