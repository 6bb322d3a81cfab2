"""Figures of force loops: measured and predicted."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mr_damper_ros.signals.arrays import Array

_WIDTH, _HEIGHT = 6.4, 4.4
_MEASURED = "0.62"
_PREDICTED = "#b2182b"


def loop_figures(
    folder: Path,
    displacement: Array,
    velocity: Array,
    measured: Array,
    predicted: Array,
    title: str,
) -> list[Path]:
    """Draw force over velocity and force over displacement; returns the PNG files written.

    Arrays of shape (n,): displacement [m], velocity [m/s], measured and predicted force [N].
    """
    folder.mkdir(parents=True, exist_ok=True)
    return [
        _loop(
            folder / "force_velocity.png", velocity, "Velocity [m/s]", measured, predicted, title
        ),
        _loop(
            folder / "force_displacement.png",
            1e3 * np.asarray(displacement),
            "Displacement [mm]",
            measured,
            predicted,
            title,
        ),
    ]


def _loop(path: Path, x: Array, label: str, measured: Array, predicted: Array, title: str) -> Path:
    # Drawing without a screen must not depend on the user's settings.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_WIDTH, _HEIGHT), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.plot(x, measured, ".", markersize=3, color=_MEASURED, label="measured")
    axes.plot(x, predicted, "-", linewidth=1.4, color=_PREDICTED, label="predicted")
    axes.set_xlabel(label)
    axes.set_ylabel("Force [N]")
    axes.set_title(title, fontsize="medium")
    axes.grid(color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.legend(frameon=False, loc="upper left")
    figure.savefig(path, dpi=150)
    return path
