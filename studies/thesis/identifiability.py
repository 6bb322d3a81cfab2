"""Reason for the scatter of the parameters: identifiability from one run and from all runs.

The Jacobian of the run with respect to relative changes of the sixteen parameters has seven
significant singular values and nine that are zero. The parameters can change along these nine
directions without any change of the loop. All runs without errata together leave few such
directions or none.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from mr_damper_ros.emulation.emulator import THESIS_FORCE_NOISE
from mr_damper_ros.models.published import find, parameters
from mr_damper_ros.models.sigmoid.law import COEFFICIENT_NAMES, PARAMETER_NAMES
from mr_damper_ros.report.document import GREY, INK, MARKS, Block, Picture, Table, Text, panels
from mr_damper_ros.signals.arrays import Array
from studies.program import Campaign
from studies.thesis import facts, one_set
from studies.thesis.runs import coefficients, cycle

CONDITION = "5.0mm_1Hz_1.5A"
_STARTS_PER_TASK = 10


def scaled_jacobian(name: str, noise_seed: int, values: Array) -> Array:
    """Derivatives (n, 16) of the run over the noise by relative changes of the parameters."""
    misfit = cycle(name, noise_seed)
    weight = np.sqrt(misfit.weight * misfit.sample_count)[:, np.newaxis]
    return np.asarray(misfit.jacobian(values) * values * weight / THESIS_FORCE_NOISE)


def descents(noise_seed: int, seeds: list[list[int]]) -> list[dict[str, Any]]:
    """Task: least squares over all sixteen parameters from random starts."""
    misfit = cycle(CONDITION, noise_seed)
    root = np.sqrt(misfit.weight)
    low, high = facts.SEARCH_LOW, facts.SEARCH_HIGH
    results = []
    for seed in seeds:
        inside = 1e-3 + (1.0 - 2e-3) * np.random.default_rng(seed).random(low.size)
        fit = least_squares(
            lambda p: misfit.residual(p) * root,
            low + (high - low) * inside,
            jac=lambda p: misfit.jacobian(p) * root[:, np.newaxis],
            bounds=(low, high),
            x_scale=high - low,
        )
        results.append({"parameters": fit.x.tolist(), "rmse": float(np.sqrt(misfit.costs(fit.x)))})
    return results


def compute(campaign: Campaign) -> dict[str, Any]:
    """Data of the section."""
    whole = one_set.identified(campaign)
    names, values = whole["names"], np.array(whole["laws"]["sigmoid"]["parameters"])
    seeds = campaign.seeds(5)
    parts = [seeds[k : k + _STARTS_PER_TASK] for k in range(0, len(seeds), _STARTS_PER_TASK)]
    tasks = [{"noise_seed": campaign.seed, "seeds": part} for part in parts]
    fits = [fit for part in campaign.each_kept("descents", descents, tasks) for fit in part]

    truth = parameters(find(CONDITION))
    single = scaled_jacobian(CONDITION, campaign.seed, truth)
    _, one, directions = np.linalg.svd(single, full_matrices=False)
    pooled = np.vstack([scaled_jacobian(name, campaign.seed, values) for name in names])
    together = np.linalg.svd(pooled, compute_uv=False)

    floor = min(fit["rmse"] for fit in fits)
    good = np.array([fit["parameters"] for fit in fits if fit["rmse"] < 1.02 * floor])
    misfit = cycle(CONDITION, campaign.seed)
    steady = coefficients(good, misfit.peak_velocity, misfit.current)
    return {
        "singular_one": one.tolist(),
        "singular_all": together.tolist(),
        "directions": directions.tolist(),
        "walks": _walks(campaign.seed, truth, directions),
        "floor": floor,
        "starts": len(fits),
        "good": good.tolist(),
        "coefficients": steady.tolist(),
    }


_STEPS = np.linspace(-0.5, 0.5, 41)


def _walks(noise_seed: int, truth: Array, directions: Array) -> dict[str, list[float]]:
    """RMSE [N] along straight steps of relative size ``_STEPS`` in four directions."""
    misfit = cycle(CONDITION, noise_seed)
    return {
        str(number): [
            float(np.sqrt(misfit.costs(truth * (1.0 + step * directions[number - 1]))))
            for step in _STEPS
        ]
        for number in (1, 4, 7, 12)
    }


def headline(data: dict[str, Any]) -> str:
    """The result in a sentence."""
    determined = [
        int(np.sum(np.array(data[key]) > 1e-6 * data[key][0]))
        for key in ("singular_one", "singular_all")
    ]
    return (
        f"one run determines {determined[0]} of sixteen directions, all runs together "
        f"{determined[1]}."
    )


def show(data: dict[str, Any]) -> list[Block]:
    """Text, tables and figures of the section."""
    good, seven = np.array(data["good"]), np.array(data["coefficients"])
    scatter = _spreads(PARAMETER_NAMES, good, facts.SEARCH_HIGH - facts.SEARCH_LOW)
    sizes = np.maximum(np.abs(np.mean(seven, axis=0)), 1e-12)
    steady = _spreads(COEFFICIENT_NAMES, seven, sizes)
    return [
        Text(
            "A run at one peak velocity and one current depends on only seven coefficients of the "
            "law. The sixteen parameters act through these coefficients, so the loop does not "
            "change along nine directions in parameter space. For this reason the sets in the "
            "thesis scatter although every loop fits; the optimiser is not the cause."
        ),
        _singular_figure(data),
        _direction_figure(data),
        _walk_figure(data),
        Table(
            "scatter",
            f"{len(good)} of {data['starts']} least-squares searches from random starts on the run "
            f"of 5 mm, 1 Hz, 1.5 A ended at the noise ({data['floor']:.2f} N). The table gives the "
            "range of each parameter over these equally good sets, and its standard deviation "
            "relative to the width of the search bounds.",
            ("Parameter", "Smallest", "Largest", "Spread [1]"),
            scatter,
        ),
        Table(
            "scatter_coefficients",
            "The seven coefficients of the same sets (SI units), and their standard deviation "
            "relative to their mean: all sets agree to the digits shown.",
            ("Coefficient", "Smallest", "Largest", "Spread [1]"),
            steady,
        ),
        _scatter_figure(good),
    ]


def _spreads(names: Sequence[str], sets: Array, sizes: Array) -> list[tuple[str | float, ...]]:
    """Name, smallest, largest and relative standard deviation of each column of sets (n, k)."""
    columns = (sets.min(axis=0), sets.max(axis=0), np.std(sets, axis=0) / sizes)
    return [(name, *map(float, row)) for name, row in zip(names, np.stack(columns).T, strict=True)]


def _singular_figure(data: dict[str, Any]) -> Picture:
    figure, axes = panels(1, 1, 5.6, 2.7)
    a = axes[0, 0]
    x = np.arange(1, len(PARAMETER_NAMES) + 1)
    for number, (key, label) in enumerate(
        (("singular_one", "one run"), ("singular_all", "all sound conditions, one set"))
    ):
        shown = np.maximum(data[key], 1e-13)
        a.semilogy(x, shown, MARKS[number], color=INK[number], label=label)
    a.axhline(1.0, color="0.4", lw=0.7)
    a.text(8.0, 0.6, "a change of 100 % equals the noise", va="top", color="0.4", fontsize=7)
    a.set(xlabel="Direction", ylabel="Singular value [1]", xticks=x)
    a.legend(loc="lower left")
    return Picture(
        "singular_values",
        "Singular values of the Jacobian with respect to relative changes of the parameters, "
        "relative to the noise. With one run, nine of them are zero up to rounding: these "
        "directions are flat.",
        figure,
    )


def _direction_figure(data: dict[str, Any]) -> Picture:
    figure, axes = panels(1, 1, 6.4, 6.0)
    a = axes[0, 0]
    directions = np.array(data["directions"])
    rows, columns = np.nonzero(np.abs(directions) > 0.03)
    for row, column in zip(rows, columns, strict=True):
        part = directions[row, column]
        face = "0.15" if part > 0.0 else "white"
        style = {"facecolor": face, "edgecolor": "0.15", "linewidth": 0.7}
        a.scatter(column, row, s=230.0 * abs(part), **style)
    a.axhline(6.5, color=INK[1], lw=1.0)
    a.set_title("Above the line: determined by the run. Below: flat.", loc="right")
    a.set_xticks(range(len(PARAMETER_NAMES)), PARAMETER_NAMES)
    a.set_yticks(range(len(directions)), [str(k + 1) for k in range(len(directions))])
    a.set(xlim=(-0.6, 15.6), ylim=(15.6, -0.6), xlabel="Parameter", ylabel="Direction")
    return Picture(
        "directions",
        "Right singular vectors of the Jacobian of one run (5 mm, 1 Hz, 1.5 A). The area is the "
        "component of the parameter, filled if positive, open if negative. Directions below the "
        "line do not change the loop: in them, parameters of one group (f0, a1, k2, a2, I0; a0, "
        "k0; k1c, k1e, a4; k4, k3, a3, I1) compensate for each other.",
        figure,
    )


def _walk_figure(data: dict[str, Any]) -> Picture:
    figure, axes = panels(1, 1, 5.0, 2.6)
    a = axes[0, 0]
    for number, (key, rmse) in enumerate(data["walks"].items()):
        style = {"color": INK[number], "marker": MARKS[number], "markevery": 5}
        a.semilogy(100.0 * _STEPS, rmse, label=f"direction {key}", **style)
    a.set(xlabel="Step along the direction [% of the parameters]", ylabel="RMSE [N]")
    a.legend(loc="upper right", ncols=2)
    a.set_ylim(top=3e4)
    return Picture(
        "walks",
        "RMSE along straight lines from the published set, in a steep, a medium, a weak and a flat "
        "direction. Far from the set, a flat direction is curved, so the RMSE increases.",
        figure,
    )


def _scatter_figure(good: Array) -> Picture:
    pairs = (("f0", "k2"), ("a0", "k0"), ("k1c", "a4"), ("k4", "k3"))
    figure, axes = panels(1, 4, 7.2, 2.1)
    for a, (one, two) in zip(axes[0], pairs, strict=True):
        i, j = PARAMETER_NAMES.index(one), PARAMETER_NAMES.index(two)
        a.plot(good[:, i], good[:, j], "o", ms=3, mfc=GREY, mec="0.2", mew=0.4)
        a.set(xlabel=one, ylabel=two)
        a.locator_params(nbins=4)
    return Picture(
        "scatter",
        "Sets that fit the same run equally well, to the noise: pairs of parameters that "
        "compensate for each other, in the units of the thesis.",
        figure,
    )
