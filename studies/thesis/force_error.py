"""Sine and force identified in one condition, and the statistics of both errors.

Thesis 2.8 and 4.6, figures 17-21 and 37-39: 2.5 mm, 1 Hz, 0 A.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import stats

from mr_damper_ros.emulation.emulator import THESIS_FORCE_NOISE
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.published import LITERATURE
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES
from mr_damper_ros.report.document import GREY, INK, Block, Picture, Table, Text, panels
from mr_damper_ros.signals.arrays import Array
from studies.drawing import line
from studies.program import Campaign
from studies.thesis import facts
from studies.thesis.compared import Compared, comparison
from studies.thesis.runs import DISPLACEMENT_NOISE, recording, window
from studies.thesis.searches import fminsearch

CONDITION = "2.5mm_1Hz_0.0A"

K5 = PARAMETER_NAMES.index("k5")


def normal_statistics(error: Array) -> dict[str, float]:
    """Sample statistics and normal fit of an error (n,), with 95 % intervals.

    ``mu`` and ``sigma`` are the fitted normal's; the intervals are those of MATLAB's normfit:
    Student's t for the mean, chi square for the standard deviation.
    """
    n = error.size
    mean, sigma = float(np.mean(error)), float(np.std(error, ddof=1))
    reach = float(stats.t.ppf(0.975, n - 1)) * sigma / np.sqrt(n)
    low, high = (sigma * np.sqrt((n - 1) / stats.chi2.ppf(q, n - 1)) for q in (0.975, 0.025))
    return {
        "sample_size": float(n),
        "minimum": float(np.min(error)),
        "maximum": float(np.max(error)),
        "mean": mean,
        "variance": sigma**2,
        "mu": mean,
        "mu_low": mean - reach,
        "mu_high": mean + reach,
        "sigma": sigma,
        "sigma_low": float(low),
        "sigma_high": float(high),
        "skewness": float(stats.skew(error)),
        "excess_kurtosis": float(stats.kurtosis(error)),
    }


def identify(name: str, seed: int) -> dict[str, Any]:
    """Task: sine, force by Nelder-Mead (16 and 7 unknowns), errors."""
    run, w = recording(name, seed), window(name, seed)
    sine = w.motion.sine
    if sine is None:
        raise ValueError(f"the displacement of {name} is no sine")

    def norm(parameters: Array) -> float:
        return float(np.linalg.norm(MODELS["sigmoid"].window_force(w, parameters) - w.force))

    # Appendix D prints the literature set twice, with either sign of k5.
    flipped = LITERATURE.copy()
    flipped[K5] *= -1.0
    starts = {"printed": norm(LITERATURE), "k5 positive": norm(flipped)}
    found, cost, evaluations = fminsearch(norm, flipped)
    seven = fit_window(MODELS["sigmoid"], w, flipped)
    shown = slice(0, round(1.0 / sine.frequency / run.period))
    fitted = sine.at(run.time).displacement + sine.offset
    sixteen_force, force, literature = (
        MODELS["sigmoid"].window_force(w, values) for values in (found, seven.parameters, flipped)
    )
    drawn = {
        "time": run.time,
        "displacement": run.displacement,
        "fitted_displacement": fitted,
        "velocity": w.motion.velocity,
        "force": w.force,
        "fitted_force": force,
        "literature_force": literature,
    }
    names = ("amplitude", "frequency", "phase", "offset")
    return {
        "sine": {name: getattr(sine, name) for name in names},
        "starts_rmse": {k: v / np.sqrt(w.sample_count) for k, v in starts.items()},
        "nelder_mead_16": {
            "parameters": found.tolist(),
            "evaluations": evaluations,
            "statistics": normal_statistics(sixteen_force - w.force),
            "rmse": cost / np.sqrt(w.sample_count),
        },
        "nelder_mead_7": {
            "parameters": seven.parameters.tolist(),
            "evaluations": seven.evaluations,
            "rmse": seven.rmse,
        },
        "displacement_statistics": normal_statistics(fitted - run.displacement),
        "force_statistics": normal_statistics(force - w.force),
        "displacement_error": (fitted - run.displacement).tolist(),
        "force_error": (force - w.force).tolist(),
        # One cycle is enough for the figures.
        **{name: values[shown].tolist() for name, values in drawn.items()},
    }


def compute(campaign: Campaign) -> dict[str, Any]:
    """Data of the section."""
    task = {"name": CONDITION, "seed": campaign.seed}
    (data,) = campaign.each_kept("force_error", identify, [task])
    return dict(data)


def headline(data: dict[str, Any]) -> str:
    """The result in a sentence."""
    ours, theirs = data["force_statistics"], facts.FORCE_ERROR
    return (
        f"the force error has σ = {ours['sigma']:.2f} N (thesis {theirs['sigma']:.2f} N) and is "
        f"normal; seven unknowns fit as well as sixteen, in {data['nelder_mead_7']['evaluations']} "
        f"evaluations instead of {data['nelder_mead_16']['evaluations']}."
    )


def show(data: dict[str, Any]) -> list[Block]:
    """Text, tables and figures of the section."""
    sine, errors = data["sine"], data["force_statistics"]
    scatter = 1e6 * data["displacement_statistics"]["sigma"]
    sines: list[Compared] = [
        ("amplitude", "mm", 1e3 * sine["amplitude"], 2.5, "Fig. 17"),
        ("frequency", "Hz", sine["frequency"], 1.0, "Fig. 17"),
        ("phase", "rad", sine["phase"], facts.SINE["phase"], "App. D"),
        ("displacement error, standard deviation", "µm", scatter, None, "Fig. 18"),
    ]
    units = {"sample_size": "1", "variance": "N²"}
    forces: list[Compared] = [
        (name.replace("_", " "), units.get(name, "N"), errors[name], stated, "4.6, Fig. 38, 39")
        for name, stated in facts.FORCE_ERROR.items()
    ]
    forces += [
        (name.replace("_", " "), "1", errors[name], None, "")
        for name in ("skewness", "excess_kurtosis")
    ]
    begun = data["starts_rmse"]
    fits = Table(
        "force_fit",
        "Force fitted by Nelder–Mead from the literature set, over all sixteen parameters (as in "
        "the thesis) and over the seven that one run determines. The added noise has a standard "
        f"deviation of {THESIS_FORCE_NOISE:.4g} N.",
        ("Search", "Evaluations", "RMSE [N]"),
        [
            ("start: literature as printed first (k5 = −0.260)", 1, begun["printed"]),
            (
                "start: literature as used later (k5 = +0.260)",
                1,
                begun["k5 positive"],
            ),
            *(
                (f"Nelder–Mead, {number} unknowns", fit["evaluations"], fit["rmse"])
                for number, fit in ((16, data["nelder_mead_16"]), (7, data["nelder_mead_7"]))
            ),
        ],
    )
    return [
        Text(
            "The run of 2.5 mm, 1 Hz, 0 A has 7001 samples. The noise of the force has the "
            "standard deviation that the thesis reports. Our residual has the same standard "
            "deviation, so it contains only noise. The extremes are single samples, which scatter "
            "by a newton or two between seeds. The noise of the displacement "
            f"({1e6 * DISPLACEMENT_NOISE:.0f} µm) is assumed, because the thesis does not state it."
        ),
        comparison("sine", "Sine fitted to the displacement.", sines),
        _sine_figure(data),
        fits,
        Text(
            "Appendix D prints the literature set twice, once with k5 = −0.260 and once with "
            "+0.260. The search starts from the positive value, because only this value shifts the "
            "loop in the direction of this run."
        ),
        comparison(
            "force_error",
            "Error of the fitted force. The thesis states the numbers of two different samples: "
            "its variance of 31.01 N² is not the square of its σ of 5.526 N (30.54 N²), and its "
            "mean differs from its μ.",
            forces,
            zeros=("mean", "mu"),
        ),
        _force_figure(data),
        _error_figure(data),
    ]


def _sine_figure(data: dict[str, Any]) -> Picture:
    figure, axes = panels(1, 2, 6.6, 2.5)
    left, right = axes[0]
    time = np.array(data["time"])
    left.plot(time, 1e3 * np.array(data["displacement"]), color=GREY, lw=2.4, label="run")
    left.plot(
        time, 1e3 * np.array(data["fitted_displacement"]), "--", color=INK[0], label="fitted sine"
    )
    left.set(xlabel="Time [s]", ylabel="Displacement [mm]", ylim=(-2.8, 3.6))
    left.legend(ncols=2, loc="upper center")
    _histogram(right, 1e6 * np.array(data["displacement_error"]), "Displacement error [µm]")
    return Picture(
        "sine",
        "Sine fitted to the displacement, one of seven cycles (thesis Fig. 17), and the histogram "
        "of its error with the normal fit (Fig. 18). Re-synthesised run.",
        figure,
    )


def _force_figure(data: dict[str, Any]) -> Picture:
    figure, axes = panels(1, 2, 6.6, 2.9)
    for place, (key, scale, label) in enumerate(
        (("displacement", 1e3, "Displacement [mm]"), ("velocity", 1.0, "Velocity [m/s]"))
    ):
        a = axes[0, place]
        x = scale * np.array(data[key])
        a.plot(x, data["force"], ".", ms=2, color=GREY, label="run")
        a.plot(x, data["fitted_force"], color=INK[0], label="identified")
        a.plot(x, data["literature_force"], label="literature", **line(1))
        a.set(xlabel=label, ylabel="Force [N]")
        a.locator_params(axis="x", nbins=6)
    axes[0, 1].legend(loc="upper left")
    return Picture(
        "force_fit",
        "Run, identified force and force of the literature set (thesis Fig. 19 and 37); one cycle. "
        "Re-synthesised run.",
        figure,
    )


def _error_figure(data: dict[str, Any]) -> Picture:
    error = np.sort(np.array(data["force_error"]))
    figure, axes = panels(1, 2, 6.6, 2.7)
    _histogram(axes[0, 0], error, "Force error [N]")
    a = axes[0, 1]
    places = np.arange(error.size)
    theory = stats.norm.ppf((places + 0.5) / error.size)
    # All of the tails, and every tenth sample between them.
    tails = (places < 100) | (places >= error.size - 100)
    chosen = tails | (places % 10 == 0)
    a.plot(theory[chosen], error[chosen], ".", ms=2.5, color=GREY)
    ends = np.array([-4.0, 4.0])
    a.plot(ends, error.mean() + ends * error.std(), color=INK[0])
    a.set(xlabel="Standard normal quantile [1]", ylabel="Quantile of the force error [N]")
    return Picture(
        "force_error",
        "Histogram of the force error with the normal fit, and quantiles against those of the "
        "normal distribution (thesis Fig. 20, 21, 38, 39). Re-synthesised run.",
        figure,
    )


def _histogram(axes: Any, values: Array, label: str) -> None:
    axes.hist(values, bins=50, color="0.85", edgecolor="0.55", linewidth=0.3)
    x = np.linspace(values.min(), values.max(), 200)
    width = np.ptp(values) / 50
    axes.plot(x, values.size * width * stats.norm.pdf(x, values.mean(), values.std()), color=INK[0])
    axes.set(xlabel=label, ylabel="Samples per bin [1]")
