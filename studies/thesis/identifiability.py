"""Reason for the scatter of the parameters: identifiability from one run and from all runs.

The Jacobian of the run with respect to relative changes of the sixteen parameters has seven
significant singular values and nine that are zero. The parameters can change along these nine
directions without any change of the loop. All runs without errata together leave few such
directions or none.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares

from mr_damper_ros.emulation.emulator import THESIS_FORCE_NOISE
from mr_damper_ros.models.published import find, parameters
from mr_damper_ros.models.sigmoid.law import COEFFICIENT_NAMES, PARAMETER_NAMES
from mr_damper_ros.report.document import GREY, INK, MARKS, Chapter, Picture
from mr_damper_ros.signals.arrays import Array
from studies.drawing import chart, table
from studies.program import Campaign, Part
from studies.thesis import facts, laws
from studies.thesis.runs import coefficients, cycle

CONDITION = "5.0mm_1Hz_1.5A"


def scaled_jacobian(name: str, noise_seed: int, values: Array) -> Array:
    """Derivatives (n, 16) of the run over the noise by relative changes of the parameters."""
    misfit = cycle(name, noise_seed)
    weight = np.sqrt(misfit.weight * misfit.sample_count)[:, np.newaxis]
    return np.asarray(misfit.jacobian(values) * values * weight / THESIS_FORCE_NOISE)


def descend(noise_seed: int, seed: list[int]) -> tuple[Array, float]:
    """Task: least squares over all sixteen parameters from a random start: set, RMSE [N]."""
    misfit = cycle(CONDITION, noise_seed)
    root = np.sqrt(misfit.weight)
    low, high = facts.SEARCH_LOW, facts.SEARCH_HIGH
    inside = 1e-3 + (1.0 - 2e-3) * np.random.default_rng(seed).random(low.size)
    fit = least_squares(
        lambda p: misfit.residual(p) * root,
        low + (high - low) * inside,
        jac=lambda p: misfit.jacobian(p) * root[:, np.newaxis],
        bounds=(low, high),
        x_scale=high - low,
    )
    return fit.x, float(np.sqrt(misfit.costs(fit.x)))


def identifiability_part(campaign: Campaign) -> Part:
    """The chapter on observability."""
    names, fits, _ = laws.identified(campaign)
    tasks = [{"noise_seed": campaign.seed, "seed": seed} for seed in campaign.seeds(5)]
    sets, errors = zip(*campaign.each("descents", descend, tasks), strict=True)
    truth = parameters(find(CONDITION))
    single = scaled_jacobian(CONDITION, campaign.seed, truth)
    _, one, directions = np.linalg.svd(single, full_matrices=False)
    values = fits["sigmoid"]["parameters"]
    pooled = np.vstack([scaled_jacobian(name, campaign.seed, values) for name in names])
    singular = [one, np.asarray(np.linalg.svd(pooled, compute_uv=False))]
    determined = [int(np.sum(each > 1e-6 * each[0])) for each in singular]

    floor = min(errors)
    good = np.array(sets)[np.array(errors) < 1.02 * floor]
    misfit = cycle(CONDITION, campaign.seed)
    seven = coefficients(good, misfit.peak_velocity, misfit.current)
    sizes = np.maximum(np.abs(np.mean(seven, axis=0)), 1e-12)
    chapter = Chapter(
        "observability",
        "Beyond the thesis: the reason for the scatter of the parameters",
        f"one run determines {determined[0]} of sixteen directions, all runs together "
        f"{determined[1]}.",
        [
            "A run at one peak velocity and one current depends on only seven coefficients of the "
            "law. The sixteen parameters act through these coefficients, so the loop does not "
            "change along nine directions in parameter space. For this reason the sets in the "
            "thesis scatter although every loop fits; the optimiser is not the cause.",
            _singular_figure(singular),
            _direction_figure(directions),
            _walk_figure(campaign.seed, truth, directions),
            table(
                "scatter",
                f"{len(good)} of {len(sets)} least-squares searches from random starts on the run "
                f"of 5 mm, 1 Hz, 1.5 A ended at the noise ({floor:.2f} N). The table gives the "
                "range of each parameter over these equally good sets, and its standard deviation "
                "relative to the width of the search bounds.",
                "Parameter | Smallest | Largest | Spread [1]",
                _spreads(PARAMETER_NAMES, good, facts.SEARCH_HIGH - facts.SEARCH_LOW),
            ),
            table(
                "scatter_coefficients",
                "The seven coefficients of the same sets (SI units), and their standard deviation "
                "relative to their mean: all sets agree to the digits shown.",
                "Coefficient | Smallest | Largest | Spread [1]",
                _spreads(COEFFICIENT_NAMES, seven, sizes),
            ),
            _scatter_figure(good),
        ],
    )
    return Part([chapter])


def _spreads(names: Sequence[str], sets: Array, sizes: Array) -> list[tuple[str | float, ...]]:
    """Name, smallest, largest and relative standard deviation of each column of sets (n, k)."""
    columns = (sets.min(axis=0), sets.max(axis=0), np.std(sets, axis=0) / sizes)
    return list(zip(names, *(column.tolist() for column in columns), strict=True))


def _singular_figure(singular: Sequence[Array]) -> Picture:
    picture, ((a,),) = chart(
        "singular_values",
        "Singular values of the Jacobian with respect to relative changes of the parameters, "
        "relative to the noise. With one run, nine of them are zero up to rounding: these "
        "directions are flat.",
        (1, 1, 5.6, 2.7),
        *("Direction", "Singular value [1]"),
    )
    x = np.arange(1, len(PARAMETER_NAMES) + 1)
    for number, label in enumerate(("one run", "all sound conditions, one set")):
        shown = np.maximum(singular[number], 1e-13)
        a.semilogy(x, shown, MARKS[number], color=INK[number], label=label)
    a.axhline(1.0, color="0.4", lw=0.7)
    a.text(8.0, 0.6, "a change of 100 % equals the noise", va="top", color="0.4", fontsize=7)
    a.set_xticks(x)
    a.legend(loc="lower left")
    return picture


def _direction_figure(directions: Array) -> Picture:
    picture, ((a,),) = chart(
        "directions",
        "Right singular vectors of the Jacobian of one run (5 mm, 1 Hz, 1.5 A). The area is the "
        "component of the parameter, filled if positive, open if negative. Directions below the "
        "line do not change the loop: in them, parameters of one group (f0, a1, k2, a2, I0; a0, "
        "k0; k1c, k1e, a4; k4, k3, a3, I1) compensate for each other.",
        (1, 1, 6.4, 6.0),
        *("Parameter", "Direction"),
    )
    for row, column in np.argwhere(np.abs(directions) > 0.03):
        part = directions[row, column]
        face = "0.15" if part > 0.0 else "white"
        style = {"facecolor": face, "edgecolor": "0.15", "linewidth": 0.7}
        a.scatter(column, row, s=230.0 * abs(part), **style)
    a.axhline(6.5, color=INK[1], lw=1.0)
    a.set_title("Above the line: determined by the run. Below: flat.", loc="right")
    a.set_xticks(range(len(PARAMETER_NAMES)), PARAMETER_NAMES)
    a.set_yticks(range(len(directions)), [str(k + 1) for k in range(len(directions))])
    a.set(xlim=(-0.6, 15.6), ylim=(15.6, -0.6))
    return picture


def _walk_figure(noise_seed: int, truth: Array, directions: Array) -> Picture:
    picture, ((a,),) = chart(
        "walks",
        "RMSE along straight lines from the published set, in a steep, a medium, a weak and a flat "
        "direction. Far from the set, a flat direction is curved, so the RMSE increases.",
        (1, 1, 5.0, 2.6),
        *("Step along the direction [% of the parameters]", "RMSE [N]"),
    )
    steps, misfit = np.linspace(-0.5, 0.5, 41), cycle(CONDITION, noise_seed)
    for number, direction in enumerate((1, 4, 7, 12)):
        walked = truth * (1.0 + np.outer(steps, directions[direction - 1]))
        style = {"color": INK[number], "marker": MARKS[number], "markevery": 5}
        rmse = np.sqrt(misfit.costs(walked))
        a.semilogy(100.0 * steps, rmse, label=f"direction {direction}", **style)
    a.legend(loc="upper right", ncols=2)
    a.set_ylim(top=3e4)
    return picture


def _scatter_figure(good: Array) -> Picture:
    picture, axes = chart(
        "scatter",
        "Sets that fit the same run equally well, to the noise: pairs of parameters that "
        "compensate for each other, in the units of the thesis.",
        (1, 4, 7.2, 2.1),
    )
    pairs = (("f0", "k2"), ("a0", "k0"), ("k1c", "a4"), ("k4", "k3"))
    for a, names in zip(axes[0], pairs, strict=True):
        columns = (good[:, PARAMETER_NAMES.index(name)] for name in names)
        a.plot(*columns, "o", ms=3, mfc=GREY, mec="0.2", mew=0.4)
        a.set(xlabel=names[0], ylabel=names[1])
        a.locator_params(nbins=4)
    return picture
