"""Dampers with known parameters, runs made from them, and helpers of the core tests."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from scipy.signal import lfilter

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.peak_velocity import peak_velocity
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS, THESIS_71_CELSIUS
from mr_damper_ros.models.sigmoid.law import (
    PARAMETER_NAMES,
    operating_point_coefficients,
    sine_force,
)
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.tracker import TrackerSettings, WindowTracker
from mr_damper_ros.tracking.window_assembler import RawWindow, WindowAssembler, WindowSettings

NOISE = 5.53
"""Standard deviation of the force noise of the thesis [N]."""

PERIOD = 1e-3
THESIS_SAMPLES = 7001
THESIS_PHASE = 4.481
T0 = 1_700_000_000 * NANOSECONDS
"""Arbitrary stamp [ns] at which streams start."""

PLAUSIBLE = np.array(
    [
        *(40.0, -0.35, -0.25, 900.0, 2.5, 4.0, 3.0, 2.0),
        *(9.0, 4.0, 6.0, 18.0, -0.45, -0.11, 0.06, 0.012),
    ]
)

SIGMOID, EXTENDED = MODELS["sigmoid"], MODELS["sigmoid_lag"]

"""Parameters of a damper in which every term of the law matters: 0.01 to 0.25 m/s, 0 to 1.5 A."""

_AT_ANY_CURRENT = {
    "bingham": np.array([500.0, 4000.0, -30.0]),
    "hyperbolic_tangent": np.array([3000.0, 2000.0, 600.0, 90.0, 0.6, -20.0]),
    "nonlinear_biviscous": np.array([4000.0, 60000.0, 500.0, 0.006, -20.0]),
    "bouc_wen": np.array([4000.0, 3000.0, -20.0, 500.0, 3e-4, 0.4, 1.5]),
    "modified_bouc_wen": np.array([3000.0, 500.0, 60000.0, 1500.0, -20.0, 600.0, 2e-4, 0.5, 1.5]),
    "series_springs": np.array([600.0, 4e-3, 2500.0, 1e7, 0.3, 1e6, 1500.0, -20.0]),
    "sigmoid": PLAUSIBLE,
    "sigmoid_lag": np.array([*PLAUSIBLE, 3e-8, 2000.0, -40.0]),
}

EXAMPLES = {
    name: np.pad(values, (0, len(MODELS[name].parameters) - values.size))
    for name, values in _AT_ANY_CURRENT.items()
}
"""Parameters of one damper by model name; its force does not depend on the current."""

_GROWTH = {"_1": 1.2, "_2": -0.2}
"""Growth of the coefficients with the current, for laws of one current; monotonic up to 3 A."""

SHAPE_PARAMETER_NAMES = SIGMOID.shape_names
SHAPE = SIGMOID.places(SHAPE_PARAMETER_NAMES)


def controllable(name: str) -> ParameterSet:
    """A damper of the law whose force depends on the current."""
    model = MODELS[name]
    values = EXAMPLES[name].copy()
    for place, parameter in enumerate(model.parameters):
        base, _, order = parameter.name.rpartition("_")
        if base in model.parameter_names and f"_{order}" in _GROWTH:
            coefficient = abs(values[model.parameter_names.index(base)])
            size = 1.0 if parameter.unit.startswith("1") else 0.1 * coefficient
            values[place] = size * _GROWTH[f"_{order}"]
    return ParameterSet(values, model=name)


def weaker(strength: float) -> Array:
    """The sixteen parameters of the known damper with its yield force times ``strength``."""
    return np.asarray(PLAUSIBLE * np.where(np.arange(16) == index("f0"), strength, 1.0))


def parameter_jacobian(values: Array, u: Array, v: Array, a: Array, current: Array) -> Array:
    """Derivatives of the sigmoid force by the sixteen parameters, shape (n, 16)."""
    motion = Motion(u, v, a, peak_velocity(u, v, a), sine=None)
    forces = SIGMOID.window_forces([Window(motion, np.zeros(u.size), current)])
    return forces.derivatives(values, range(16))[0]


def index(name: str) -> int:
    """Index of a parameter in the array of sixteen."""
    return PARAMETER_NAMES.index(name)


def fixed(examples: int) -> Any:
    """Settings of hypothesis: the same examples on every machine, and no time limit."""
    return settings(
        max_examples=examples,
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
    )


@dataclass(frozen=True, eq=False)
class Run:
    """A steady sinusoidal run of a known damper; arrays of shape (n,), SI units."""

    parameters: Array
    displacement: Array
    velocity: Array
    acceleration: Array
    clean: Array
    force: Array
    current: float
    period: float
    top_speed: float

    @property
    def window(self) -> Window:
        return Window.from_samples(self.displacement, self.force, self.current, self.period)

    @property
    def coefficients(self) -> Array:
        """The seven coefficients (7,) that the run was made with, f_t positive."""
        at_the_point = operating_point_coefficients(self.parameters, self.top_speed, self.current)
        return positive(np.concatenate(at_the_point))

    @property
    def noise_rms(self) -> float:
        """RMSE [N] of the true force against the measured one."""
        return rms(self.force - self.clean)


def correlated_noise(count: int, memory: float, seed: int) -> Array:
    """Noise of unit variance whose autocorrelation falls as memory^lag, shape (count,)."""
    white = np.random.default_rng(seed).normal(0.0, math.sqrt(1.0 - memory**2), count + 500)
    return np.asarray(lfilter([1.0], [1.0, -memory], white)[500:])


def run(
    parameters: Array = PLAUSIBLE,
    *,
    amplitude: float = 5e-3,
    frequency: float = 1.0,
    current: float = 1.0,
    seed: int | None = 0,
    samples: int = 2000,
    noise: float = NOISE,
    period: float = PERIOD,
    phase: float = THESIS_PHASE,
    start: float = 0.0,
) -> Run:
    """A run with Gaussian force noise [N]; amplitude [m], frequency [Hz], current [A].

    ``start`` [s] is the time of the first sample, ``seed`` None for no noise.
    """
    time = start + np.arange(samples) * period
    omega = 2.0 * math.pi * frequency
    u = amplitude * np.sin(omega * time + phase)
    v = amplitude * omega * np.cos(omega * time + phase)
    a = -(omega**2) * u
    clean = sine_force(parameters, u, v, a, current)
    error = 0.0 if seed is None else np.random.default_rng(seed).normal(0.0, noise, samples)
    return Run(
        parameters=np.asarray(parameters, dtype=float),
        displacement=u,
        velocity=v,
        acceleration=a,
        clean=clean,
        force=clean + error,
        current=current,
        period=period,
        top_speed=amplitude * omega,
    )


def positive(coefficients: Array) -> Array:
    """The same loop with positive yield force: f_t and alpha change sign together."""
    sign = -1.0 if coefficients[0] < 0.0 else 1.0
    return np.asarray(coefficients * np.array([sign, sign, 1.0, 1.0, 1.0, 1.0, 1.0]))


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def raw_window(run: Run, *, number: int = 0, temperature: float = math.nan) -> RawWindow:
    """A run as window ``number`` of a stream of windows of equal length."""
    duration = round(run.force.size * run.period * NANOSECONDS)
    return RawWindow(
        start_ns=T0 + number * duration,
        period=run.period,
        displacement=run.displacement,
        force=run.force,
        current=np.full(run.force.size, run.current),
        temperature=temperature,
    )


def window(number: int = 0, strength: float = 1.0, **changes: Any) -> RawWindow:
    """One-second window ``number`` of the known damper, with its yield force times ``strength``."""
    entries = {"samples": 1000, "seed": number, **changes}
    return raw_window(run(weaker(strength), **entries), number=number)


def tracker(start: ParameterSet | None = None, **settings: Any) -> WindowTracker:
    """A tracker; by default it starts from the known damper with four fifths of its force."""
    entries = {"method": "least_squares", "global_period": 0, **settings}
    start = start or ParameterSet(weaker(0.8), set_id="start")
    return WindowTracker(TrackerSettings(model=start.model, **entries), start)


def fed(tracked: WindowTracker, *windows: RawWindow) -> list[Report]:
    """Reports of a tracker after these windows."""
    reports = [tracked.follow(window) for window in windows]
    assert None not in reports
    return reports  # type: ignore[return-value]


def blocks(
    displacement: Array,
    force: Array,
    sizes: Sequence[int],
    *,
    period: float = PERIOD,
    start_ns: int = T0,
    sequence: int = 0,
) -> list[SampleBlock]:
    """A stream cut into blocks; the list of sizes is repeated."""
    result, first, place = [], 0, 0
    while first < displacement.size:
        last = first + sizes[place % len(sizes)]
        result.append(
            SampleBlock(
                start_ns=start_ns + round(first * period * NANOSECONDS),
                sequence=sequence + first,
                period=period,
                displacement=displacement[first:last],
                force=force[first:last],
            )
        )
        first, place = last, place + 1
    return result


def followed(
    tracker: WindowTracker, displacement: Array, force: Array, current: float
) -> list[Report]:
    """Reports of a tracker on a stream: 2 s windows, one per second, with three change checks."""
    assembler = WindowAssembler(WindowSettings(2.0, 1.0, looks=3))
    ready = assembler.add_current(T0, current)
    for block in blocks(displacement, force, [100]):
        ready += assembler.add_block(block)
        ready += assembler.add_current(block.end_ns, current)
    return [report for raw in ready if (report := tracker.follow(raw)) is not None]


def drifting_force(run: Run, warm: float) -> Array:
    """Force (n,) of the thesis' damper between 28 °C (``warm`` = 0) and 71 °C (1), no noise.

    The two published sets lie in different basins, so it is the forces that are mixed.
    """
    cold, hot = (
        sine_force(p, run.displacement, run.velocity, run.acceleration, run.current)
        for p in (THESIS_28_CELSIUS, THESIS_71_CELSIUS)
    )
    return np.asarray((1.0 - warm) * cold + warm * hot)


def recordings_folder() -> Path:
    """Folder of the real recordings; skips the test where there are none."""
    place = os.environ.get("MR_DAMPER_DATA")
    if not place:
        pytest.skip("MR_DAMPER_DATA is not set: no real recordings to test with")
    folder = Path(place) / "utfsm" / "processed"
    if not folder.is_dir():
        pytest.skip(f"MR_DAMPER_DATA={place} holds no utfsm/processed")
    return folder


def report(set_id: str, start_ns: int, stamp_ns: int, **fields: Any) -> Report:
    """A report on the window between two stamps."""
    return Report(window_start_ns=start_ns, stamp_ns=stamp_ns, set_id=set_id, **fields)


def confirmation(set_id: str, start_ns: int, stamp_ns: int) -> Report:
    """A report that a set fits the window between two stamps."""
    return report(set_id, start_ns, stamp_ns, nrmse_before=0.1, confirms=True)
