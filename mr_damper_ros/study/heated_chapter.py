"""Chapter of the report on a damper that heats."""

from __future__ import annotations

from collections.abc import Mapping

from mr_damper_ros.report.document import (
    DASHES,
    INK,
    Chapter,
    Picture,
    Table,
    Text,
    legend_above,
    panels,
)
from mr_damper_ros.study.heated_drive import DAMPING, STRETCH, HeatedDrive, HeatedResult

FIXED, NEWEST = "set of 28 °C", "identified on line"
_NAMES = {False: FIXED, True: NEWEST}

_BEGINNING = (5.0, 20.0)
"""Seconds that the end is compared with: the controller knows the motion, the damper is cool."""

_END = 15.0


def heated_chapter(found: Mapping[bool, HeatedResult], task: HeatedDrive) -> Chapter:
    """What is lost with an old set; ``found`` by whether it is identified meanwhile."""
    figure, axes = panels(3, 1, 6.6, 4.8, sharex=True)
    for place, learns in enumerate((False, True)):
        result, style = found[learns], {"color": INK[place], "linestyle": DASHES[place]}
        axes[0, 0].plot(result.time, result.celsius, label=_NAMES[learns], **style)
        axes[1, 0].plot(result.time, 100.0 * result.missed / result.wanted, **style)
        axes[2, 0].plot(result.time, 100.0 * result.share, **style)
    axes[0, 0].set(ylabel="temperature (°C)")
    axes[1, 0].set(ylabel="force missed (%)", ylim=(0.0, None))
    axes[2, 0].set(ylabel="force that came (%)", xlabel="time (s)")
    legend_above(figure, axes[0, 0], 2)
    rows = [
        (
            _NAMES[learns],
            float(result.celsius[-1]),
            100.0 * result.nrmse(*_BEGINNING),
            100.0 * result.nrmse(result.time[-1] - _END, result.time[-1]),
            growth(result),
            100.0 * result.share_between(*_BEGINNING),
            100.0 * result.share_between(result.time[-1] - _END, result.time[-1]),
            float(result.comfort[result.time > 5.0].mean()),
            100.0 * float(result.holding[result.time > 5.0].mean()),
            result.accepted,
        )
        for learns, result in found.items()
    ]
    return Chapter(
        "heated",
        "While the damper heats from 28 °C",
        [
            Text(
                f"Road {task.road}, a coil that lags by 10 ms. The damper is to act like a viscous "
                f"one of {DAMPING:.0f} N s/m. It takes what it damps as heat and loses 26 % of its "
                "force on the way to 71 °C, above which it stays as it is. The identifier follows "
                "it by windows of the measured motion, force and current, and the controller takes "
                "each set that is accepted. Most of the miss is not the set's: the wheel moves on "
                "while the coil follows."
            ),
            Picture(
                "heated",
                "Temperature; where the wanted force could be had, by how much it was missed, "
                f"and how much of it came; each over {STRETCH:g} s.",
                figure,
            ),
            Table(
                "heated",
                "Where the wanted force could be had, in "
                f"{_BEGINNING[0]:g} to {_BEGINNING[1]:g} s and in the last {_END:g} s. Missed: "
                "RMSE over the RMS of the wanted force. Came: the part of the wanted force that "
                "the damper gave, by least squares.",
                (
                    "set",
                    "hottest (°C)",
                    "missed, first (%)",
                    "missed, last (%)",
                    "last/first",
                    "came, first (%)",
                    "came, last (%)",
                    "comfort (m/s²)",
                    "holding (%)",
                    "sets taken",
                ),
                rows,
            ),
        ],
    )


def growth(result: HeatedResult) -> float:
    """Miss of the force at the end over that at the beginning."""
    end = float(result.time[-1])
    return result.nrmse(end - _END, end) / result.nrmse(*_BEGINNING)
