"""Tracking by the engine: dampers that heat, lose force, do not change, or have another law.

The current is constant, or switched continually as by semi-active control.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from benchmarks.dampers import DAMPERS, SIXTEEN
from benchmarks.figure import Measured
from benchmarks.motions import random_motion, scheduled
from benchmarks.streams import StreamTrial, TrialResult, TrialSettings
from mr_damper_ros.emulation.emulator import (
    CurrentSchedule,
    Damper,
    EmulatedDamper,
    EmulatedRig,
    RigSettings,
    ThermalModel,
    scaled,
)
from mr_damper_ros.emulation.faults import Fault, fault_of
from mr_damper_ros.emulation.motions import Excitation, SampledMotion, SineMotion
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.first_order_lag import COIL
from mr_damper_ros.models.parameter_set import ParameterSet, start_set
from mr_damper_ros.models.published import LITERATURE
from mr_damper_ros.models.published import THESIS_28_CELSIUS as COLD_DAMPER
from mr_damper_ros.models.published import THESIS_71_CELSIUS as HOT_DAMPER
from mr_damper_ros.models.quantities import LoopReading
from mr_damper_ros.models.sigmoid.law import sine_force
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.signals.recording import Recording, stream_of
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.engine import Engine, EngineSettings
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.tracker import TrackerSettings
from mr_damper_ros.tracking.window_assembler import WindowSettings
from studies import recordings
from studies.recordings import window_of
from studies.truth.records import microseconds_per_sample

WINDOW, HOP = WindowSettings.window, WindowSettings.hop
"""Defaults of the identifier node [s]."""

MOTION, CURRENT = SineMotion(5e-3, 1.0), 1.5
"""The test of the thesis' section 4.5, with its current [A]."""

_LAW = MODELS["sigmoid"]


def recording(
    damper: Damper,
    duration: float,
    *,
    seed: int,
    motion: Excitation = MOTION,
    current: float = CURRENT,
    thermal: ThermalModel | None = None,
    faults: Sequence[Fault] = (),
) -> Recording:
    """Recording of a damper that heats up or breaks, with the noise of the thesis."""
    settings = RigSettings(displacement_noise=1e-6, seed=seed)
    rig = EmulatedRig(damper, motion, current, settings=settings, thermal=thermal, faults=faults)
    return rig.record(duration)


def follow(
    run: Recording, settings: TrackerSettings, hop: float = HOP
) -> list[tuple[Report, Array, int]]:
    """Reports on all windows of a recording, from a cold start.

    Each comes with the parameters (16,) in use once it was published, and the index of the sample
    after its window.
    """
    engine = Engine(EngineSettings(windows=WindowSettings(hop=hop), tracking=settings))
    deque(engine.follow(stream_of(run)), maxlen=0)
    steps, values = [], LITERATURE
    for published in engine.take_publications():
        report, found = published.report, published.parameters
        values = values if found is None else found.values
        end = round((report.stamp_ns - run.start_ns) / NANOSECONDS / run.period) + 1
        steps.append((report, values, end))
    return steps


def _cycle() -> tuple[Array, Array, Array]:
    """Displacement [m], velocity [m/s] and acceleration [m/s²] over one cycle, shape (256,)."""
    motion = MOTION.at(np.arange(256) / 256.0)
    return motion.displacement, motion.velocity, motion.acceleration


def _scale(present: Array, reference: Array) -> float:
    """Factor with which ``reference`` (n,) fits ``present`` (n,) best."""
    return float(present @ reference) / float(reference @ reference)


# -- a damper that heats ------------------------------------------------------------------

COLD, HOT = 28.0, 71.0


def _thermal_model(duration: float) -> ThermalModel:
    """Thermal model that heats the damper of this test from 28 to 71 °C in ``duration`` [s]."""
    cycle = _cycle()
    powers = [
        float(np.mean(sine_force(values, *cycle, CURRENT) * cycle[1]))
        for values in (COLD_DAMPER, HOT_DAMPER)
    ]

    def heating(capacity: float) -> ThermalModel:
        return ThermalModel(heat_capacity=capacity, conductance=0.2)

    def excess(capacity: float) -> float:
        model = heating(capacity)
        celsius, steps = model.initial_temperature, 1000
        for _ in range(steps):
            warm = (celsius - COLD) / (HOT - COLD)
            power = powers[0] + warm * (powers[1] - powers[0])
            celsius = model.after(celsius, power, duration / steps)
        return celsius - HOT

    return heating(brentq(excess, 0.1, 1e5))


