"""The sigmoid law extended, as a model: lags of fluid and coil, stiffness, offset."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.coil import (
    COIL,
    PLAUSIBLE_COIL,
    coil_current,
    coil_parameter,
    coil_state,
    coil_unsettled,
    in_coil,
)
from mr_damper_ros.models.current_response import CurrentResponse, SampleResponses
from mr_damper_ros.models.first_order_lag import SETTLING, lagged
from mr_damper_ros.models.force_model import Model, State
from mr_damper_ros.models.quantities import LoopReading, Parameter
from mr_damper_ros.models.sigmoid.extension import (
    COMPLIANCE,
    EXTENDED_MODEL,
    EXTENSION_NAMES,
    SIGMOID_COUNT,
    Extension,
    LateForce,
    extension_of,
    force_and_damping,
    without_extension,
)
from mr_damper_ros.models.sigmoid.law import (
    SCALE_PARAMETER_NAMES,
    operating_point_coefficients,
)
from mr_damper_ros.models.sigmoid.sample_response import LateSampleResponses
from mr_damper_ros.models.sigmoid.scale_misfit import (
    coefficients_along,
    longest_lag,
)
from mr_damper_ros.models.sigmoid.sigmoid_model import SigmoidModel
from mr_damper_ros.models.sigmoid.sigmoid_response import late_response
from mr_damper_ros.models.sigmoid.sixteen import SIXTEEN
from mr_damper_ros.signals.arrays import Array

_USUAL_LAG = 0.02
"""Time constant [s] that a lag of coil and fluid hardly exceeds. Until it is known, what it may
hide at the begin of a window is left out."""


class ExtendedSigmoidModel(SigmoidModel):
    """The sixteen parameters with a compliance in series, stiffness, offset and a lagging coil."""

    name = EXTENDED_MODEL
    title = "sigmoid with lag, stiffness, offset"
    source = f"{SigmoidModel.source}; the extension is this package's"
    equation = (
        r"\tau \dot F_l + F_l = F_\mathrm{sigmoid},\quad"
        r" \tau = \mathrm{compliance} \cdot f_t \tanh(\alpha x / 2) / x,\quad"
        r" F = F_l + \mathrm{stiffness} \cdot u + \mathrm{offset}"
    )
    parameters = (
        *SIXTEEN,
        *(
            Parameter(name, unit, 0.0 if name == COMPLIANCE else -np.inf)
            for name, unit in zip(EXTENSION_NAMES, ("m/N", "N/m", "N"), strict=True)
        ),
        coil_parameter(),
    )
    free_in_one_run = (*SCALE_PARAMETER_NAMES, *EXTENSION_NAMES)
    remembers = True
    many_at_once = False

    @property
    def scale_names(self) -> tuple[str, ...]:
        """Those of the sigmoid law: the extension is common to all runs."""
        return SCALE_PARAMETER_NAMES

    def follow(
        self, parameters: Array, motion: Motion, current: Array, period: float, state: State | None
    ) -> tuple[Array, State]:
        """Force [N]; remembered are the sigmoid force, its lagged value and the time constant.

        Where the coil lags, the supply's and its current too.
        """
        coil = parameters[..., -1]
        own = None if state is None else state[self.turning :]
        remembered: State = ()
        if np.any(coil > 0.0):
            before = None if own is None else coil_state(own[3:])
            lagging = coil_current(current, coil, period, before)
            remembered = (np.full(coil.shape, current[-1]), lagging[..., -1])
            # The coefficients of a law come in pairs along the axis before the last.
            current = lagging if coil.ndim == 0 else lagging[..., np.newaxis, :]
        sixteen = parameters[..., :SIGMOID_COUNT]
        coefficients = operating_point_coefficients(sixteen, motion.peak_velocity, current)
        coefficients, acceleration, turning = self._turned(coefficients, motion, state)
        plain, damping = force_and_damping(coefficients, motion.velocity, acceleration)
        extension = Extension(*np.moveaxis(parameters[..., SIGMOID_COUNT:-1, np.newaxis], -2, 0))
        time_constant = extension.time_constant(damping)
        late = lagged(plain, time_constant, period, state=None if own is None else own[:3])
        force = np.asarray(late + extension.stiffness * motion.displacement + extension.offset)
        own = (plain[..., -1], late[..., -1], time_constant[..., -1], *remembered)
        return force, (*turning, *own)

    @property
    def simpler(self) -> Model:
        """The sixteen-parameter law."""
        return SigmoidModel()

    def to_simpler(self, values: Array) -> Array:
        """The sixteen parameters (16,)."""
        return values[:SIGMOID_COUNT]

    def from_simpler(self, simple: Array) -> Array:
        """Without lag, stiffness and offset."""
        return without_extension(simple)

    def response(
        self, parameters: Array, motion: Motion, period: float, state: State | None
    ) -> CurrentResponse:
        """That of the sigmoid law, late."""
        own = None if state is None else state[self.turning :]
        return late_response(parameters, motion, self._branch(motion, state), period, own)

    def sample_responses(self, parameters: Array, nodes: Array) -> SampleResponses:
        """In plain numbers."""
        return LateSampleResponses(self, parameters, nodes)

    def starts(self, reading: LoopReading) -> Array:
        """Those of the sigmoid law with a small compliance."""
        plain = super().starts(reading)
        compliance = 0.02 * reading.amplitude / reading.force
        return np.hstack([plain, np.tile([compliance, 0.0, 0.0, 0.0], (len(plain), 1))])

    def initial_values(self) -> tuple[Array, str, float]:
        """The set from the literature, without lag, stiffness and offset."""
        values, name, speed = super().initial_values()
        return without_extension(values), name, speed

    def window_force(self, window: Window, parameters: Array) -> Array:
        """Force [N] at the samples of a window, shape (..., n), for parameters (..., 20)."""
        if parameters.ndim > 1:
            sets = parameters.reshape(-1, parameters.shape[-1])
            forces = np.array([self.window_force(window, one) for one in sets])
            return forces.reshape(*parameters.shape[:-1], window.sample_count)
        window = in_coil(window, float(parameters[-1]))
        sixteen = parameters[:SIGMOID_COUNT]
        history = window.history
        past = force_and_damping(*coefficients_along(sixteen, history.motion, history.current))
        late = LateForce(history, past, extension_of(parameters))
        plain = partial(super().window_force, window, sixteen)
        return late.force(window.motion.displacement, plain)

    def settled(self, window: Window, parameters: Array) -> np.ndarray:
        """Mask (n,) of samples at which lag and coil have forgotten the past before the window."""
        unsettled = window.history.unsettled(SETTLING * longest_lag([window], parameters))
        return ~(unsettled | coil_unsettled(window, float(parameters[-1])))

    def plausible_ranges(
        self, windows: Sequence[Window], top_velocity: float, top_current: float
    ) -> dict[str, tuple[float, float]]:
        """Those of the sigmoid law, and of the extension from what the data span.

        The compliance gives way to the force by no more than the amplitude of any window; the
        stiffness and the offset make no more than all of the force in it.
        """
        forces = [float(np.max(np.abs(window.force))) for window in windows]
        stiffnesses = [
            force / window.motion.amplitude for force, window in zip(forces, windows, strict=True)
        ]
        return {
            **super().plausible_ranges(windows, top_velocity, top_current),
            COMPLIANCE: (0.0, 1.0 / max(stiffnesses)),
            "stiffness": (-min(stiffnesses), min(stiffnesses)),
            "offset": (-min(forces), min(forces)),
            COIL: (0.0, PLAUSIBLE_COIL),
        }

    def _slowest_lag(self, windows: Sequence[Window], known: Array | None) -> float:
        return _USUAL_LAG if known is None else max(longest_lag(windows, known), known[-1])
