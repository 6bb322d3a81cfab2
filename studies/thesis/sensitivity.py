"""Sensitivity of the force to every parameter (thesis 4.8, figures 42-52, tables 13 and 14).

The thesis does not define its "error of the force". The sum of the squared change over the 7001
samples, for a change of 20 %, reproduces its numbers, so this definition is used.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mr_damper_ros.models.published import find, parameters
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES, sine_force
from mr_damper_ros.report.document import DASHES, INK, Chapter, Picture, legend_above
from studies.drawing import chart, line, table
from studies.program import Campaign, Part
from studies.thesis import facts
from studies.thesis.compared import comparison, percent
from studies.thesis.runs import Loop, loop, window

CONDITION = "2.5mm_1Hz_0.0A"
WITH_CURRENT = "2.5mm_1Hz_1.0A"
CHANGES = (0.01, 0.05, 0.10, 0.15, 0.20)
_DRAWN = (0.0, 0.10, 0.20)


def squared_change(condition: str, seed: int) -> dict[str, list[float]]:
    """Sum of the squared change of the force [N²] by parameter, one for each of ``CHANGES``."""
    values = parameters(find(condition))
    m = window(condition, seed).motion
    sets = np.repeat(values[np.newaxis], 1 + len(CHANGES) * len(PARAMETER_NAMES), axis=0)
    for place in range(len(PARAMETER_NAMES)):
        for step, change in enumerate(CHANGES):
            sets[1 + place * len(CHANGES) + step, place] *= 1.0 + change
    forces = sine_force(sets, m.displacement, m.velocity, m.acceleration, find(condition).current)
    sums = np.sum((forces[1:] - forces[0]) ** 2, axis=1)
    return dict(zip(PARAMETER_NAMES, sums.reshape(-1, len(CHANGES)).tolist(), strict=True))


def sensitivity_part(campaign: Campaign) -> Part:
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
    chapter = Chapter(
        "sensitivity",
        "Sensitivity of the force",
        f"the force depends most on {', '.join(order[:4])}, as in the thesis; our sums differ by "
        f"up to {percent(apart[worst])} ({worst}) from tables 13 and 14, whose values were read "
        "off figures.",
        [
            "In the Nelder–Mead set of 2.5 mm, 1 Hz, 0 A, one parameter is changed at a time. The "
            "numbers in the thesis were read off its figures and rounded up; “CTE” (constant) in "
            "its tables is 0 here. At 0 A the two current terms cancel exactly, so I0, I1, a2, a3, "
            "k2 and k3 have no effect and cannot be identified. With current they have an effect, "
            "as the last column of the second table shows.",
            comparison(
                "sensitivity",
                "Sum of the squared change of the force over 7001 samples for a change of +20 %.",
                values,
            ),
            table(
                "sensitivity_steps",
                "Sum of the squared change of the force for all changes, in N²; the last column is "
                "for 2.5 mm, 1 Hz, 1.0 A.",
                f"Parameter | {' | '.join(f'+{100 * c:.0f} %' for c in CHANGES)} | +20 %, 1.0 A",
                [(name, *passive[name], active[name][-1]) for name in order],
            ),
            _sums_figure(passive, strongest),
            _loops_figure(),
            _changes_figure(strongest),
        ],
    )
    return Part([chapter])


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


def _loops_figure() -> Picture:
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
        for number, change in enumerate(_DRAWN):
            turn = _changed(name, change)
            a.plot(1e3 * turn.velocity, turn.force, **_line(number))
        a.set_title(name)
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
        for number, change in enumerate(_DRAWN[1:], start=1):
            turn = _changed(name, change)
            a.plot(1e3 * turn.velocity, turn.force - _changed(name, 0.0).force, **_line(number))
        a.set_title(name)
        a.locator_params(axis="y", nbins=4)
    legend_above(axes[0, 0], 2)
    return picture


def _line(number: int) -> dict[str, Any]:
    colour, label = (INK[0], INK[2], INK[1])[number], f"+{100 * _DRAWN[number]:.0f} %"
    return {"ls": DASHES[number], "color": colour, "label": label}


def _changed(name: str, change: float) -> Loop:
    values = parameters(find(CONDITION)).copy()
    values[PARAMETER_NAMES.index(name)] *= 1.0 + change
    return loop(values, find(CONDITION))
