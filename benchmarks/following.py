"""An emulated rig whose damper changes, and a tracker that follows it as the identifier does."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.emulation.emulator import Damper, EmulatedRig, RigSettings, ThermalModel
from mr_damper_ros.emulation.faults import Fault
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.published import LITERATURE
from mr_damper_ros.models.sigmoid.law import sine_force
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording, stream_of
from mr_damper_ros.tracking.engine import Engine, EngineSettings
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.tracker import TrackerSettings
from mr_damper_ros.tracking.window_assembler import WindowSettings

WINDOW, HOP = WindowSettings.window, WindowSettings.hop
"""Defaults of the identifier node [s]."""

AMPLITUDE, FREQUENCY, CURRENT = 5e-3, 1.0, 1.5
"""The test of the thesis' section 4.5: [m], [Hz], [A]."""


@dataclass(frozen=True, eq=False)
class Step:
    """A report and the parameters (16,) in use once it was published."""

    report: Report
    parameters: Array


def excitation() -> SineMotion:
    """The motion of all these recordings."""
    return SineMotion(AMPLITUDE, FREQUENCY)


def recording(
    damper: Damper,
    duration: float,
    *,
    seed: int,
    thermal: ThermalModel | None = None,
    faults: Sequence[Fault] = (),
) -> Recording:
    """Recording of a damper that heats up or breaks, with the noise of the thesis."""
    rig = EmulatedRig(
        damper,
        excitation(),
        CURRENT,
        settings=RigSettings(displacement_noise=1e-6, seed=seed),
        thermal=thermal,
        faults=faults,
    )
    return rig.record(duration)


def follow(
    run: Recording, settings: TrackerSettings, window: float = WINDOW, hop: float = HOP
) -> list[Step]:
    """Reports on all windows of a recording, from a cold start."""
    engine = Engine(
        EngineSettings(windows=WindowSettings(window=window, hop=hop), tracking=settings)
    )
    for _ in engine.follow(stream_of(run)):
        pass
    steps, parameters = [], LITERATURE
    for published in engine.take_publications():
        if published.parameters is not None:
            parameters = published.parameters.values
        steps.append(Step(published.report, parameters))
    return steps


def window_between(run: Recording, first: int, last: int) -> Window:
    """Samples ``first`` to ``last`` of a recording as a window."""
    part = slice(first, last)
    return Window.from_samples(
        run.displacement[part], run.force[part], run.current[part], run.period
    )


def nrmse(parameters: Array, window: Window) -> float:
    """RMSE/std of the force that parameters (16,) predict on a window."""
    m = window.motion
    predicted = sine_force(parameters, m.displacement, m.velocity, m.acceleration, window.current)
    return float(np.sqrt(np.mean((predicted - window.force) ** 2)) / np.std(window.force))


def sample_of(run: Recording, stamp_ns: int) -> int:
    """Index of the sample with a stamp."""
    return round((stamp_ns - run.start_ns) * 1e-9 / run.period)


def one_cycle() -> tuple[Array, Array, Array]:
    """Displacement [m], velocity [m/s] and acceleration [m/s²] over one cycle, shape (256,)."""
    time = np.arange(256) / (256.0 * FREQUENCY)
    motion = excitation().at(time)
    return motion.displacement, motion.velocity, motion.acceleration


def scale_of(present: Array, reference: Array) -> float:
    """Factor on ``reference`` (n,) that comes nearest to ``present`` (n,)."""
    power = float(reference @ reference)
    return float(present @ reference) / power if power > 0.0 else math.nan
