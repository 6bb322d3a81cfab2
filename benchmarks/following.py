"""Tracking by the engine: dampers that heat, lose force, do not change, or have another law."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.signal import lfilter

from benchmarks.figure import Measured
from mr_damper_ros.emulation.emulator import (
    THESIS_FORCE_NOISE,
    Damper,
    EmulatedDamper,
    EmulatedRig,
    RigSettings,
    ThermalModel,
    scaled,
)
from mr_damper_ros.emulation.faults import Fault, fault_of
from mr_damper_ros.emulation.motions import Excitation, SampledMotion, SineMotion
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import LITERATURE, find, parameters
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
from mr_damper_ros.tracking.tracker import TrackerSettings, WindowTracker
from mr_damper_ros.tracking.window_assembler import RawWindow, WindowSettings
from studies import recordings
from studies.thesis.runs import PHASE

WINDOW, HOP = WindowSettings.window, WindowSettings.hop
"""Defaults of the identifier node [s]."""

AMPLITUDE, FREQUENCY, CURRENT = 5e-3, 1.0, 1.5
"""The test of the thesis' section 4.5: [m], [Hz], [A]."""


@dataclass(frozen=True, eq=False)
class Step:
    """A report and the parameters (16,) in use once it was published."""

    report: Report
    parameters: Array


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
        SineMotion(AMPLITUDE, FREQUENCY),
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


def sample_of(run: Recording, stamp_ns: int) -> int:
    """Index of the sample with a stamp."""
    return round((stamp_ns - run.start_ns) * 1e-9 / run.period)


def one_cycle() -> tuple[Array, Array, Array]:
    """Displacement [m], velocity [m/s] and acceleration [m/s²] over one cycle, shape (256,)."""
    time = np.arange(256) / (256.0 * FREQUENCY)
    motion = SineMotion(AMPLITUDE, FREQUENCY).at(time)
    return motion.displacement, motion.velocity, motion.acceleration


def scale_of(present: Array, reference: Array) -> float:
    """Factor with which ``reference`` (n,) fits ``present`` (n,) best."""
    power = float(reference @ reference)
    return float(present @ reference) / power if power > 0.0 else math.nan


# -- a damper that heats ------------------------------------------------------------------

DURATION = 600.0
COLD, HOT = 28.0, 71.0
CONDUCTANCE = 0.2
"""Convection [W/K]; the heat capacity follows from the duration."""

DAMPER = EmulatedDamper(COLD_DAMPER, HOT_DAMPER)


def thermal_model(duration: float) -> ThermalModel:
    """Thermal model that heats the damper of this test from 28 to 71 °C in ``duration`` [s]."""
    cycle = one_cycle()
    powers = [
        float(np.mean(sine_force(values, *cycle, CURRENT) * cycle[1]))
        for values in (COLD_DAMPER, HOT_DAMPER)
    ]

    def excess(capacity: float) -> float:
        model = ThermalModel(capacity=capacity, conductance=CONDUCTANCE)
        celsius, steps = model.initial, 1000
        for _ in range(steps):
            warm = (celsius - COLD) / (HOT - COLD)
            power = powers[0] + warm * (powers[1] - powers[0])
            celsius = model.after(celsius, power, duration / steps)
        return celsius - HOT

    return ThermalModel(capacity=brentq(excess, 1e-3, 1e5), conductance=CONDUCTANCE)


def heated_run(duration: float = DURATION, seed: int = 1) -> Recording:
    """The recording of the drift."""
    return recording(DAMPER, duration, seed=seed, thermal=thermal_model(duration))