def _true_loop(run: Recording, part: slice) -> Array:
    """Force (n,) of the true damper over one cycle, at the mean temperature of a part."""
    assert run.temperature is not None
    warm = (float(np.mean(run.temperature[part])) - COLD) / (HOT - COLD)
    cold, hot = (sine_force(p, *_cycle(), CURRENT) for p in (COLD_DAMPER, HOT_DAMPER))
    return np.asarray(cold + min(max(warm, 0.0), 1.0) * (hot - cold))


def drift_of(run: Recording) -> tuple[float, Array, Array]:
    """Follow the drift and compare each report with the true values at its publication.

    Returns the 95th percentile of the absolute errors of the force scale [1], and the NRMSE (m,) on
    the next window of the set in use and of a separate least-squares fit to that window.
    """
    steps = follow(run, TrackerSettings())
    length = round(WINDOW / run.period)
    baseline_end = next(end for report, _, end in steps if report.accepted)
    baseline = _true_loop(run, slice(baseline_end - length, baseline_end))
    errors, predicted, fitted = [], [], []
    for report, values, end in steps:
        if np.isfinite(report.scale.value):
            truth = _scale(_true_loop(run, slice(end - 1, end)), baseline)
            errors.append(report.scale.value / truth - 1.0)
        if end >= baseline_end and end + length <= run.force.size:
            ahead = window_of(recordings.cut(run, slice(end, end + length)))
            left = _LAW.window_force(ahead, values) - ahead.force
            predicted.append(recordings.rms(left) / float(np.std(ahead.force)))
            fitted.append(fit_window(_LAW, ahead, values, method="least_squares").nrmse)
    return float(np.quantile(np.abs(errors), 0.95)), np.array(predicted), np.array(fitted)


def drift_figures(duration: float = 600.0, seed: int = 0) -> Measured:
    """The damper heats from 28 to 71 °C."""
    damper = EmulatedDamper(COLD_DAMPER, HOT_DAMPER)
    run = recording(damper, duration, seed=1 + seed, thermal=_thermal_model(duration))
    scale, predicted, fitted = drift_of(run)
    assert run.temperature is not None
    hottest, single = float(run.temperature[-1]), float(np.quantile(predicted / fitted, 0.95))
    return {
        "drift_scale_error_p95_percent": (100.0 * scale, f"To {hottest:.1f} °C."),
        "drift_nrmse_ratio": (
            recordings.rms(predicted) / recordings.rms(fitted),
            f"95th percentile of the single ratios: {single:.3f}.",
        ),
    }


# -- a sudden loss of force ------------------------------------------------------------------

_FACTOR, _WITHIN = 0.9, 0.01
_OFFSETS = tuple(place / 8.0 for place in range(8))
_BEFORE, _AFTER = 8.0, 10.0


def windows_until_right(offset: float, seed: int = 0) -> float:
    """Time from the step until the error of the set in use stays within 1 %, in window lengths.

    ``offset`` is the time of the step after the end of a window, in hops. The error is the norm of
    the force error over a cycle, relative to the norm of the force. The time is infinite if the
    error does not stay within 1 %.
    """
    time = _BEFORE + offset * HOP
    run = recording(
        EmulatedDamper(COLD_DAMPER),
        time + _AFTER,
        seed=round(100 * offset) + 100 * seed,
        faults=[fault_of(f"force_loss:{_FACTOR}@{time}")],
    )
    truth = sine_force(scaled(COLD_DAMPER, _FACTOR), *_cycle(), CURRENT)
    right_since = np.inf
    for _, values, end in follow(run, TrackerSettings()):
        elapsed = end * run.period - time
        if elapsed > 0.0:
            error = sine_force(values, *_cycle(), CURRENT) - truth
            right = bool(np.linalg.norm(error) <= _WITHIN * np.linalg.norm(truth))
            right_since = min(right_since, elapsed) if right else np.inf
    return float(right_since) / WINDOW


