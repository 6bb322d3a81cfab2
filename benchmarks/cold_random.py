"""Band-limited random motion from a cold start: the fit on line over that of the known set."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.dampers import DAMPERS, damper
from benchmarks.figure import Measured
from benchmarks.following import STATE_DAMPER
from benchmarks.motions import random_motion
from mr_damper_ros.api.replay import replay
from mr_damper_ros.emulation.emulator import (
    EmulatedDamper,
    EmulatedRig,
    RigSettings,
    invented_damper,
)
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tracking.engine import EngineSettings
from studies.recordings import rms

_SETS: dict[str, ParameterSet] = {
    "bingham": damper("bingham", c0=1500.0, c0_1=0.4, f_y=60.0, f_y_1=8.0, f_y_2=-1.5),
    "hyperbolic_tangent": DAMPERS["viscous_tanh"],
    "nonlinear_biviscous": damper(
        "nonlinear_biviscous",
        c_post=1200.0,
        c_post_1=0.4,
        c_pre=20e3,
        c_pre_1=3.0,
        f_y=80.0,
        f_y_1=6.0,
        f_y_2=-1.0,
        v0=0.004,
    ),
    "bouc_wen": DAMPERS["bouc_wen"],
    "modified_bouc_wen": DAMPERS["modified_bouc_wen"],
    "series_springs": STATE_DAMPER,
    "sigmoid": ParameterSet(THESIS_28_CELSIUS),
    "sigmoid_lag": invented_damper(0.01),
}
"""A damper of each law."""

_CURRENTS = (0.5, 1.0)

_RMS, _LOW, _HIGH = 2e-3, 0.5, 15.0
"""Motion [m] and its band [Hz]."""

_DURATION, _LEFT_OUT = 20.0, 3.0
"""Length of a stream, and its beginning that is not evaluated [s]."""


def _fit(run: Recording, force: Array) -> float:
    """Fit 1 - NRMSE of a predicted force, where it is evaluated."""
    late = slice(round(_LEFT_OUT / run.period), None)
    return 1.0 - rms(force[late] - run.force[late]) / float(np.std(run.force[late]))


def ratio(law: str, current: float, seed: int) -> float:
    """Fit of the identifier from a cold start over that of the known set, in the same stream."""
    rig = EmulatedRig(
        EmulatedDamper(_SETS[law]),
        random_motion(_RMS, _LOW, _HIGH, _DURATION, seed),
        current,
        settings=RigSettings(displacement_noise=1e-6, seed=seed),
    )
    run, settings = rig.record(_DURATION), EngineSettings().for_law(law)
    found = replay(run, settings=settings)
    known = replay(run, _SETS[law], identify=False, settings=settings)
    return _fit(run, found.predicted) / _fit(run, known.predicted)


def figures(laws: Sequence[str] = tuple(_SETS), seed: int = 0) -> Measured:
    """The laws in turn; each has the smaller ratio of two currents."""
    found = {law: [ratio(law, current, seed) for current in _CURRENTS] for law in laws}
    least = [min(ratios) for ratios in found.values()]
    told = ", ".join(
        f"{law} {' and '.join(f'{each:.3f}' for each in ratios)}" for law, ratios in found.items()
    )
    at = " and ".join(f"{current:g}" for current in _CURRENTS)
    return {"cold_random_fit_ratio": (least, f"Worst: {min(least):.3f}. At {at} A: {told}.")}
