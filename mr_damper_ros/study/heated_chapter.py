"""Chapter of the report on a damper that heats."""

from __future__ import annotations

from collections.abc import Mapping

from mr_damper_ros.interface.figure_style import DASHES, INK, legend_above, panels
from mr_damper_ros.interface.report_page import Chapter, Picture, Table, Text
from mr_damper_ros.study.heated_drive import STRETCH, HeatedDrive, HeatedResult

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
        axes[2, 0].plot(result.time, result.comfort, **style)
    axes[0, 0].set(ylabel="temperature (°C)")
    axes[1, 0].set(ylabel="force missed (%)", ylim=(0.0, None))
    axes[2, 0].set(ylabel="acceleration (m/s²)", xlabel="time (s)", ylim=(0.0, None))
    legend_above(figure, axes[0, 0], 2)
    rows = [
        (
            _NAMES[learns],
            float(result.celsius[-1]),
            100.0 * result.nrmse(*_BEGINNING),
            100.0 * result.nrmse(result.time[-1] - _END, result.time[-1]),
            growth(result),
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
                f"Road {task.road}, {task.strategy}, a coil that lags by 10 ms. The damper takes "
                "what it damps as heat and loses 26 % of its force on the way to 71 °C, above "
                "which it stays as it is. The identifier follows it by windows of the measured "
                "motion, force and current, and the controller takes each set that is accepted."
            ),
            Picture(
                "heated",
                f"Temperature, miss of the wanted force where it could be had, and acceleration "
                f"of the body, each over {STRETCH:g} s.",
                figure,
            ),
            Table(
                "heated",
                "Miss of the force: RMSE over the RMS of the wanted force, where it could be had, "
                f"in {_BEGINNING[0]:g} to {_BEGINNING[1]:g} s and in the last {_END:g} s.",
                (
                    "set",
                    "hottest (°C)",
                    "missed, first (%)",
                    "missed, last (%)",
                    "last/first",
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
