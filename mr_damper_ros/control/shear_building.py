"""Three storeys on shaking ground, with dampers between ground and first floor.

The buildings of the hybrid simulations of the Universidad Técnica Federico Santa María: masses,
stiffness, damping, controller and criteria are those that D. Maurel published with his scripts
(github.com/DanielMaurelE/vRTHS_AMBC_MRdamper, folders Cap8_DisenoControlMR and Cap10_vRTHS); the
stiffness is that of the benchmark of Silva, Gomez, Maghareh, Dyke and Spencer, Mechanical Systems
and Signal Processing 135, 2020.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mr_damper_ros.control.linear_plant import LinearPlant
from mr_damper_ros.signals.arrays import Array

STOREYS = 3

_STIFFNESS = 1e7 * np.array(
    [[2.6055, -2.3134, 0.5937], [-2.3134, 3.2561, -1.4420], [0.5937, -1.4420, 0.9267]]
)
"""[N/m]."""


@dataclass(frozen=True)
class ShearBuilding:
    """A ``mass`` [kg] on each floor, and the same ``damping`` ratio [1] of every mode.

    States: displacements [m] and velocities [m/s] of the three floors against the ground.
    """

    mass: float
    damping: float

    @property
    def dynamics(self) -> Array:
        """Matrix (6, 6) of the states' derivatives."""
        squares, modes = np.linalg.eigh(_STIFFNESS / self.mass)
        by_velocity = modes @ np.diag(2.0 * self.damping * np.sqrt(squares)) @ modes.T
        return np.block(
            [
                [np.zeros((STOREYS, STOREYS)), np.eye(STOREYS)],
                [-_STIFFNESS / self.mass, -by_velocity],
            ]
        )

    @property
    def by_force(self) -> Array:
        """What a force that pulls the first floor back adds to them (6,)."""
        return np.array([0.0, 0.0, 0.0, -1.0 / self.mass, 0.0, 0.0])

    @property
    def plant(self) -> LinearPlant:
        """The building, moved by the acceleration of the ground [m/s²]."""
        return LinearPlant(
            self.dynamics,
            self.by_force,
            by_input=np.array([0.0, 0.0, 0.0, -1.0, -1.0, -1.0]),
            displacement=np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
            velocity=np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]),
        )


BUILDINGS = {
    "I": ShearBuilding(1000.0, 0.05),
    "II": ShearBuilding(1100.0, 0.04),
    "III": ShearBuilding(1300.0, 0.03),
}
