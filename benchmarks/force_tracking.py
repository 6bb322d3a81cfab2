"""A desired force in the emulated rig: random motion, a lagging coil, and a damper that heats."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.figure import Figure
from benchmarks.other_dampers import random_motion
from mr_damper_ros.control.force_controller import Command, ForceController, ForceControlSettings
from mr_damper_ros.emulation.commanded_rig import ForceChoice, turned
from mr_damper_ros.emulation.emulator import (
    EmulatedRig,
    ModelDamper,
    RigSettings,
    SupplyKnob,
    ThermalModel,
)
from mr_damper_ros.emulation.plant_rig import HIGHEST_CURRENT, HOT_FORCE, invented_damper
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import RigBlock
from mr_damper_ros.tracking.engine import Engine

VALUES = invented_damper(0.01).as_dict()

DAMPER = replace(invented_damper(0.01), set_id="cold", peak_velocity_range=(0.0, 0.5))
"""An invented damper in the size of the thesis', whose coil lags by 10 ms, as if identified at
28 °C: what is known of it is the truth."""

DEMAND = 9000.0
"""Damping [N s/m] that is wanted: a force that always resists the motion."""

BLOCK = 10
PERIOD = 1e-3
SETTLED = 5.0
"""Seconds after which motion and peak velocity are known."""

_COLD, _HOT = 28.0, 71.0


@dataclass(frozen=True, eq=False)
class Tracking:
    """Samples (n,) whose desired force could be had: time [s], desired and true force [N]."""

    time: Array
    wanted: Array
    force: Array
    spread: float
    share: float

    def nrmse(self, begin: float, end: float) -> float:
        """RMSE over the standard deviation of all of the force, between two times [s]."""
        chosen = (self.time >= begin) & (self.time < end)
        error = (self.force - self.wanted)[chosen]
        return float(np.sqrt(np.mean(error**2))) / self.spread


def tracked(duration: float, *, hot: bool, learns: bool, seed: int = 0) -> Tracking:
    """Track the demand for ``duration`` [s], at 28 °C, or at 71 °C where ``hot``.

    ``learns``: with the set that is identified meanwhile, else with that of 28 °C.
    """
    celsius = _HOT if hot else _COLD
    knob = SupplyKnob(0.0)
    rig = EmulatedRig(
        ModelDamper(DAMPER, PERIOD, HOT_FORCE),
        random_motion(0.004, 0.5, 3.0, duration, seed=seed),
        knob.schedule,
        settings=RigSettings(displacement_noise=1e-6, seed=seed),
        # So much heat capacity that it stays as it is.
        thermal=ThermalModel(ambient=celsius, initial=celsius, capacity=1e9),
    )
    rig.live = True
    controller = ForceController(ForceControlSettings(highest_current=HIGHEST_CURRENT))
    controller.set_parameters(DAMPER)

    def wanted(made: RigBlock) -> float:
        return DEMAND * float(made.displacement[-1] - made.displacement[0]) / (PERIOD * (BLOCK - 1))

    choice = ForceChoice(controller, wanted, Engine(start=DAMPER) if learns else None)
    rows, forces, before = [], [], None
    for number, (made, _) in enumerate(turned(rig, knob, choice, BLOCK, duration), start=1):
        rows.append(_row(number * BLOCK * PERIOD, before, made.force))
        forces.append(made.force)
        before = choice.last
    every = np.concatenate(rows, axis=1)
    late = every[:, every[0] > SETTLED]
    met = late[:, late[3] > 0.0]
    spread = float(np.std(np.concatenate(forces)[round(SETTLED / PERIOD) :]))
    return Tracking(met[0], met[1], met[2], spread, met.shape[1] / late.shape[1])


def _row(now: float, command: Command | None, force: Array) -> Array:
    """Time, desired and measured force of a block, and whether the desired one could be had."""
    valid = command is not None and not command.doubt
    wanted = command.wanted if command is not None and valid else np.nan
    met = float(command is not None and valid and command.attainable)
    return np.stack([np.full(BLOCK, v) for v in (now, wanted)] + [force, np.full(BLOCK, met)])


def figures(duration: float = 24.0) -> list[Figure]:
    """``force_tracking_nrmse_percent`` and its growth at 71 °C, on-line set and fixed set."""
    half = 0.5 * duration
    cold = tracked(duration, hot=False, learns=False)
    on_line = tracked(duration, hot=True, learns=True)
    fixed = tracked(duration, hot=True, learns=False)
    reference = cold.nrmse(half, duration)
    about = f"Emulated rig, random motion, coil lag 10 ms, {DEMAND:.0f} N s/m wanted"
    return [
        Figure(
            "force_tracking_nrmse_percent",
            100.0 * reference,
            f"{about}: RMSE over the standard deviation of the force [%], where the desired force "
            "could be had.",
            (0.0, 10.0),
            f"It could be had for {cold.share:.0%} of the time.",
        ),
        Figure(
            "force_tracking_hot_growth",
            on_line.nrmse(half, duration) / reference,
            f"{about}: the error at 71 °C (force {HOT_FORCE:.0%}) over that at 28 °C, with the set "
            f"identified on line from that of 28 °C, in the second {half:.0f} s.",
            (0.0, 1.1),
        ),
        Figure(
            "force_tracking_hot_growth_fixed",
            fixed.nrmse(half, duration) / reference,
            "The same with the set of 28 °C throughout.",
        ),
    ]