def step_figures(offsets: Sequence[float] = _OFFSETS, seed: int = 0) -> Measured:
    """Longest of these durations over steps at several times within a hop."""
    times = [windows_until_right(offset, seed) for offset in offsets]
    return {"step_windows": (max(times), f"Mean: {float(np.mean(times)):.2f}.")}


# -- dampers that do not change: stability and force scale --------------------------------------

_SETTLING = 2.0
_BOUC_WEN = {"c0": 4e3, "k0": 1e3, "c1": 6e4, "k1": 500.0}
_HYSTERESIS = {"f0": 20.0, "alpha": 700.0, "share": 0.5, "n": 1.5}
_SOFT, _STIFF = 2e-3, 1.5e-4
"""Yield distances [m]. The sigmoid law fits each with an error of 3 to 10 %: the first in a sine of
5 mm and 1 Hz, the second in random motion."""


def exchanges(windows: int, seed: int = 0) -> int:
    """Number of set changes after the first set, for a constant damper of the exact law."""
    run = recording(EmulatedDamper(COLD_DAMPER), WINDOW + (windows - 1) * HOP, seed=3 + seed)
    verdicts = [report.verdict for report, *_ in follow(run, TrackerSettings())]
    if Verdict.ACCEPTED not in verdicts:
        raise RuntimeError("no window of the constant damper was accepted")
    return sum(verdict.accepted for verdict in verdicts) - 1


def published_scales(
    motion: Excitation, yield_length: float, windows: int, seed: int = 0
) -> tuple[Array, Array, float]:
    """Published force scales (w,) and their claimed errors for a damper of another law.

    The damper of 0.7 kN has the modified Bouc-Wen law with this yield distance [m]. The sigmoid law
    is tracked over windows that do not overlap. The first report with a scale defines the baseline
    and is left out. The last value is the median NRMSE of the fits.
    """
    model = MODELS["modified_bouc_wen"]
    values = model.starts(LoopReading(1000.0, 0.0, 0.03, 5e-3))[0].copy()
    for name, value in {**_BOUC_WEN, **_HYSTERESIS, "yield_length": yield_length}.items():
        values[model.parameter_names.index(name)] = value
    damper = EmulatedDamper(ParameterSet(values, model=model.name))
    duration = _SETTLING + windows * WINDOW
    run = recording(damper, duration, seed=5 + seed, motion=motion, current=1.0)
    run = recordings.cut(run, slice(round(_SETTLING / run.period), None))
    steps = follow(run, TrackerSettings(), hop=WINDOW)
    reports = [report for report, *_ in steps if report.confirms][1:]
    scales = [report.scale for report in reports if math.isfinite(report.scale.value)]
    return (
        np.array([scale.value for scale in scales]),
        np.array([scale.standard_error for scale in scales]),
        float(np.median([report.nrmse_after for report in reports])),
    )


def many_tones(duration: float, seed: int = 0) -> SampledMotion:
    """Gaussian motion of 3 mm rms with a flat spectrum from 0.5 to 3 Hz, as a sum of many tones."""
    period, tones = 0.005, 200
    rng = np.random.default_rng(1 + seed)
    rates = 2.0 * np.pi * rng.uniform(0.5, 3.0, tones)
    angles = np.outer(np.arange(round(duration / period) + 1) * period, rates)
    amplitudes = 3e-3 / math.sqrt(tones) * rng.standard_normal((2, tones))
    return SampledMotion(np.sin(angles) @ amplitudes[0] + np.cos(angles) @ amplitudes[1], period)


def chi_square(scales: Array, errors: Array) -> float:
    """Mean square of the deviations from the weighted mean, in standard errors [1]."""
    weights = errors**-2
    mean = float(weights @ scales) / float(np.sum(weights))
    return float(np.sum(((scales - mean) / errors) ** 2)) / (scales.size - 1)


