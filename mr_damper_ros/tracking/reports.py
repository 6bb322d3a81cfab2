"""Reports on windows and global identifications, as the identifier publishes them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.force_scale import FluidTemperature, ForceScale

_LATE_CURRENT = 0.01
"""Time [s] by which the force may precede its current without a warning."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Report:
    """Outcome of one window or one global identification, as published; SI units, NaN = unknown.

    ``set_id`` names the set in use after the report. ``confirms`` says whether the samples up to
    ``stamp_ns`` fit this set. ``nrmse_before`` is the error in the window of the set used so far.
    ``reason`` explains the ``verdict`` in words. ``temperature`` [°C] is the measured temperature.
    If it is not measured, ``fluid`` is the temperature estimated from the force, once the operating
    point has a temperature map. ``current_lag`` [s] is the time by which the force follows the
    stamped current, 0 if it is not significant; it is negative for a current that is stamped or
    read too late. ``coefficient_errors`` are the standard errors from window to
    window; ``coefficient_discrepancies`` are the model errors.
    """

    window_start_ns: int
    stamp_ns: int
    set_id: str
    verdict: Verdict = Verdict.FAILED
    nrmse_before: float = math.nan
    confirms: bool = False
    sample_count: int = 0
    method: str = ""
    evaluations: int = 0
    nrmse_after: float = math.nan
    reason: str = ""
    scale: ForceScale = field(default_factory=ForceScale)
    peak_velocity: float = math.nan
    amplitude: float = math.nan
    frequency: float = math.nan
    current: float = math.nan
    temperature: float = math.nan
    coefficient_names: tuple[str, ...] = ()
    coefficients: Array = field(default_factory=lambda: np.empty(0))
    coefficient_errors: Array = field(default_factory=lambda: np.empty(0))
    coefficient_discrepancies: Array = field(default_factory=lambda: np.empty(0))
    global_due: bool = False
    fluid: FluidTemperature = field(default_factory=FluidTemperature)
    current_lag: float = 0.0
    current_lag_error: float = math.nan

    @property
    def accepted(self) -> bool:
        """Whether the report put a new set into use."""
        return self.verdict.accepted

    @property
    def known_coefficients(self) -> dict[str, tuple[float, float]]:
        """Value and standard error of each coefficient that is finite, by name."""
        pairs = zip(self.coefficients.tolist(), self.coefficient_errors.tolist(), strict=False)
        named = zip(self.coefficient_names, pairs, strict=False)
        return {name: pair for name, pair in named if math.isfinite(pair[0])}

    @property
    def late_current(self) -> str:
        """A sentence on a current that is stamped or read too late; empty if it is not."""
        late, error = -self.current_lag, self.current_lag_error
        if not late > _LATE_CURRENT:
            return ""
        return (
            f"the force changes {late:.3g} ± {error:.2g} s before the stamped current, which is "
            "shifted by this time: stamp the current when it is measured, read the supply without "
            "averaging, or synchronise the clocks of machine and supply"
        )

    @property
    def figures(self) -> list[str]:
        """The known figures, as text: NRMSE, motion, current, temperature and force scale."""
        errors = [x for x in (self.nrmse_before, self.nrmse_after) if math.isfinite(x)]
        figures = (
            (errors[0] if errors else math.nan, "NRMSE " + " -> ".join(f"{x:.2%}" for x in errors)),
            (1e3 * self.amplitude, "{:.3g} mm"),
            (self.frequency, "{:.3g} Hz"),
            (self.current, "{:.3g} A"),
            (self.temperature, "{:.1f} °C"),
            (self.scale.value, f"force scale {{:.4f}} ± {self.scale.standard_error:.2g}"),
        )
        return [text.format(value) for value, text in figures if math.isfinite(value)]

    @property
    def line(self) -> str:
        """The set in use with its known figures, in one line."""
        return f"{self.set_id} is in use: " + ", ".join(self.figures)
