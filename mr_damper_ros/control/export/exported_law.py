"""Common content of all export formats: constants, formulas, observer, inverse nodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mr_damper_ros.control.inverse_model import NODES
from mr_damper_ros.kinematics.observer import closed_loop, possible_bandwidths, settling_samples
from mr_damper_ros.models.formulas import staged
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import Array

_SATURATED, _BEYOND = 0.1, 1e4
"""Fraction of the test vectors with extreme values, and the factor on these values."""


@dataclass(frozen=True)
class ExportSettings(CheckedSettings):
    """Options of the target controller."""

    period: float = option(1e-3, "Time between two samples [s].", within=(1e-6, 1.0))
    bandwidth: float = option(
        40.0, "Bandwidth [Hz] of the observer of velocity and acceleration.", within=(0.001, 1e5)
    )
    lowest_current: float = option(0.0, "Lowest current [A] of the inverse.", within=(-10.0, 10.0))
    highest_current: float = option(
        2.0, "Highest current [A] of the inverse.", within=(-10.0, 10.0)
    )


class ExportedLaw:
    """A parameter set prepared for a controller with a fixed sample period.

    ``constants`` are the parameters of the ``formulas`` by name. The observer has the state matrix
    ``observer`` (4, 4) and the input vector ``observer_gain`` (4,); it settles within ``settling``
    samples. ``nodes`` [A] are the nodes of the inverse. ``held``: range [m/s] to which the law
    limits v_m. Raises ValueError if the model has no formulas or the settings are invalid.
    """

    def __init__(self, parameters: ParameterSet, settings: ExportSettings) -> None:
        formulas = parameters.law.formulas
        if formulas is None:
            raise ValueError(
                f"model '{parameters.model}' cannot be exported: identify the damper with one of "
                "the sigmoid laws, sigmoid or sigmoid_lag"
            )
        period, bandwidth = settings.period, settings.bandwidth
        lowest, highest = possible_bandwidths(period)
        if not lowest <= bandwidth <= highest:
            raise ValueError(
                f"the bandwidth is {bandwidth:g} Hz: samples {period:g} s apart allow {lowest:g} "
                f"to {highest:g} Hz"
            )
        low, high = settings.lowest_current, settings.highest_current
        if not low < high:
            raise ValueError(f"the highest current, {high:g} A, is not above the lowest, {low:g} A")
        self.parameters, self.settings = parameters, settings
        self.formulas = formulas
        self.constants = dict.fromkeys(formulas.parameter_names, 0.0) | parameters.as_dict()
        self.observer, self.observer_gain = closed_loop(period, bandwidth)
        self.settling = settling_samples(period, bandwidth)
        self.nodes = np.linspace(low, high, NODES)
        self.held = parameters.held_range

    def expected(self, inputs: Array) -> tuple[Array, Array]:
        """Coefficients (7, n) and force (n,) for inputs (n, 5): v, v_m, i, s, change."""
        names, coefficients, force, wanted = self.formulas
        stages = [names, ("v", "v_m", "i", "s", "change")]
        law = staged((*coefficients, *force), stages, (*wanted, "force"))
        v, v_m, *others = inputs.T
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            of_set = law(*(self.constants[name] for name in names))
            *found, forces = of_set(v, v_m.clip(*self.held), *others)
        return np.stack(np.broadcast_arrays(*found)), forces

    @property
    def provenance(self) -> str:
        """Description of the set in one line, for the header of the code."""
        (slow, fast), (low, high) = (
            self.parameters.peak_velocity_range,
            self.parameters.current_range,
        )
        doubt = self.parameters.doubt_over_current
        return (
            f"set {self.parameters.set_id} of model {self.parameters.model}, peak velocity "
            f"{slow:.4g} to {fast:.4g} m/s, current {low:.4g} to {high:.4g} A"
            + (f"; WARNING: {doubt}" if doubt else "")
        )


@dataclass(frozen=True, eq=False)
class Vectors:
    """Test vectors, some with extreme inputs: inputs (n, 5), coefficients (7, n), force (n,).

    Columns of the inputs: v, v_m, i, s, change.
    """

    inputs: Array
    coefficients: Array
    force: Array

    @classmethod
    def of(cls, law: ExportedLaw, count: int, seed: int = 0) -> Vectors:
        """Random test vectors."""
        rng = np.random.default_rng(seed)
        size = np.where(rng.random(count) < _SATURATED, _BEYOND, 1.0)
        v = size * rng.uniform(-0.5, 0.5, count)
        v_m = np.abs(v) + size * np.abs(rng.normal(0.0, 0.1, count))
        current = size * rng.uniform(-0.5, 3.0, count)
        last = rng.uniform(-1.0, 1.0, count)
        change = size * rng.normal(0.0, 0.02, count)
        inputs = np.column_stack((v, v_m, current, last, change))
        return cls(inputs, *law.expected(inputs))

    def csv(self) -> str:
        """The test vectors as CSV with full precision."""
        header = "v,v_m,i,s,change,f_t,alpha,k_c,k_e,v_h,v_d,f_d,force"
        rows = np.column_stack((self.inputs, self.coefficients.T, self.force))
        return "\n".join([header, *(",".join(map(repr, row)) for row in rows.tolist())]) + "\n"


def number(value: float) -> str:
    """A number in C and M-code syntax; infinity becomes 1e100."""
    return repr(min(max(float(value), -1e100), 1e100))