def steady_figures(windows: int = 600, misfit_windows: int = 100, seed: int = 0) -> Measured:
    """Measure a damper of another law in two motions, and an exact damper."""
    sine = published_scales(MOTION, _SOFT, misfit_windows, seed)
    motion = many_tones(misfit_windows * WINDOW + _SETTLING, seed)
    irregular = published_scales(motion, _STIFF, misfit_windows, seed)
    scales = irregular[0]
    return {
        "misfit_error_ratio": (
            [float(np.median(e) / np.std(scale, ddof=1)) for scale, e, _ in (sine, irregular)],
            f"NRMSE of the fits: {sine[2]:.1%} and {irregular[2]:.1%}.",
        ),
        "scale_chi2": (
            chi_square(*irregular[:2]),
            f"Its mean: {float(np.mean(scales)):.3f}, the scatter {float(np.std(scales)):.3f}.",
        ),
        "needless_exchanges": float(exchanges(windows, seed)),
    }


# -- a switched current ----------------------------------------------------------------------------

_LOW, _HIGH = 0.2, 1.2
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


SWITCHED = (
    *(
        SwitchedStream(SIXTEEN, "sigmoid", motion, current)
        for motion in ("sine", "random")
        for current in ("switched", "clipped")
    ),
    SwitchedStream(DAMPERS["modified_bouc_wen"], "sigmoid_lag", "sine", "switched"),
    SwitchedStream(DAMPERS["modified_bouc_wen"], "sigmoid_lag", "random", "clipped"),
)


def _switched_or_clipped(current: str, duration: float) -> CurrentSchedule:
    """Current switched every 0.4 s, or clipped: off for some time, then on at some level."""
    if current == "switched":
        times = np.arange(0.0, duration, 0.4)
        return scheduled(times, np.where(np.arange(times.size) % 2, _HIGH, _LOW))
    rng = np.random.default_rng(0)
    steps = 0.02 + rng.exponential(0.25, round(8.0 * duration))
    times = np.concatenate(([0.0], np.cumsum(steps)))
    off = rng.random(times.size) < 0.5
    return scheduled(times, np.where(off, 0.0, rng.uniform(_LOW, _HIGH, times.size)))


@cache
def streamed(case: SwitchedStream, duration: float) -> TrialResult:
    """Run the case from a cold start."""
    is_sine = case.motion == "sine"
    motion = MOTION if is_sine else random_motion(4e-3, 0.3, 3.0, duration, 0)
    settings = TrialSettings(block_size=_BLOCK, engine=EngineSettings().for_law(case.model))
    current = _switched_or_clipped(case.current, duration)
    return StreamTrial(case.damper, motion, current, settings=settings).run(duration)


def _drift_errors(duration: float, seed: int) -> Array:
    """Errors of the reported force scale [1] while the damper heats from 28 to 71 °C.

    The true scale is the force of the heating damper over that of a damper that stays cold.
    """
    # The capacity is so large that the surroundings heat the damper, and friction hardly does.
    capacity, ambient = 1e4, 90.0
    rate = math.log((ambient - COLD) / (ambient - HOT)) / duration
    heat = ThermalModel(ambient, COLD, capacity, conductance=rate * capacity)
    current = _switched_or_clipped("switched", duration)
    settings = TrialSettings(seed, block_size=_BLOCK)
    trial = StreamTrial(SIXTEEN, MOTION, current, settings=settings, thermal=heat, hot_force=0.74)
    result = trial.run(duration)
    reference = EmulatedRig(EmulatedDamper(SIXTEEN), MOTION, current).record(duration).force
    begin = result.reports[0].window_start_ns
    errors, first = [], math.nan
    for report in result.reports:
        if math.isfinite(report.scale.value):
            places = np.array([report.window_start_ns, report.stamp_ns]) - begin
            part = slice(*np.round(places / NANOSECONDS / result.period).astype(int))
            truth = _scale(result.true[part], reference[part])
            first = truth / report.scale.value if math.isnan(first) else first
            errors.append(report.scale.value * first / truth - 1.0)
    return np.asarray(errors)


def switched_figures(duration: float = 135.0, seed: int = 0) -> Measured:
    """A damper that heats while the current is switched."""
    error = float(np.quantile(np.abs(_drift_errors(duration, seed)), 0.95))
    return {"switched_drift_scale_error_p95_percent": 100.0 * error}


