"""How far one run determines the parameters: sensitivity of the force, and identifiability.

Sensitivity: thesis 4.8, figures 42-52, tables 13 and 14. The thesis does not define its "error of
the force". The sum of the squared change over the 7001 samples, for a change of 20 %, reproduces
its numbers, so this definition is used.

Identifiability is the reason for the scatter of the parameters. The Jacobian of the run with
respect to relative changes of the sixteen parameters has seven significant singular values and nine
that are zero. The parameters can change along these nine directions without any change of the loop.
All runs without errata together leave few such directions or none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from mr_damper_ros.emulation.emulator import THESIS_FORCE_NOISE
from mr_damper_ros.models.published import find, parameters
from mr_damper_ros.models.sigmoid.law import COEFFICIENT_NAMES, PARAMETER_NAMES, sine_force
from mr_damper_ros.report.document import GREY, INK, Chapter, Picture, Table, chart, legend_above
from mr_damper_ros.signals.arrays import Array
from studies.drawing import chapter, line
from studies.program import Campaign
from studies.thesis import facts, laws
from studies.thesis.facts import comparison, percent
from studies.thesis.runs import Loop, coefficients, cycle, loop, window

# -- sensitivity of the force ----------------------------------------------------------------------

CONDITION = "2.5mm_1Hz_0.0A"
WITH_CURRENT = "2.5mm_1Hz_1.0A"
CHANGES = (0.01, 0.05, 0.10, 0.15, 0.20)
_DRAWN = (0.0, 0.10, 0.20)


def squared_change(condition: str, seed: int) -> dict[str, list[float]]:
    """Sum of the squared change of the force [N²] by parameter, one for each of ``CHANGES``."""
    m, count = window(condition, seed).motion, len(PARAMETER_NAMES)
    factors = 1.0 + np.array([change * one for one in np.eye(count) for change in (0.0, *CHANGES)])
    sets = parameters(find(condition)) * factors
    forces = sine_force(sets, m.displacement, m.velocity, m.acceleration, find(condition).current)
    forces = forces.reshape(count, 1 + len(CHANGES), -1)
    sums = np.sum((forces[:, 1:] - forces[:, :1]) ** 2, axis=2)
    return dict(zip(PARAMETER_NAMES, sums.tolist(), strict=True))


def sensitivity_part(campaign: Campaign) -> Iterator[Chapter]:
    """The chapter on the sensitivity."""
    passive, active = (squared_change(each, campaign.seed) for each in (CONDITION, WITH_CURRENT))
    order = sorted(PARAMETER_NAMES, key=lambda name: -passive[name][-1])
    apart = {
        name: passive[name][-1] / stated - 1.0
        for name, stated in facts.SENSITIVITY.items()
        if stated > 0.0
    }
    worst = max(apart, key=lambda name: abs(apart[name]))
    values = [
        (name, "N²", passive[name][-1], facts.SENSITIVITY[name], f"Table {13 + (place > 7)}")
        for place, name in enumerate(PARAMETER_NAMES)
    ]
    values.sort(key=lambda row: -facts.SENSITIVITY[row[0]])
    # Parameters with an effect, the strongest first.
    strongest = [name for name in order if passive[name][-1] > 0.0]
    yield chapter(
        "sensitivity",
        "Sensitivity of the force",
        f"the force depends most on {', '.join(order[:4])}, as in the thesis; our sums differ by "
        f"up to {percent(apart[worst])} ({worst}) from tables 13 and 14, whose values were read "
        "off figures.",
        "In the Nelder–Mead set of 2.5 mm, 1 Hz, 0 A, one parameter is changed at a time. The "
        "numbers in the thesis were read off its figures and rounded up; “CTE” (constant) in its "
        "tables is 0 here. At 0 A the two current terms cancel exactly, so I0, I1, a2, a3, k2 and "
        "k3 have no effect and cannot be identified. With current they have an effect, as the last "
        "column of the second table shows.",
        comparison(
            "sensitivity",
            "Sum of the squared change of the force over 7001 samples for a change of +20 %.",
            values,
        ),
        Table(
            "sensitivity_steps",
            "Sum of the squared change of the force for all changes, in N²; the last column is for "
            "2.5 mm, 1 Hz, 1.0 A.",
            f"Parameter | {' | '.join(f'+{100 * c:.0f} %' for c in CHANGES)} | +20 %, 1.0 A",
            [(name, *passive[name], active[name][-1]) for name in order],
        ),
        _sums_figure(passive, strongest),
        _changed_loops_figure(),
        _changes_figure(strongest),
    )


def _sums_figure(passive: dict[str, list[float]], strongest: list[str]) -> Picture:
    picture, axes = chart(
        "sensitivity",
        "Sum of the squared change of the force (thesis Fig. 42–52 b), 2.5 mm, 1 Hz, 0 A; crosses: "
        "tables 13 and 14. I0, I1, a2, a3, k2, k3 have no effect.",
        (1, 2, 6.8, 3.0),
        *("Change of the parameter [%]", "Sum of squared change [N²]"),
        sharey=True,
    )
    steps = [100.0 * change for change in CHANGES]
    for a, part in zip(axes[0], (strongest[:5], strongest[5:]), strict=True):
        for number, name in enumerate(part):
            a.semilogy(steps, passive[name], label=name, **line(number, marked=True))
            a.plot(steps[-1:], facts.SENSITIVITY[name], "x", color=INK[number], ms=6)
        a.legend(loc="lower right", ncols=2)
    return picture


def _changed_loops_figure() -> Picture:
    picture, axes = chart(
        "sensitivity_loops",
        "Loops with one of the four strongest parameters changed (thesis Fig. 42, 47, 48, 51 a), "
        "2.5 mm, 1 Hz, 0 A.",
        (1, 4, 7.0, 2.1),
        *("Velocity [mm/s]", "Force [N]"),
        sharex=True,
        sharey=True,
    )
    for a, name in zip(axes[0], ("f0", "k5", "k1e", "k1c"), strict=True):
        _draw_changed(a, name, _DRAWN)
    axes[0, 0].legend(loc="upper left", fontsize=6.5, handlelength=1.8)
    return picture


def _changes_figure(strongest: list[str]) -> Picture:
    picture, axes = chart(
        "sensitivity_changes",
        "Change of the force after a change of one parameter, for all parameters with an effect at "
        "0 A (thesis Fig. 42–52), 2.5 mm, 1 Hz. The scales differ: twenty to a few newtons in the "
        "first row, below one newton in the last panels.",
        (2, 5, 7.4, 3.6),
        *("Velocity [mm/s]", "Change of force [N]"),
        sharex=True,
    )
    for a, name in zip(axes.ravel(), strongest, strict=True):
        _draw_changed(a, name, _DRAWN[1:], _loop_after(name, 0.0).force)
        a.locator_params(axis="y", nbins=4)
    legend_above(axes[0, 0], 2)
    return picture


def _draw_changed(axis: Any, name: str, changes: Sequence[float], less: Any = 0.0) -> None:
    """Draw the loops after changes of a parameter, minus the force ``less`` [N]."""
    axis.set_title(name)
    for change in changes:
        turn, number = _loop_after(name, change), _DRAWN.index(change)
        style = {**line(number), "color": (INK[0], INK[2], INK[1])[number]}
        axis.plot(1e3 * turn.velocity, turn.force - less, label=f"+{100 * change:.0f} %", **style)


def _loop_after(name: str, change: float) -> Loop:
    values = parameters(find(CONDITION)).copy()
    values[PARAMETER_NAMES.index(name)] *= 1.0 + change
    return loop(values, find(CONDITION))


# -- identifiability from one run and from all runs ------------------------------------------------

ONE_RUN = "5.0mm_1Hz_1.5A"


def scaled_jacobian(name: str, noise_seed: int, values: Array) -> Array:
    """Derivatives (n, 16) of the run over the noise by relative changes of the parameters."""
    misfit = cycle(name, noise_seed)
    weight = np.sqrt(misfit.weight * misfit.sample_count)[:, np.newaxis]
    return np.asarray(misfit.jacobian(values) * values * weight / THESIS_FORCE_NOISE)


def descend(seed: tuple[int, ...], noise_seed: int) -> tuple[Array, float]:
    """Task: least squares over all sixteen parameters from a random start: set, RMSE [N]."""
    misfit = cycle(ONE_RUN, noise_seed)
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


def identifiability_part(campaign: Campaign) -> Iterator[Chapter]:
    """The chapter on observability."""
    names, fits, _ = laws.identified(campaign)
    keys = [(seed,) for seed in campaign.seeds(5)]
    results = campaign.each("descents", descend, keys, noise_seed=campaign.seed)
    sets, errors = zip(*results.values(), strict=True)
    truth = parameters(find(ONE_RUN))
    single = scaled_jacobian(ONE_RUN, campaign.seed, truth)
    _, one, directions = np.linalg.svd(single, full_matrices=False)
    values = fits["sigmoid"]["parameters"]
    pooled = np.vstack([scaled_jacobian(name, campaign.seed, values) for name in names])
    singular = [one, np.asarray(np.linalg.svd(pooled, compute_uv=False))]
    determined = [int(np.sum(each > 1e-6 * each[0])) for each in singular]

    floor = min(errors)
    good = np.array(sets)[np.array(errors) < 1.02 * floor]
    misfit = cycle(ONE_RUN, campaign.seed)
    seven = coefficients(good, misfit.peak_velocity, misfit.current)
    sizes = np.maximum(np.abs(np.mean(seven, axis=0)), 1e-12)
    yield chapter(
        "observability",
        "Beyond the thesis: the reason for the scatter of the parameters",
        f"one run determines {determined[0]} of sixteen directions, all runs together "
        f"{determined[1]}.",
        "A run at one peak velocity and one current depends on only seven coefficients of the law. "
        "The sixteen parameters act through these coefficients, so the loop does not change along "
        "nine directions in parameter space. For this reason the sets in the thesis scatter "
        "although every loop fits; the optimiser is not the cause.",
        _singular_figure(singular),
        _direction_figure(directions),
        _walk_figure(campaign.seed, truth, directions),
        Table(
            "scatter",
            f"{len(good)} of {len(sets)} least-squares searches from random starts on the run of 5 "
            f"mm, 1 Hz, 1.5 A ended at the noise ({floor:.2f} N). The table gives the range of "
            "each parameter over these equally good sets, and its standard deviation relative to "
            "the width of the search bounds.",
            "Parameter | Smallest | Largest | Spread [1]",
            _spreads(PARAMETER_NAMES, good, facts.SEARCH_HIGH - facts.SEARCH_LOW),
        ),
        Table(
            "scatter_coefficients",
            "The seven coefficients of the same sets (SI units), and their standard deviation "
            "relative to their mean: all sets agree to the digits shown.",
            "Coefficient | Smallest | Largest | Spread [1]",
            _spreads(COEFFICIENT_NAMES, seven, sizes),
        ),
        _scatter_figure(good),
    )


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
        style = {**line(number, marked=True), "linestyle": ""}
        a.semilogy(x, np.maximum(singular[number], 1e-13), label=label, **style)
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
    steps, misfit = np.linspace(-0.5, 0.5, 41), cycle(ONE_RUN, noise_seed)
    for number, direction in enumerate((1, 4, 7, 12)):
        walked = truth * (1.0 + np.outer(steps, directions[direction - 1]))
        style = {**line(number, marked=True), "linestyle": "-", "markevery": 5}
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
