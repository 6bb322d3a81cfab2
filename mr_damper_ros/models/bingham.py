"""The Bingham model: Coulomb friction and a viscous damper in parallel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.current_dependence import Coefficient, CurrentDependentModel
from mr_damper_ros.models.quantities import LoopReading, State
from mr_damper_ros.signals.arrays import Array


class Bingham(CurrentDependentModel):
    """Yield force, viscous damping, and the constant force of the gas."""

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
        """Force [N]; it remembers nothing."""
        f_y, c0, f0 = coefficients
        v = motion.velocity
        return np.asarray(f_y * np.sign(v) + c0 * v + f0), ()

    def starts_at_one_current(self, reading: LoopReading) -> Array:
        """Mostly friction."""
        force, middle, speed, _ = reading
        return np.array([[0.8 * force, 0.2 * force / speed, middle]])