def drift_of(run: Recording, settings: TrackerSettings) -> tuple[float, Array, Array]:
    """Follow the drift and compare each report with the true values at its publication.

    Returns the 95th percentile of the absolute errors of the force scale [1], and the NRMSE (m,) on
    the next window of the set in use and of a separate least-squares fit to that window.
    """
    steps = follow(run, settings)
    length = round(WINDOW / run.period)
    first = next(step.report for step in steps if step.report.accepted)
    baseline_end = sample_of(run, first.stamp_ns) + 1
    baseline = _true_loop(run, slice(baseline_end - length, baseline_end))
    errors, predicted, fitted = [], [], []
    for step in steps:
        end = sample_of(run, step.report.stamp_ns) + 1
        if np.isfinite(step.report.scale.value):
            truth = scale_of(_true_loop(run, slice(end - 1, end)), baseline)
            errors.append(step.report.scale.value / truth - 1.0)
        if end >= baseline_end and end + length <= run.force.size:
            part = slice(end, end + length)
            ahead = Window.from_samples(
                run.displacement[part], run.force[part], run.current[part], run.period
            )
            left = MODELS["sigmoid"].window_force(ahead, step.parameters) - ahead.force
            predicted.append(float(np.sqrt(np.mean(left**2)) / np.std(ahead.force)))
            fitted.append(
                fit_window(MODELS["sigmoid"], ahead, step.parameters, method="least_squares").nrmse
            )
    return float(np.quantile(np.abs(errors), 0.95)), np.array(predicted), np.array(fitted)


def _true_loop(run: Recording, part: slice) -> Array:
    """Force (n,) of the true damper over one cycle, at the mean temperature of a part."""
    assert run.temperature is not None
    warm = (float(np.mean(run.temperature[part])) - COLD) / (HOT - COLD)
    cycle = one_cycle()
    cold, hot = (sine_force(p, *cycle, CURRENT) for p in (COLD_DAMPER, HOT_DAMPER))
    return np.asarray(cold + min(max(warm, 0.0), 1.0) * (hot - cold))


def drift_figures(duration: float = DURATION) -> Measured:
    """Run both trackers on the same recording."""
    run = heated_run(duration)
    scale, predicted, fitted = drift_of(run, TrackerSettings(tracker="window"))
    ukf_scale, *ukf = drift_of(run, TrackerSettings(tracker="recursive"))
    assert run.temperature is not None
    single = float(np.quantile(predicted / fitted, 0.95))
    return {
        "drift_scale_error_p95_percent": (
            100.0 * scale,
            f"To {float(run.temperature[-1]):.1f} °C in {duration:.0f} s.",
        ),
        "drift_nrmse_ratio": (
            _ratio(predicted, fitted),
            f"95th percentile of the single ratios: {single:.3f}.",
        ),
        "ukf_drift_scale_error_p95_percent": (
            100.0 * ukf_scale,
            f"Its NRMSE ratio: {_ratio(*ukf):.3f}.",
        ),
    }


def _ratio(predicted: Array, fitted: Array) -> float:
    return float(np.sqrt(np.mean(predicted**2) / np.mean(fitted**2)))


# -- a sudden loss of force ------------------------------------------------------------------

FACTOR = 0.9
WITHIN = 0.01
OFFSETS = tuple(place / 8.0 for place in range(8))
"""Times of the step, in fractions of a hop after the end of a window."""

_BEFORE, _AFTER = 8.0, 10.0


def windows_until_right(offset: float, settings: TrackerSettings) -> float:
    """Time from the step until the error of the set in use stays within 1 %, in window lengths.

    The error is the norm of the force error over a cycle, relative to the norm of the force. The
    time is infinite if the error does not stay within 1 %.
    """
    time = _BEFORE + offset * HOP
    run = recording(
        EmulatedDamper(COLD_DAMPER),
        time + _AFTER,
        seed=round(100 * offset),
        faults=[fault_of(f"force_loss:{FACTOR}@{time}")],
    )
    cycle = one_cycle()
    truth = sine_force(scaled(COLD_DAMPER, FACTOR), *cycle, CURRENT)
    right_since = np.inf
    for step in follow(run, settings):
        elapsed = (sample_of(run, step.report.stamp_ns) + 1) * run.period - time
        if elapsed <= 0.0:
            continue
        error = sine_force(step.parameters, *cycle, CURRENT) - truth
        right = bool(np.linalg.norm(error) <= WITHIN * np.linalg.norm(truth))
        right_since = min(right_since, elapsed) if right else np.inf
    return float(right_since) / WINDOW