# -- the law with a state --------------------------------------------------------------------------

_STATE_LAW, _COILS = "series_springs", (5e-3, 20e-3)
"""The law, and the time constants [s] of the coils."""

_RATE = 500.0
STATE_DAMPER = ParameterSet(
    np.array(
        [600.0, 4e-3, 2500.0, 1e7, 0.3, 1e6, 1500.0, -20.0]
        + [3.0, -0.6, 0.0, 0.5, 0.8, 0.0, 0.0, 0.01]
    ),
    set_id="springs",
    model=_STATE_LAW,
)


def switched_halves(coil: float, half: float = 20.0) -> list[Window]:
    """Two halves of a stream of the modified Bouc-Wen damper with this time constant [s].

    The current has random levels of 0 to 1.5 A, each for 0.05 to about 0.5 s.
    """
    damper, rng = DAMPERS["modified_bouc_wen"], np.random.default_rng(0)
    values = damper.values.copy()
    values[damper.law.parameter_names.index(COIL)] = coil
    times = np.cumsum(0.05 + rng.exponential(0.25, round(16.0 * half)))
    times[0] = 0.0
    rig = EmulatedRig(
        EmulatedDamper(ParameterSet(values, model=damper.model)),
        random_motion(4e-3, 0.3, 3.0, 2.0 * half, 0),
        scheduled(times, rng.uniform(0.0, 1.5, times.size)),
        settings=RigSettings(sample_rate=_RATE),
    )
    found, count = rig.record(2.0 * half), round(half * _RATE)
    return [
        window_of(recordings.cut(found, part)) for part in (slice(0, count), slice(count, None))
    ]


def switched(coil: float, half: float) -> tuple[float, float]:
    """NRMSE on the half that was not fitted, and the estimated time constant of the coil [s]."""
    model = MODELS[_STATE_LAW]
    first, second = switched_halves(coil, half)
    start = start_set(_STATE_LAW).values
    found = identify_global(model, [first], start, EvolutionSettings()).parameter_set
    settled = found.settled(second)
    left = (found.window_force(second) - second.force)[settled]
    nrmse = recordings.rms(left) / float(np.std(second.force[settled]))
    return nrmse, float(found.values[model.parameter_names.index(COIL)])


def worker_shares(law: str, start: float, duration: float) -> tuple[float, float]:
    """Processor time of the worker over data time, in the first seconds and afterwards.

    A damper of the state law moves at random at 1 A and 1 kHz. The worker starts cold with the
    defaults of the nodes: windows of two seconds every second, three change checks between them,
    and global identifications, six in the first half minute and later one after every twenty
    windows that fit.
    """
    rig = EmulatedRig(EmulatedDamper(STATE_DAMPER), random_motion(4e-3, 0.3, 3.0, duration, 1), 1.0)
    engine = Engine(EngineSettings().for_law(law))
    at_start = 0.0
    for block, _ in engine.follow(stream_of(rig.record(duration), 10)):
        if block.sequence * block.period < start:
            at_start = engine.worker.processor_time
    later = engine.worker.processor_time - at_start
    return at_start / start, later / (duration - start)


def state_law_figures(half: float = 20.0, start: float = 40.0, duration: float = 100.0) -> Measured:
    """Measure the law with a state under random currents, and the cost of the worker."""
    found = [switched(coil, half) for coil in _COILS]
    laws = ("sigmoid", "sigmoid_lag", _STATE_LAW, "bouc_wen")
    shares = [worker_shares(law, start, duration) for law in laws]
    return {
        "law_us_per_sample": microseconds_per_sample(STATE_DAMPER, switched_halves(0.01)[0]),
        "switched_current_nrmse": [100.0 * nrmse for nrmse, _ in found],
        "switched_current_lag_error": [
            100.0 * abs(lag / coil - 1.0) for (_, lag), coil in zip(found, _COILS, strict=True)
        ],
        "worker_core_percent": [100.0 * later for _, later in shares],
        "worker_start_percent": [100.0 * first for first, _ in shares],
    }
