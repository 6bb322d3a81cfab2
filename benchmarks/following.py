"""Tracking by the engine of a damper that heats from 28 to 71 °C or loses a tenth of its force."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from benchmarks.figure import Measured
from mr_damper_ros.emulation.emulator import (
    Damper,
    EmulatedDamper,
    EmulatedRig,
    RigSettings,
    ThermalModel,
    scaled,
)
from mr_damper_ros.emulation.faults import Fault, fault_of
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.published import LITERATURE, THESIS_28_CELSIUS, THESIS_71_CELSIUS
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

DAMPER = EmulatedDamper(THESIS_28_CELSIUS, THESIS_71_CELSIUS)


def thermal_model(duration: float) -> ThermalModel:
    """Thermal model that heats the damper of this test from 28 to 71 °C in ``duration`` [s]."""
    cycle = one_cycle()
    powers = [
        float(np.mean(sine_force(values, *cycle, CURRENT) * cycle[1]))
        for values in (THESIS_28_CELSIUS, THESIS_71_CELSIUS)
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
    cold, hot = (sine_force(p, *cycle, CURRENT) for p in (THESIS_28_CELSIUS, THESIS_71_CELSIUS))
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
        EmulatedDamper(THESIS_28_CELSIUS),
        time + _AFTER,
        seed=round(100 * offset),
        faults=[fault_of(f"force_loss:{FACTOR}@{time}")],
    )
    cycle = one_cycle()
    truth = sine_force(scaled(THESIS_28_CELSIUS, FACTOR), *cycle, CURRENT)
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
