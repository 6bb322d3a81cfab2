"""Buildings with dampers, and the estimator of their states.

The buildings are those of the hybrid simulations of the Universidad Técnica Federico Santa María:
masses, stiffness, damping, controller and criteria are those that D. Maurel published with his
scripts (github.com/DanielMaurelE/vRTHS_AMBC_MRdamper, folders Cap8_DisenoControlMR and
Cap10_vRTHS); the stiffness is that of the benchmark of Silva, Gomez, Maghareh, Dyke and Spencer,
Mechanical Systems and Signal Processing 135, 2020. The estimator is that of Anderson and Moore,
Optimal Control: Linear Quadratic Methods, 1990. The damper was identified by this package from the
twenty sinusoid records of an MR damper in the same repository (MIT licence, © 2022 mequiroz). Their
currents are constant, so they give no information about the coil.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm, solve_continuous_are

from mr_damper_ros.control.linear_plant import LinearPlant
from mr_damper_ros.models.parameter_set import ParameterSet
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
        """Contribution (6,) of a restoring force on the first floor to these derivatives."""
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


class StateEstimator:
    """Steady-state Kalman filter of a plant whose outputs are sampled every ``period`` [s].

    The outputs are ``outputs`` (k, n) x + ``direct`` (k,) F. ``disturbance`` is the noise density
    of the input of the plant, and ``noise`` that of each output. The force of the damper is known.
    """

    def __init__(
        self,
        plant: LinearPlant,
        outputs: Array,
        direct: Array,
        *,
        disturbance: float,
        noise: float,
        period: float,
    ) -> None:
        count, read = plant.by_force.size, direct.size
        density = disturbance * np.outer(plant.by_input, plant.by_input)
        error = solve_continuous_are(plant.dynamics.T, outputs.T, density, noise * np.eye(read))
        gain = error @ outputs.T / noise
        whole = np.zeros((count + 1 + read, count + 1 + read))
        whole[:count, :count] = plant.dynamics - gain @ outputs
        whole[:count, count] = plant.by_force - gain @ direct
        whole[:count, count + 1 :] = gain
        self._step = expm(period * whole)[:count]
        self.states = np.zeros(count)

    def follow(self, force: float, outputs: Array) -> Array:
        """The states (n,) one period later, for a constant force [N] and constant outputs (k,)."""
        self.states = self._step @ np.concatenate([self.states, (force,), outputs])
        return self.states


_DAMPER = (
    *(64.595135, -0.47949810, 0.492, 695.36189, 0.036241897, 3.2626734, 82.907410, -9.4422296),
    *(73.941558, 3.6203654, 3.8709135, 10.685450, -67.9, -0.043652854, -0.014642521, -0.014359756),
    *(1.5061225e-07, 797.75380, -0.34959565),
)
"""Values of the law in the order of its parameters, without the time constant of the coil."""


def recorded_damper(coil_time_constant: float) -> ParameterSet:
    """Parameter set of the damper, with the time constant of the coil [s]."""
    return ParameterSet(
        np.array([*_DAMPER, coil_time_constant]),
        set_id="recorded",
        model="sigmoid_lag",
        peak_velocity_range=(0.0148, 0.0630),
        current_range=(0.0, 1.0),
    )
