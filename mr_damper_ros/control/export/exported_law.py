"""What every format of an export is made from: constants, formulas, observer, nodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mr_damper_ros.control.inverse_model import in_coil
from mr_damper_ros.kinematics.observer import (
    closed_loop,
    possible_bandwidths,
    settling_samples,
)
from mr_damper_ros.models.formulas import WrittenLaw
from mr_damper_ros.models.parameter_set import ParameterSet, SpokenError
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import Array

_SATURATED, _BEYOND = 0.1, 1e4
"""Part of the points of a table that are beyond all measure, and by how much."""


class ExportError(SpokenError):
    """A set that cannot be exported; the message says why, and what to change."""


@dataclass(frozen=True)
class ExportSettings(CheckedSettings):
    """For what kind of controller the code is made."""

    period: float = option(1e-3, "Time between two samples [s].", minimum=1e-6, maximum=1.0)
    bandwidth: float = option(
        40.0,
        "Bandwidth [Hz] of the observer of velocity and acceleration.",
        minimum=0.001,
        maximum=1e5,
    )
    lowest_current: float = option(
        0.0, "Lowest current [A] of the inverse.", minimum=-10.0, maximum=10.0
    )
    highest_current: float = option(
        2.0, "Highest current [A] of the inverse.", minimum=-10.0, maximum=10.0
    )


@dataclass(frozen=True, eq=False)
class ExportedLaw:
    """A parameter set, written for a controller of one sample period."""

    parameters: ParameterSet
    settings: ExportSettings
    formulas: WrittenLaw
    constants: dict[str, float]
    observer: Array
    """Matrix (4, 4) of the states of the observer."""
    observer_gain: Array
    """And what a sample adds to them, (4,)."""
    settling: int
    """Samples after which the observer has forgotten its start."""
    nodes: Array
    """Currents [A] at which the inverse looks first."""

    @classmethod
    def of(cls, parameters: ParameterSet, settings: ExportSettings) -> ExportedLaw:
        """Raises ExportError where the model has no formulas, or the settings do not fit."""
        formulas = parameters.law.formulas
        if formulas is None:
            raise ExportError(
                f"model '{parameters.model}' cannot be exported: identify the damper with one of "
                "the sigmoid laws, sigmoid or sigmoid_lag"
            )
        lowest, highest = possible_bandwidths(settings.period)
        if not lowest <= settings.bandwidth <= highest:
            raise ExportError(
                f"the bandwidth is {settings.bandwidth:g} Hz: samples {settings.period:g} s apart "
                f"allow {lowest:g} to {highest:g} Hz"
            )
        low, high = settings.lowest_current, settings.highest_current
        if not low < high:
            raise ExportError(
                f"the highest current, {high:g} A, is not above the lowest, {low:g} A"
            )
        matrix, gain = closed_loop(settings.period, settings.bandwidth)
        return cls(
            parameters,
            settings,
            formulas,
            formulas.constants(parameters.values),
            matrix,
            gain,
            settling_samples(settings.period, settings.bandwidth),
            parameters.law.current_nodes(in_coil(parameters), low, high),
        )

    @property
    def held(self) -> tuple[float, float]:
        """Peak velocities [m/s] within which the law is held."""
        low, high = self.parameters.peak_velocity_range
        return low, high

    @property
    def provenance(self) -> str:
        """What a reader of the code should know of the set, in a line."""
        low, high = self.parameters.peak_velocity_range
        doubt = self.parameters.doubt_over_current
        return (
            f"set {self.parameters.set_id} of model {self.parameters.model}, peak velocity "
            f"{low:.4g} to {high:.4g} m/s, current {self.parameters.current_range[0]:.4g} to "
            f"{self.parameters.current_range[1]:.4g} A" + (f"; WARNING: {doubt}" if doubt else "")
        )


@dataclass(frozen=True, eq=False)
class Vectors:
    """Points of the law, saturated ones among them: inputs (n, 5), coefficients (7, n), force (n,).

    Columns of the inputs: v, v_m, i, s, change.
    """

    inputs: Array
    coefficients: Array
    force: Array

    @classmethod
    def of(cls, law: ExportedLaw, count: int, seed: int = 0) -> Vectors:
        """Random points."""
        rng = np.random.default_rng(seed)
        size = np.where(rng.random(count) < _SATURATED, _BEYOND, 1.0)
        v = size * rng.uniform(-0.5, 0.5, count)
        v_m = np.abs(v) + size * np.abs(rng.normal(0.0, 0.1, count))
        current = size * rng.uniform(-0.5, 3.0, count)
        last = rng.uniform(-1.0, 1.0, count)
        change = size * rng.normal(0.0, 0.02, count)
        inputs = np.column_stack((v, v_m, current, last, change))
        return cls(inputs, *law.formulas.expected(law.parameters.values, inputs))

    def csv(self) -> str:
        """As a table, to the last digit."""
        header = "v,v_m,i,s,change,f_t,alpha,k_c,k_e,v_h,v_d,f_d,force"
        rows = np.column_stack((self.inputs, self.coefficients.T, self.force))
        return "\n".join([header, *(",".join(map(repr, row)) for row in rows.tolist())]) + "\n"


def number(value: float) -> str:
    """A number as C and M-code take it; what is infinite becomes 1e100."""
    return repr(min(max(float(value), -1e100), 1e100))