def step_figures(offsets: Sequence[float] = OFFSETS) -> Measured:
    """Longest of these durations over steps at several times within a hop."""
    found, recursive = (
        [windows_until_right(offset, TrackerSettings(tracker=name)) for offset in offsets]
        for name in ("window", "recursive")
    )
    return {
        "step_windows": (max(found), f"Mean: {float(np.mean(found)):.2f}."),
        "ukf_step_windows": (max(recursive), f"Mean: {float(np.mean(recursive)):.2f}."),
    }


# -- dampers that do not change: stability, claimed errors, force scale ------------------------

WINDOWS = 600

MEMORIES = (0.0, 0.8, 0.95)
"""Memory of noise with the autocorrelation memory^lag, for samples 1 ms apart."""

REALISATIONS = 200
CONDITION = "5.0mm_1Hz_1.5A"
_SAMPLES = 2000
_RUN_IN = 500

MISFIT_WINDOWS = 100
_MISFIT_CURRENT, _SETTLING = 1.0, 2.0
_BOUC_WEN = {
    "c0": 4000.0,
    "k0": 1000.0,
    "c1": 60000.0,
    "k1": 500.0,
    "f0": 20.0,
    "alpha": 700.0,
    "share": 0.5,
    "n": 1.5,
}
_SOFT, _STIFF = 2e-3, 1.5e-4
"""Yield distances [m]. The sigmoid law fits each with an error of 5 to 12 %: the first in a sine of
5 mm and 1 Hz, the second in random motion."""


def exchanges(tracker: str, windows: int, seed: int = 3) -> int:
    """Number of set changes after the first set, for a constant damper of the exact law."""
    duration = WINDOW + (windows - 1) * HOP
    run = recording(EmulatedDamper(COLD_DAMPER), duration, seed=seed)
    steps = follow(run, TrackerSettings(tracker=tracker))
    verdicts = [step.report.verdict for step in steps]
    if Verdict.ACCEPTED not in verdicts:
        raise RuntimeError("no window of the constant damper was accepted")
    return sum(verdict.accepted for verdict in verdicts) - 1


def correlated_noise(memory: float, deviation: float, seed: int) -> Array:
    """Noise [N] of one window, shape (2000,)."""
    white = np.random.default_rng(seed).normal(
        0.0, deviation * math.sqrt(1.0 - memory**2), _SAMPLES + _RUN_IN
    )
    return np.asarray(lfilter([1.0], [1.0, -memory], white)[_RUN_IN:])


def error_ratios(memory: float, realisations: int) -> tuple[Array, Array]:
    """Claimed over actual errors (7,) of the coefficients, for window fits and for the tracker."""
    condition = find(CONDITION)
    truth = parameters(condition)
    rig = EmulatedRig(
        EmulatedDamper(truth),
        SineMotion(condition.amplitude, condition.frequency, phase=PHASE),
        condition.current,
        settings=RigSettings(displacement_noise=1e-6, force_noise=0.0),
    )
    clean = rig.record(_SAMPLES * rig.settings.period)
    tracker = WindowTracker(TrackerSettings(global_period=0), ParameterSet(truth))
    fits, errors, tracked, claimed = [], [], [], []
    for seed in range(realisations):
        force = clean.force + correlated_noise(memory, THESIS_FORCE_NOISE, seed)
        window = Window.from_samples(clean.displacement, force, clean.current, clean.period)
        fit = fit_window(MODELS["sigmoid"], window, truth, method="least_squares")
        fits.append(fit.coefficients)
        errors.append(np.sqrt(np.diag(fit.coefficient_covariance)))
        start_ns = round(seed * _SAMPLES * clean.period * NANOSECONDS)
        raw = RawWindow(start_ns, clean.period, clean.displacement, force, clean.current)
        report = tracker.follow(raw)
        if report is not None and report.confirms:
            tracked.append(report.coefficients)
            claimed.append(report.coefficient_errors)
    return _claimed_over_actual(errors, fits), _claimed_over_actual(claimed, tracked)


def _claimed_over_actual(errors: Sequence[Array], values: Sequence[Array]) -> Array:
    claimed = np.sqrt(np.mean(np.square(errors), axis=0))
    return np.asarray(claimed / np.std(values, axis=0, ddof=1))


