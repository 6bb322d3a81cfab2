"""Identification under the continually switched current of semi-active control.

The dampers follow the sixteen-parameter law or other laws, in a sine and in random motion. In the
online tests from a cold start, the current either switches between 0.2 and 1.2 A every 0.4 s, or is
off for some time and then on at some level, as with a clipped-optimal controller. The offline tests
cover the law with a state and its computing cost.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from benchmarks.figure import Measured
from benchmarks.other_dampers import DAMPERS, random_motion
from benchmarks.stream_trial import StreamTrial, TrialResult, TrialSettings
from mr_damper_ros.api.replay import replay
from mr_damper_ros.emulation.emulator import (
    CurrentSchedule,
    EmulatedDamper,
    EmulatedRig,
    RigSettings,
    ThermalModel,
)
from mr_damper_ros.emulation.motions import Excitation, SineMotion
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.first_order_lag import COIL
from mr_damper_ros.models.parameter_set import ParameterSet, start_set
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.signals.recording import Recording, stream_of
from mr_damper_ros.tracking.engine import Engine, EngineSettings
from mr_damper_ros.tracking.jobs import parts_by_current
from mr_damper_ros.tracking.screening import Screening
from mr_damper_ros.tracking.tracker import TrackerSettings
from studies.recordings import window_of
from studies.truth.records import microseconds_per_sample

SIXTEEN = ParameterSet(
    np.array(
        [
            *(40.0, -0.35, -0.25, 900.0, 2.5, 4.0, 3.0, 2.0),
            *(9.0, 4.0, 6.0, 18.0, -0.45, -0.11, 0.06, 0.012),
        ]
    ),
    set_id="sixteen",
)
"""An invented damper; all its coefficients vary over 0.01 to 0.25 m/s and 0 to 1.5 A."""

SETTLED = 20.0
"""Time [s] after which the results are evaluated."""

_EVERY = 0.4
_LOW, _HIGH = 0.2, 1.2
_PART = 2.0
_COLD, _HOT = 28.0, 71.0
_BLOCK = 20


class SwitchedStream(NamedTuple):
    """A damper, the identified law, the motion and the current schedule."""

    damper: ParameterSet
    model: str
    motion: str
    current: str

    @property
    def name(self) -> str:
        """The case in words."""
        return f"{self.damper.set_id} by {self.model}, {self.motion}, {self.current}"


CASES = (
    *(
        SwitchedStream(SIXTEEN, "sigmoid", motion, current)
        for motion in ("sine", "random")
        for current in ("switched", "clipped")
    ),
    SwitchedStream(DAMPERS["modified_bouc_wen"], "sigmoid_lag", "sine", "switched"),
    SwitchedStream(DAMPERS["modified_bouc_wen"], "sigmoid_lag", "random", "clipped"),
)


def excitation(motion: str, duration: float, seed: int) -> Excitation:
    """A sine of 5 mm at 1 Hz, or random motion up to 3 Hz."""
    if motion == "sine":
        return SineMotion(5e-3, 1.0)
    return random_motion(4e-3, 0.3, 3.0, duration, seed)


def schedule(current: str, duration: float, seed: int) -> CurrentSchedule:
    """Current switched every 0.4 s, or clipped: off for some time, then on at some level."""
    if current == "switched":
        times = np.arange(0.0, duration, _EVERY)
        levels = np.where(np.arange(times.size) % 2, _HIGH, _LOW)
        return CurrentSchedule(times.tolist(), levels.tolist())
    rng = np.random.default_rng(seed)
    steps = 0.02 + rng.exponential(0.25, round(8.0 * duration))
    times = np.concatenate(([0.0], np.cumsum(steps)))
    levels = np.where(rng.random(times.size) < 0.5, 0.0, rng.uniform(_LOW, _HIGH, times.size))
    return CurrentSchedule(times.tolist(), levels.tolist())


@cache
def streamed(case: SwitchedStream, duration: float, seed: int = 0) -> TrialResult:
    """Run the case from a cold start."""
    settings = TrialSettings(
        seed=seed, block_size=_BLOCK, tracker=TrackerSettings(model=case.model)
    )
    trial = StreamTrial(
        case.damper,
        excitation(case.motion, duration, seed),
        schedule(case.current, duration, seed),
        settings=settings,
    )
    return trial.run(duration)


def off_line(case: SwitchedStream, result: TrialResult) -> ParameterSet:
    """Fit of the law to the whole recording at once."""
    tolerance = Screening().current_tolerance
    count = round(_PART / result.period)
    parts: list[Window] = []
    for first in range(0, result.time.size - count + 1, count):
        part = slice(first, first + count)
        parts += parts_by_current(MODELS[case.model], window_of(recorded(result, part)), tolerance)
    start = start_set(case.model).values
    fit = identify_global(MODELS[case.model], parts, start, EvolutionSettings())
    return fit.parameter_set


def predicted(result: TrialResult, parameters: ParameterSet) -> Array:
    """Force [N] of a constant set, predicted block by block; shape (n,)."""
    return replay(recorded(result), parameters, identify=False, block_size=_BLOCK).predicted


def recorded(result: TrialResult, part: slice = slice(None)) -> Recording:
    """Recording of the measurements of a trial, or of a part of it."""
    return Recording(
        name="trial",
        start_ns=0,
        period=result.period,
        displacement=result.displacement[part],
        force=result.measured[part],
        current=result.current[part],
    )


def error(result: TrialResult, force: Array) -> float:
    """NRMSE of a predicted force after :data:`SETTLED`."""
    counted = (result.time >= SETTLED) & np.isfinite(force)
    left = (force - result.measured)[counted]
    return float(np.sqrt(np.mean(left**2)) / np.std(result.measured[counted]))


def drift_errors(duration: float, seed: int = 0) -> Array:
    """Errors of the reported force scale [1] while the damper heats from 28 to 71 °C.

    The true scale is the force of the heating damper over that of a damper that stays cold.
    """
    # The capacity is so large that the surroundings heat the damper, and friction hardly does.
    capacity, ambient = 1e4, 90.0
    rate = math.log((ambient - _COLD) / (ambient - _HOT)) / duration
    heat = ThermalModel(ambient, _COLD, capacity, conductance=rate * capacity)
    motion, current = excitation("sine", duration, seed), schedule("switched", duration, seed)
    settings = TrialSettings(seed=seed, block_size=_BLOCK)
    trial = StreamTrial(SIXTEEN, motion, current, settings=settings, thermal=heat, hot_force=0.74)
    result = trial.run(duration)
    cold = EmulatedRig(EmulatedDamper(SIXTEEN), motion, current)
    reference = cold.record(duration).force
    begin = round(result.reports[0].window_start_ns)
    errors, first = [], math.nan
    for report in result.reports:
        if not math.isfinite(report.scale.value):
            continue
        places = np.array([report.window_start_ns, report.stamp_ns]) - begin
        part = slice(*np.round(places / NANOSECONDS / result.period).astype(int))
        truth = float(result.true[part] @ reference[part] / (reference[part] @ reference[part]))
        if math.isnan(first):
            first = truth / report.scale.value
        errors.append(report.scale.value * first / truth - 1.0)
    return np.asarray(errors)


def figures(duration: float = 45.0, count: int = len(CASES)) -> Measured:
    """Run the first cases and a damper that heats."""
    cases = CASES[:count]
    ratios = []
    for case in cases:
        result = streamed(case, duration)
        fitted = predicted(result, off_line(case, result))
        ratios.append(error(result, result.predicted) / error(result, fitted))
    drift = drift_errors(3.0 * duration)
    return {
        "switched_nrmse_ratio": (ratios, "; ".join(case.name for case in cases)),
        "switched_drift_scale_error_p95_percent": 100.0 * float(np.quantile(np.abs(drift), 0.95)),
    }


# -- the law with a state --------------------------------------------------------------------------

STATE_LAW = "series_springs"

COILS = (5e-3, 20e-3)
"""Time constants [s] of the coils."""

LAWS = ("sigmoid", "sigmoid_lag", STATE_LAW, "bouc_wen")

_HALF = 20.0
_RATE = 500.0
_TRUTH = ParameterSet(
    np.array(
        [600.0, 4e-3, 2500.0, 1e7, 0.3, 1e6, 1500.0, -20.0]
        + [3.0, -0.6, 0.0, 0.5, 0.8, 0.0, 0.0, 0.01]
    ),
    set_id="springs",
    model=STATE_LAW,
)


def random_current(duration: float, seed: int) -> CurrentSchedule:
    """Random levels of 0 to 1.5 A, each for 0.05 to about 0.5 s."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(0.05 + rng.exponential(0.25, round(8.0 * duration)))
    times[0] = 0.0
    return CurrentSchedule(times.tolist(), rng.uniform(0.0, 1.5, times.size).tolist())


