"""Sensitivity of the force to every parameter (thesis 4.8, figures 42-52, tables 13 and 14).

The thesis does not define its "error of the force". The sum of the squared change over the 7001
samples, for a change of 20 %, reproduces its numbers, so this definition is used.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mr_damper_ros.models.published import find, parameters
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES, sine_force
from mr_damper_ros.report import document
from mr_damper_ros.report.document import DASHES, INK, Block, Picture, Table, Text, panels
from studies.drawing import line, name_axes
from studies.program import Campaign
from studies.thesis import facts
from studies.thesis.compared import comparison, percent
from studies.thesis.runs import Loop, loop, window

CONDITION = "2.5mm_1Hz_0.0A"
WITH_CURRENT = "2.5mm_1Hz_1.0A"
CHANGES = (0.01, 0.05, 0.10, 0.15, 0.20)


def squared_change(condition: str, seed: int) -> dict[str, list[float]]:
    """Sum of the squared change of the force [N²] by parameter, one for each of ``CHANGES``."""
    values = parameters(find(condition))
    m = window(condition, seed).motion
    sets = np.repeat(values[np.newaxis], 1 + len(CHANGES) * len(PARAMETER_NAMES), axis=0)
    for place in range(len(PARAMETER_NAMES)):
        for step, change in enumerate(CHANGES):
            sets[1 + place * len(CHANGES) + step, place] *= 1.0 + change
    forces = sine_force(sets, m.displacement, m.velocity, m.acceleration, find(condition).current)
    sums = np.sum((forces[1:] - forces[0]) ** 2, axis=1).reshape(-1, len(CHANGES))
    return {name: row.tolist() for name, row in zip(PARAMETER_NAMES, sums, strict=True)}


def compute(campaign: Campaign) -> dict[str, Any]:
    """Data of the section."""
    seed = campaign.seed
    return {name: squared_change(name, seed) for name in (CONDITION, WITH_CURRENT)}


def headline(data: dict[str, Any]) -> str:
    """The result in a sentence."""
    order = sorted(data[CONDITION], key=lambda name: -data[CONDITION][name][-1])
    apart = {
        name: data[CONDITION][name][-1] / stated - 1.0
        for name, stated in facts.SENSITIVITY.items()
        if stated > 0.0
    }
    worst = max(apart, key=lambda name: abs(apart[name]))
    return (
        f"the force depends most on {', '.join(order[:4])}, as in the thesis; our sums differ by "
        f"up to {percent(apart[worst])} ({worst}) from tables 13 and 14, whose values were read "
        "off figures."
    )


def show(data: dict[str, Any]) -> list[Block]:
    """Text, tables and figures of the section."""
    passive, active = data[CONDITION], data[WITH_CURRENT]
    values = [
        (name, "N²", passive[name][-1], facts.SENSITIVITY[name], f"Table {13 + (place > 7)}")
        for place, name in enumerate(PARAMETER_NAMES)
    ]
    values.sort(key=lambda row: -facts.SENSITIVITY[row[0]])
    full = [
        (name, *passive[name], active[name][-1])
        for name in sorted(PARAMETER_NAMES, key=lambda n: -passive[n][-1])
    ]
    return [
        Text(
            "In the Nelder–Mead set of 2.5 mm, 1 Hz, 0 A, one parameter is changed at a time. The "
            "numbers in the thesis were read off its figures and rounded up; “CTE” (constant) in "
            "its tables is 0 here. At 0 A the two current terms cancel exactly, so I0, I1, a2, a3, "
            "k2 and k3 have no effect and cannot be identified. With current they have an effect, "
            "as the last column of the second table shows."
        ),
        comparison(
            "sensitivity",
            "Sum of the squared change of the force over 7001 samples for a change of +20 %.",
            values,
        ),
        Table(
            "sensitivity_steps",
            "Sum of the squared change of the force for all changes, in N²; the last column is for "
            "2.5 mm, 1 Hz, 1.0 A.",
            ("Parameter", *(f"+{100 * c:.0f} %" for c in CHANGES), "+20 %, 1.0 A"),
            full,
        ),
        _figure(passive),
        _loops_figure(),
        _changes_figure(passive),
    ]


def _figure(passive: dict[str, list[float]]) -> Picture:
    figure, axes = panels(1, 2, 6.8, 3.0, sharey=True)
    steps = [100.0 * change for change in CHANGES]
    names = _strongest(passive)
    for place, part in enumerate((names[:5], names[5:])):
        a = axes[0, place]
        for number, name in enumerate(part):
            a.semilogy(steps, passive[name], label=name, **line(number, marked=True))
            a.plot(steps[-1:], facts.SENSITIVITY[name], "x", color=INK[number], ms=6)
        a.set_xlabel("Change of the parameter [%]")
        a.legend(loc="lower right", ncols=2)
    axes[0, 0].set_ylabel("Sum of squared change [N²]")
    return Picture(
        "sensitivity",
        "Sum of the squared change of the force (thesis Fig. 42–52 b), 2.5 mm, 1 Hz, 0 A; crosses: "
        "tables 13 and 14. I0, I1, a2, a3, k2, k3 have no effect.",
        figure,
    )


def _loops_figure() -> Picture:
    figure, axes = panels(1, 4, 7.0, 2.1, sharex=True, sharey=True)
    for a, name in zip(axes[0], ("f0", "k5", "k1e", "k1c"), strict=True):
        for number, change in enumerate(_DRAWN):
            turn = _changed(name, change)
            a.plot(1e3 * turn.velocity, turn.force, label=f"+{100 * change:.0f} %", **_line(number))
        a.set(title=name, xlabel="Velocity [mm/s]")
    axes[0, 0].set_ylabel("Force [N]")
    axes[0, 0].legend(loc="upper left", fontsize=6.5, handlelength=1.8)
    return Picture(
        "sensitivity_loops",
        "Loops with one of the four strongest parameters changed (thesis Fig. 42, 47, 48, 51 a), "
        "2.5 mm, 1 Hz, 0 A.",
        figure,
    )


def _changes_figure(passive: dict[str, list[float]]) -> Picture:
    figure, axes = panels(2, 5, 7.4, 3.6, sharex=True)
    for a, name in zip(axes.ravel(), _strongest(passive), strict=True):
        for number, change in enumerate(_DRAWN[1:], start=1):
            turn = _changed(name, change)
            moved = turn.force - _changed(name, 0.0).force
            a.plot(1e3 * turn.velocity, moved, label=f"+{100 * change:.0f} %", **_line(number))
        a.set_title(name)
        a.locator_params(axis="y", nbins=4)
    name_axes(axes, "Velocity [mm/s]", "Change of force [N]")
    document.legend_above(figure, axes[0, 0], 2)
    return Picture(
        "sensitivity_changes",
        "Change of the force after a change of one parameter, for all parameters with an effect at "
        "0 A (thesis Fig. 42–52), 2.5 mm, 1 Hz. The scales differ: twenty to a few newtons in the "
        "first row, below one newton in the last panels.",
        figure,
    )


_DRAWN = (0.0, 0.10, 0.20)


def _line(number: int) -> dict[str, Any]:
    return {"ls": DASHES[number], "color": (INK[0], INK[2], INK[1])[number]}


def _changed(name: str, change: float) -> Loop:
    condition = find(CONDITION)
    values = parameters(condition).copy()
    values[PARAMETER_NAMES.index(name)] *= 1.0 + change
    return loop(values, condition)


def _strongest(sums: dict[str, list[float]]) -> list[str]:
    """Parameters with an effect, the strongest first."""
    names = [name for name in PARAMETER_NAMES if sums[name][-1] > 0.0]
    return sorted(names, key=lambda name: -sums[name][-1])
