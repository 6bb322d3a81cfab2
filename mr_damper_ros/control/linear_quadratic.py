"""The linear-quadratic regulator, and the estimator for states that are not measured.

Anderson and Moore, Optimal Control: Linear Quadratic Methods, 1990. Clipped to what a damper can
give it is the clipped-optimal control of Dyke, Spencer, Sain and Carlson, Smart Materials and
Structures 5, 1996.
"""

from __future__ import annotations

import numpy as np

from mr_damper_ros.control.linear_plant import LinearPlant
from mr_damper_ros.signals.arrays import Array


def regulator_gain(
    plant: LinearPlant, outputs: Array, direct: Array, weights: Array, effort: float
) -> Array:
    """Gain (n,) with which F = -gain x costs least.

    The cost is the integral of the ``weights`` (k,) times the squares of the outputs, which are
    ``outputs`` (k, n) x + ``direct`` (k,) F, and ``effort`` F².
    """
    from scipy.linalg import solve_continuous_are  # here: see mr_damper_ros.entry_points

    states = outputs.T @ (weights[:, np.newaxis] * outputs)
    crossed = (outputs.T @ (weights * direct))[:, np.newaxis]
    squares = np.array([[float(weights @ direct**2) + effort]])
    column = plant.by_force[:, np.newaxis]
    cost = solve_continuous_are(plant.dynamics, column, states, squares, s=crossed)
    return np.asarray(np.linalg.solve(squares, column.T @ cost + crossed.T)[0])


class StateEstimator:
    """The Kalman filter, settled, of a plant whose outputs are read every ``period`` [s].

    The outputs are ``outputs`` (k, n) x + ``direct`` (k,) F; ``disturbance`` is the density of the
    plant's input, ``noise`` that of each output. The damper's force is known.
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
        from scipy.linalg import expm, solve_continuous_are  # here: see above

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
        """The states (n,) a period later, for a force [N] and outputs (k,) that hold."""
        self.states = self._step @ np.concatenate([self.states, (force,), outputs])
        return self.states
