"""Stability of published sets, errors and force scale for a damper that does not change."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.signal import lfilter

from benchmarks import following
from benchmarks.figure import Measured
from mr_damper_ros.emulation.emulator import (
    THESIS_FORCE_NOISE,
    EmulatedDamper,
    EmulatedRig,
    RigSettings,
)
from mr_damper_ros.emulation.motions import Excitation, SampledMotion, SineMotion
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS, find, parameters
from mr_damper_ros.models.quantities import LoopReading
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.tracker import TrackerSettings, WindowTracker
from mr_damper_ros.tracking.window_assembler import RawWindow
from studies import recordings
from studies.thesis.published_runs import PHASE

WINDOWS = 600

MEMORIES = (0.0, 0.8, 0.95)
"""Memory of noise with the autocorrelation memory^lag, for samples 1 ms apart."""

REALISATIONS = 200
CONDITION = "5.0mm_1Hz_1.5A"
_SAMPLES = 2000
_RUN_IN = 500

MISFIT_WINDOWS = 100
_CURRENT, _SETTLING = 1.0, 2.0
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
    duration = following.WINDOW + (windows - 1) * following.HOP
    run = following.recording(EmulatedDamper(THESIS_28_CELSIUS), duration, seed=seed)
    steps = following.follow(run, TrackerSettings(tracker=tracker))
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
    return _ratio(errors, fits), _ratio(claimed, tracked)


def _ratio(errors: Sequence[Array], values: Sequence[Array]) -> Array:
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
    rig = EmulatedRig(EmulatedDamper(truth), motion, _CURRENT, settings=settings)
    run = rig.record(_SETTLING + windows * following.WINDOW)
    part = slice(round(_SETTLING / run.period), None)
    run = recordings.cut(run, part)
    settings_of_tracker = TrackerSettings(global_period=0, method="least_squares")
    steps = following.follow(run, settings_of_tracker, hop=following.WINDOW)
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


def figures(
    windows: int = WINDOWS,
    realisations: int = REALISATIONS,
    misfit_windows: int = MISFIT_WINDOWS,
) -> Measured:
    """Measure a damper of another law in two motions, correlated noise, and an exact damper."""
    counts = {name: exchanges(name, windows) for name in ("window", "recursive")}
    duration = misfit_windows * following.WINDOW + _SETTLING
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
