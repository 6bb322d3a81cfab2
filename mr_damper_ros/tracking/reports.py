"""What became of a window or of a global identification, for others to read."""

from __future__ import annotations

from dataclasses import dataclass, field

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.fluid_temperature import FluidTemperature
from mr_damper_ros.tracking.force_scale import ForceScale


@dataclass(frozen=True, eq=False)
class Report:
    """Outcome of one window or one global identification, as published; SI units.

    ``temperature`` is the measured one; where there is none, ``fluid`` is what the force tells of
    it, once a map of force over temperature has been learnt at the operating point.
    """

    window_start_ns: int
    stamp_ns: int
    sample_count: int
    method: str
    evaluations: int
    nrmse_before: float
    nrmse_after: float
    accepted: bool
    reason: str
    set_id: str
    scale: ForceScale
    peak_velocity: float
    amplitude: float
    frequency: float
    current: float
    temperature: float
    coefficients: Array
    coefficient_errors: Array
    global_due: bool
    fluid: FluidTemperature = field(default_factory=FluidTemperature)
