"""Sine and force identified in one condition, and the statistics of both errors.

Thesis 2.8 and 4.6, figures 17-21 and 37-39: 2.5 mm, 1 Hz, 0 A.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy import stats

from mr_damper_ros.emulation.emulator import THESIS_FORCE_NOISE
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.published import LITERATURE
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES
from mr_damper_ros.report.document import GREY, INK, Chapter, Picture, Table, chart
from mr_damper_ros.signals.arrays import Array
from studies.drawing import chapter, line
from studies.program import Campaign
from studies.thesis import facts
from studies.thesis.facts import Compared, comparison
from studies.thesis.runs import ACROSS, DISPLACEMENT_NOISE, recording, window
from studies.thesis.searches import fminsearch

CONDITION = "2.5mm_1Hz_0.0A"


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
    """Task: sine and force of a run, by Nelder-Mead over 16 and over 7 unknowns.

    Returns the ``sine``; the RMSE [N] of the literature set as printed first and as used later;
    evaluations and RMSE of both searches; both errors (n,); and one ``cycle`` for the figures.
    """
    run, w = recording(name, seed), window(name, seed)
    law, sine = MODELS["sigmoid"], w.motion.sine
    assert sine is not None  # the run is made of one

    def norm(parameters: Array) -> float:
        return float(np.linalg.norm(law.window_force(w, parameters) - w.force))

    # Appendix D prints the literature set twice, with either sign of k5.
    flipped = LITERATURE.copy()
    flipped[PARAMETER_NAMES.index("k5")] *= -1.0
    _, cost, evaluations = fminsearch(norm, flipped)
    seven = fit_window(law, w, flipped)
    fitted = sine.at(run.time).displacement + sine.offset
    force = law.window_force(w, seven.parameters)
    drawn = {
        "time": run.time,
        "sine": 1e3 * fitted,
        "displacement": 1e3 * run.displacement,
        "velocity": w.motion.velocity,
        "force": w.force,
        "identified": force,
        "literature": law.window_force(w, flipped),
    }
    shown = slice(0, round(1.0 / sine.frequency / run.period))
    root = np.sqrt(w.sample_count)
    return {
        "sine": sine,
        "starts": (norm(LITERATURE) / root, norm(flipped) / root),
        "sixteen": (evaluations, cost / root),
        "seven": (seven.evaluations, seven.rmse),
        "displacement_error": fitted - run.displacement,
        "force_error": force - w.force,
        "cycle": {name: values[shown] for name, values in drawn.items()},
    }


def force_error_part(campaign: Campaign) -> Iterator[Chapter]:
    """The chapter on both errors."""
    found = campaign.each("force_error", identify, [CONDITION], seed=campaign.seed)[CONDITION]
    sine, errors = found["sine"], normal_statistics(found["force_error"])
    scatter = 1e6 * normal_statistics(found["displacement_error"])["sigma"]
    sines: list[Compared] = [
        ("amplitude", "mm", 1e3 * sine.amplitude, 2.5, "Fig. 17"),
        ("frequency", "Hz", sine.frequency, 1.0, "Fig. 17"),
        ("phase", "rad", sine.phase, facts.SINE["phase"], "App. D"),
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
    printed, used = found["starts"]
    yield chapter(
        "force-error",
        "Sine and force identified, and their errors",
        f"the force error has σ = {errors['sigma']:.2f} N (thesis {facts.FORCE_ERROR['sigma']:.2f} "
        f"N) and is normal; seven unknowns fit as well as sixteen, in {found['seven'][0]} "
        f"evaluations instead of {found['sixteen'][0]}.",
        "The run of 2.5 mm, 1 Hz, 0 A has 7001 samples. The noise of the force has the standard "
        "deviation that the thesis reports. Our residual has the same standard deviation, so it "
        "contains only noise. The extremes are single samples, which scatter by a newton or two "
        f"between seeds. The noise of the displacement ({1e6 * DISPLACEMENT_NOISE:.0f} µm) is "
        "assumed, because the thesis does not state it.",
        comparison("sine", "Sine fitted to the displacement.", sines),
        _sine_figure(found),
        Table(
            "force_fit",
            "Force fitted by Nelder–Mead from the literature set, over all sixteen parameters (as "
            "in the thesis) and over the seven that one run determines. The added noise has a "
            f"standard deviation of {THESIS_FORCE_NOISE:.4g} N.",
            "Search | Evaluations | RMSE [N]",
            [
                ("start: literature as printed first (k5 = −0.260)", 1, printed),
                ("start: literature as used later (k5 = +0.260)", 1, used),
                ("Nelder–Mead, 16 unknowns", *found["sixteen"]),
                ("Nelder–Mead, 7 unknowns", *found["seven"]),
            ],
        ),
        "Appendix D prints the literature set twice, once with k5 = −0.260 and once with +0.260. "
        "The search starts from the positive value, because only this value shifts the loop in the "
        "direction of this run.",
        comparison(
            "force_error",
            "Error of the fitted force. The thesis states the numbers of two different samples: "
            "its variance of 31.01 N² is not the square of its σ of 5.526 N (30.54 N²), and its "
            "mean differs from its μ.",
            forces,
            zeros=("mean", "mu"),
        ),
        _force_figure(found["cycle"]),
        _error_figure(np.sort(found["force_error"])),
    )


def _sine_figure(found: dict[str, Any]) -> Picture:
    picture, ((left, right),) = chart(
        "sine",
        "Sine fitted to the displacement, one of seven cycles (thesis Fig. 17), and the histogram "
        "of its error with the normal fit (Fig. 18). Re-synthesised run.",
        (1, 2, 6.6, 2.5),
    )
    cycle = found["cycle"]
    left.plot(cycle["time"], cycle["displacement"], color=GREY, lw=2.4, label="run")
    left.plot(cycle["time"], cycle["sine"], "--", color=INK[0], label="fitted sine")
    left.set(xlabel="Time [s]", ylabel="Displacement [mm]", ylim=(-2.8, 3.6))
    left.legend(ncols=2, loc="upper center")
    _histogram(right, 1e6 * found["displacement_error"], "Displacement error [µm]")
    return picture


def _force_figure(cycle: dict[str, Array]) -> Picture:
    picture, axes = chart(
        "force_fit",
        "Run, identified force and force of the literature set (thesis Fig. 19 and 37); one cycle. "
        "Re-synthesised run.",
        (1, 2, 6.6, 2.9),
    )
    for a, key in zip(axes[0], ("displacement", "velocity"), strict=True):
        a.plot(cycle[key], cycle["force"], ".", ms=2, color=GREY, label="run")
        a.plot(cycle[key], cycle["identified"], color=INK[0], label="identified")
        a.plot(cycle[key], cycle["literature"], label="literature", **line(1))
        a.set(xlabel=ACROSS[key], ylabel="Force [N]")
        a.locator_params(axis="x", nbins=6)
    axes[0, 1].legend(loc="upper left")
    return picture


def _error_figure(error: Array) -> Picture:
    """Histogram and quantiles of a sorted error (n,)."""
    picture, ((left, right),) = chart(
        "force_error",
        "Histogram of the force error with the normal fit, and quantiles against those of the "
        "normal distribution (thesis Fig. 20, 21, 38, 39). Re-synthesised run.",
        (1, 2, 6.6, 2.7),
    )
    _histogram(left, error, "Force error [N]")
    places = np.arange(error.size)
    theory = stats.norm.ppf((places + 0.5) / error.size)
    # All of the tails, and every tenth sample between them.
    chosen = (places < 100) | (places >= error.size - 100) | (places % 10 == 0)
    right.plot(theory[chosen], error[chosen], ".", ms=2.5, color=GREY)
    ends = np.array([-4.0, 4.0])
    right.plot(ends, error.mean() + ends * error.std(), color=INK[0])
    right.set(xlabel="Standard normal quantile [1]", ylabel="Quantile of the force error [N]")
    return picture


def _histogram(axes: Any, values: Array, label: str) -> None:
    axes.hist(values, bins=50, color="0.85", edgecolor="0.55", linewidth=0.3)
    x = np.linspace(values.min(), values.max(), 200)
    width = np.ptp(values) / 50
    axes.plot(x, values.size * width * stats.norm.pdf(x, values.mean(), values.std()), color=INK[0])
    axes.set(xlabel=label, ylabel="Samples per bin [1]")
