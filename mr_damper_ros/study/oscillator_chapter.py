"""Chapter of the report on the hysteretic benchmark, whose truth is known."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from mr_damper_ros.api.findings import as_json
from mr_damper_ros.models import MODELS
from mr_damper_ros.report.document import (
    DASHES,
    GREY,
    INK,
    Chapter,
    Picture,
    Table,
    Text,
    legend_above,
    panels,
    with_error,
)
from mr_damper_ros.study.hysteretic_oscillator import OUTPUT_NOISE, TRUTH
from mr_damper_ros.study.oscillator_trials import EstimationResult, OscillatorResult

_PUBLISHED = {
    "quadratic terms": (-85.32, 34),
    "degrees 2 and 3": (-90.35, 64),
    "degrees 2 to 5": (-94.87, 172),
    "degrees 2 to 7": (-97.96, 364),
    "degrees 3, 5 and 7": (-98.32, 217),
}
"""RMS error on the test multisine [dB of 1 m] and number of parameters of black-box models.

Polynomial nonlinear state-space models of J. P. Noël, A. F. Esfahani, G. Kerschen and J. Schoukens,
A nonlinear state-space approach to hysteresis identification, Mechanical Systems and Signal
Processing 84, 2017 (arXiv 1610.09138).
"""

_NUMBERS = (
    ("m", "mass", "kg"),
    ("c", "damping", "N s/m"),
    ("k", "stiffness", "N/m"),
    ("α", "alpha", "N/m"),
    ("βγ", "with_speed", "1/m"),
    ("βδ", "with_motion", "1/m"),
)


def oscillator_headline(found: Mapping[str, OscillatorResult], estimation: EstimationResult) -> str:
    """A sentence for the chapter."""
    best = min(found, key=lambda law: found[law].other)
    off = max(abs(value / truth - 1.0) for value, truth in _values(estimation))
    return (
        f"estimated in its own form, all six numbers are within {off:.1%} of the truth and the "
        f"motion within {1e6 * estimation.multisine_error:.2g} µm; of our laws, made for dampers "
        f"that yield, {best} leaves {found[best].other:.0%} of the force."
    )


def oscillator_chapter(
    found: Mapping[str, OscillatorResult], estimation: EstimationResult
) -> Chapter:
    """Motion in and force out, force in and motion out."""
    laws = Table(
        "oscillator_laws",
        "Each law identified from the displacement under one multisine, judged on another: NRMSE "
        "of the force in percent; RMS error of the displacement where its set carries the mass, "
        "and the same in dB of 1 m. –: a law of the peak velocity, which it has no use for here.",
        ("law", "parameters", "force, identified", "force, other", "motion (µm)", "motion (dB)"),
        [
            (
                law,
                len(MODELS[law].parameters),
                100.0 * result.identified,
                100.0 * result.other,
                *_missed(result.missed),
            )
            for law, result in found.items()
        ],
    )
    numbers = Table(
        "oscillator_numbers",
        f"The six numbers, estimated from one multisine and the displacement with "
        f"{1e6 * OUTPUT_NOISE:g} µm of noise: {estimation.evaluations} simulations, "
        f"{estimation.seconds:.0f} s.",
        ("", "truth", "estimate ± standard error", "unit", "off by (%)"),
        [
            (symbol, truth, with_error(value, error), unit, 100.0 * (value / truth - 1.0))
            for (symbol, _, unit), (value, truth), error in zip(
                _NUMBERS, _values(estimation), estimation.standard_errors.tolist(), strict=True
            )
        ],
    )
    own = [
        ("this form, six numbers", 6, *_missed(estimation.multisine_error)),
        ("linear, three numbers", 3, *_missed(estimation.linear_error)),
        *(
            (f"published, black box: {name}", count, 1e6 * 10.0 ** (error / 20.0), error)
            for name, (error, count) in _PUBLISHED.items()
        ),
    ]
    return Chapter(
        "oscillator",
        "The hysteretic benchmark",
        [
            Text(
                "Noël and Schoukens (2016): m y'' + c y' + k y + z = u with "
                "z' = α y' − β (γ |y'| z + δ y' |z|), m = 2 kg, c = 10 N s/m, k = α = 50 kN/m, "
                "β = 1000, γ = 0.8, δ = −1.1 (ν = 1), excited by a random-phase multisine of 50 N "
                "RMS from 5 to 150 Hz, simulated with 15 000 steps a second and sampled at 750 Hz. "
                "It is simulated here as published, with Newmark's steps; the signals are drawn by "
                "the same recipe, so that they are not the benchmark's own files."
            ),
            Text(
                "Motion in, force out: the laws get the displacement and answer with the force "
                "of spring, damper and hysteresis together. Here γ + δ is negative: the hysteresis "
                "hardens as it is loaded, and never yields. That of the laws bouc_wen and "
                "modified_bouc_wen tends to a largest force, as that of any MR damper does, so "
                "the truth is outside of every law here, and what they leave is what they cannot "
                "be. Their share and sharpness end at a bound."
            ),
            laws,
            _loops(found),
            Text(
                "Force in, motion out: the equations with free numbers, fitted by least squares "
                "of the displacement from the best linear oscillator on. β, γ and δ are one too "
                "many: only their products can be known."
            ),
            numbers,
            Table(
                "oscillator_errors",
                "RMS error of the simulated displacement under a multisine that was not used, "
                "without noise. The published models know nothing of the equations (black box), "
                "and were judged on the benchmark's own multisine: Noël, Esfahani, Kerschen and "
                "Schoukens, Mech. Syst. Signal Process. 84, 2017 (arXiv 1610.09138). Under a sweep "
                "from 20 to 50 Hz with 40 N the form estimated here is off by "
                f"{1e6 * estimation.sweep_error:.2g} µm.",
                ("model", "parameters", "error (µm)", "error (dB of 1 m)"),
                own,
            ),
        ],
    )


def _loops(found: Mapping[str, OscillatorResult]) -> Picture:
    chosen = sorted(found, key=lambda law: found[law].other)[:3]
    figure, axes = panels(1, len(chosen), 6.8, 2.8, sharey=True)
    for place, law in enumerate(chosen):
        displacement, truth, predicted = found[law].loop
        axis = axes[0, place]
        axis.plot(1e3 * displacement, truth, color=GREY, linewidth=2.0, label="truth")
        style = {"color": INK[1], "linestyle": DASHES[0], "linewidth": 0.8}
        axis.plot(1e3 * displacement, predicted, label="law", **style)
        axis.set(xlabel="displacement (mm)", title=law)
    axes[0, 0].set(ylabel="force (N)")
    legend_above(figure, axes[0, 0], 2)
    return Picture(
        "oscillator", "Half a second of the other multisine, the three best laws.", figure
    )


def oscillator_document(
    found: Mapping[str, OscillatorResult], estimation: EstimationResult
) -> dict[str, object]:
    """The figures of the chapter for the JSON file; NRMSE [1], errors [m]."""
    return {
        "laws": {
            law: {
                "force_nrmse_identified": result.identified,
                "force_nrmse_other": result.other,
                "motion_rms_error": as_json(result.missed),
                "seconds": result.seconds,
            }
            for law, result in found.items()
        },
        "estimation": {
            name: {"truth": truth, "value": value, "standard_error": error, "unit": unit}
            for (_, name, unit), (value, truth), error in zip(
                _NUMBERS, _values(estimation), estimation.standard_errors.tolist(), strict=True
            )
        },
        "multisine_rms_error": estimation.multisine_error,
        "sweep_rms_error": estimation.sweep_error,
        "linear_rms_error": estimation.linear_error,
        "estimation_s": estimation.seconds,
    }


def _values(estimation: EstimationResult) -> list[tuple[float, float]]:
    """Estimate and truth of each number."""
    return [
        (getattr(estimation.found, name), float(getattr(TRUTH, name))) for _, name, _ in _NUMBERS
    ]


def _missed(error: float) -> tuple[float | None, float | None]:
    """An error [m] in µm and in dB."""
    if not math.isfinite(error):
        return None, None
    return 1e6 * error, 20.0 * float(np.log10(error))