def published_scales(
    motion: Excitation, truth: ParameterSet, windows: int
) -> tuple[Array, Array, float]:
    """Published force scales (w,) and their claimed errors for a damper of another law.

    The sigmoid law is tracked over windows that do not overlap. The first report with a scale
    defines the baseline and is left out. The last value is the median NRMSE of the fits.
    """
    settings = RigSettings(displacement_noise=1e-6, seed=5)
    rig = EmulatedRig(EmulatedDamper(truth), motion, _MISFIT_CURRENT, settings=settings)
    run = rig.record(_SETTLING + windows * WINDOW)
    run = recordings.cut(run, slice(round(_SETTLING / run.period), None))
    tracking = TrackerSettings(global_period=0, method="least_squares")
    steps = follow(run, tracking, hop=WINDOW)
    reports = [step.report for step in steps if step.report.confirms][1:]
    scales = [report.scale for report in reports if math.isfinite(report.scale.value)]
    return (
        np.array([scale.value for scale in scales]),
        np.array([scale.standard_error for scale in scales]),
        float(np.median([report.nrmse_after for report in reports])),
    )


def random_motion(duration: float, seed: int) -> SampledMotion:
    """Gaussian motion of 3 mm rms with a flat spectrum from 0.5 to 3 Hz, as a sum of many tones."""
    period, tones = 0.005, 200
    rng = np.random.default_rng(seed)
    rates = 2.0 * np.pi * rng.uniform(0.5, 3.0, tones)
    angles = np.outer(np.arange(round(duration / period) + 1) * period, rates)
    amplitudes = 3e-3 / math.sqrt(tones) * rng.standard_normal((2, tones))
    return SampledMotion(np.sin(angles) @ amplitudes[0] + np.cos(angles) @ amplitudes[1], period)


def bouc_wen(yield_length: float) -> ParameterSet:
    """A damper of 0.7 kN with the modified Bouc-Wen law, which the sigmoid law cannot reproduce."""
    model = MODELS["modified_bouc_wen"]
    values = model.starts(LoopReading(1000.0, 0.0, 0.03, 5e-3))[0].copy()
    for name, value in {**_BOUC_WEN, "yield_length": yield_length}.items():
        values[model.parameter_names.index(name)] = value
    return ParameterSet(values, model=model.name)


def chi_square(scales: Array, errors: Array) -> float:
    """Mean square of the deviations from the weighted mean, in standard errors [1]."""
    weights = errors**-2
    mean = float(weights @ scales) / float(np.sum(weights))
    return float(np.sum(((scales - mean) / errors) ** 2)) / (scales.size - 1)


def steady_figures(
    windows: int = WINDOWS,
    realisations: int = REALISATIONS,
    misfit_windows: int = MISFIT_WINDOWS,
) -> Measured:
    """Measure a damper of another law in two motions, correlated noise, and an exact damper."""
    counts = {name: exchanges(name, windows) for name in ("window", "recursive")}
    duration = misfit_windows * WINDOW + _SETTLING
    irregular_motion = random_motion(duration, seed=1)
    sine = published_scales(SineMotion(5e-3, 1.0), bouc_wen(_SOFT), misfit_windows)
    irregular = published_scales(irregular_motion, bouc_wen(_STIFF), misfit_windows)
    ratios = [error_ratios(memory, realisations) for memory in MEMORIES]
    scales = irregular[0]
    return {
        "misfit_error_ratio": (
            [
                float(np.median(errors) / np.std(published, ddof=1))
                for published, errors, _ in (sine, irregular)
            ],
            f"NRMSE of the fits: {sine[2]:.1%} and {irregular[2]:.1%}.",
        ),
        "scale_chi2": (
            chi_square(*irregular[:2]),
            f"Its mean: {float(np.mean(scales)):.3f}, the scatter {float(np.std(scales)):.3f}.",
        ),
        "ar1_error_ratio": [float(value) for pair in ratios for part in pair for value in part],
        "needless_exchanges": (
            float(max(counts.values())),
            ", ".join(f"{name}: {count}" for name, count in counts.items()),
        ),
    }