def switched_halves(coil: float, half: float = _HALF, seed: int = 0) -> list[Window]:
    """Two halves of a stream of the modified Bouc-Wen damper with this time constant [s]."""
    damper = DAMPERS["modified_bouc_wen"]
    values = damper.values.copy()
    values[damper.law.parameter_names.index(COIL)] = coil
    rig = EmulatedRig(
        EmulatedDamper(ParameterSet(values, model=damper.model)),
        random_motion(4e-3, 0.3, 3.0, 2.0 * half, seed),
        random_current(2.0 * half, seed),
        settings=RigSettings(sample_rate=_RATE, seed=seed),
    )
    found = rig.record(2.0 * half)
    count = round(half * _RATE)
    return [
        Window.from_samples(
            found.displacement[part], found.force[part], found.current[part], found.period
        )
        for part in (slice(0, count), slice(count, None))
    ]


def switched(law: str, coil: float, half: float = _HALF) -> tuple[float, float]:
    """NRMSE on the half that was not fitted, and the estimated time constant of the coil [s]."""
    model = MODELS[law]
    first, second = switched_halves(coil, half)
    found = identify_global(model, [first], start_set(law).values, EvolutionSettings())
    values = found.parameter_set.values
    held = second.held_within(*found.parameter_set.peak_velocity_range)
    settled = model.settled(held, values)
    left = (model.window_force(held, values) - held.force)[settled]
    nrmse = float(np.sqrt(np.mean(left**2)) / np.std(held.force[settled]))
    return nrmse, float(values[model.parameter_names.index(COIL)])


def worker_shares(law: str, start: float, duration: float) -> tuple[float, float]:
    """Processor time of the worker over data time, in the first seconds and afterwards.

    A damper of the state law moves at random at 1 A and 1 kHz. The worker starts cold with the
    defaults of the nodes: windows of two seconds every second, three change checks between them,
    and global identifications, six in the first half minute and later one after every twenty
    windows that fit.
    """
    rig = EmulatedRig(EmulatedDamper(_TRUTH), random_motion(4e-3, 0.3, 3.0, duration, 1), 1.0)
    record = rig.record(duration)
    engine = Engine(EngineSettings().for_law(law))
    at_start = 0.0
    for block, _ in engine.follow(stream_of(record, 10)):
        if block.sequence * block.period < start:
            at_start = engine.worker.processor_time
    later = engine.worker.processor_time - at_start
    return at_start / start, later / (duration - start)


def state_law_figures(
    half: float = _HALF, start: float = 40.0, duration: float = 100.0
) -> Measured:
    """Measure the law with a state under random currents, and the cost of the worker."""
    found = [switched(STATE_LAW, coil, half) for coil in COILS]
    shares = [worker_shares(law, start, duration) for law in LAWS]
    return {
        "law_us_per_sample": microseconds_per_sample(_TRUTH, switched_halves(0.01)[0]),
        "switched_current_nrmse": [100.0 * nrmse for nrmse, _ in found],
        "switched_current_lag_error": [
            100.0 * abs(lag / coil - 1.0) for (_, lag), coil in zip(found, COILS, strict=True)
        ],
        "worker_core_percent": [100.0 * later for _, later in shares],
        "worker_start_percent": [100.0 * first for first, _ in shares],
    }
