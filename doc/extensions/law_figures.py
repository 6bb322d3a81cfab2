"""What each coefficient and each parameter of the sigmoid law does, drawn from the law itself."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from mr_damper_ros.models.sigmoid.law import (
    COEFFICIENT_NAMES,
    PARAMETER_NAMES,
    Coefficients,
    force_from_coefficients,
    operating_point_coefficients,
)

WIDTH = 5.0
"""Inches; narrow, so that the words can be read on a telephone."""

BASE = dict(zip(COEFFICIENT_NAMES, (1000.0, 200.0, 6.0, 6.0, -0.008, 0.0, 0.0), strict=True))
"""Coefficients of a damper in a press: 5 mm, 1 Hz, a current near its largest."""

VARIED = {
    "f_t": (600.0, 1000.0, 1400.0),
    "alpha": (80.0, 200.0, 500.0),
    "k_c": (0.0, 6.0, 12.0),
    "k_e": (0.0, 6.0, 12.0),
    "v_h": (0.0, -0.008, -0.014),
    "v_d": (-0.004, 0.0, 0.004),
    "f_d": (-200.0, 0.0, 200.0),
}

SHOWN = {
    "f_t": "f_t [N]\nyield force",
    "alpha": "α [s/m]\nsteepness",
    "k_c": "k_c [s/m]\nslope, extension",
    "k_e": "k_e [s/m]\nslope, compression",
    "v_h": "v_h [m/s]\nhysteresis velocity",
    "v_d": "v_d [m/s]\nvelocity offset",
    "f_d": "f_d [N]\nforce offset",
}

PARAMETERS = dict(
    zip(
        PARAMETER_NAMES,
        (
            *(40.0, -0.35, -0.25, 900.0, 2.5, 4.0, 3.0, 2.0),
            *(9.0, 4.0, 6.0, 18.0, -0.45, -0.11, 0.06, 0.012),
        ),
        strict=True,
    )
)
"""A damper whose laws all show between 0.01 and 0.25 m/s and 0 and 1.5 A; no real one."""

SHAPES = {
    "a1": ("f_t", (0.0, 2.5, 5.0)),
    "k0": ("alpha", (0.0, 9.0, 40.0)),
    "a4": ("k_c", (0.0, 2.0, 6.0)),
    "k2": ("f_t", (9.0, 18.0, 27.0)),
    "a2": ("f_t", (2.0, 4.0, 8.0)),
    "I0": ("f_t", (-0.7, -0.35, 0.0)),
    "k3": ("v_h", (-0.9, -0.45, 0.5)),
    "a3": ("v_h", (1.5, 3.0, 9.0)),
    "I1": ("v_h", (-0.6, -0.25, 0.1)),
}
"""The coefficient that each shape parameter bends, and three values of it."""

OVER_VELOCITY = ("a1", "k0", "a4")

_LINES = (("0.6", "--"), ("0.0", "-"), ("#8f1023", ":"))
"""They differ in form and in grey."""


def coefficient_figure(path: Path) -> None:
    """The loop of a steady sine with each of the seven coefficients smaller and larger."""
    phase = np.linspace(0.0, 2.0 * math.pi, 400)
    speed = 0.0314
    velocity, acceleration = speed * np.cos(phase), -np.sin(phase)
    figure, panels = _panels(4, 8.6)
    for panel, (name, values) in zip(panels, VARIED.items(), strict=False):
        for value, (color, dash) in zip(values, _LINES, strict=True):
            coefficients = Coefficients(**{**BASE, name: np.array(value)})
            force = force_from_coefficients(coefficients, velocity, acceleration)
            panel.plot(velocity, force / 1e3, dash, color=color, label=f"{value:g}")
        _finish(panel, SHOWN[name], "Velocity [m/s]", "Force [kN]")
    panels[-1].set_axis_off()
    figure.savefig(path, metadata={"Date": None})


def shape_figure(path: Path) -> None:
    """How the nine shape parameters bend the coefficients over peak velocity and current."""
    speeds, currents = np.linspace(0.0, 0.25, 200), np.linspace(0.0, 1.5, 200)
    figure, panels = _panels(5, 10.6)
    for panel, (name, (coefficient, values)) in zip(panels, SHAPES.items(), strict=False):
        over_velocity = name in OVER_VELOCITY
        for value, (color, dash) in zip(values, _LINES, strict=True):
            parameters = np.array(list({**PARAMETERS, name: value}.values()))
            point = (speeds, 1.0) if over_velocity else (0.1, currents)
            y = getattr(operating_point_coefficients(parameters, *point), coefficient)
            x = speeds if over_velocity else currents
            panel.plot(x, np.broadcast_to(y, x.shape), dash, color=color, label=f"{value:g}")
        below = "Peak velocity [m/s]" if over_velocity else "Current [A], at 0.1 m/s"
        _finish(panel, name, below, SHOWN[coefficient].split("\n")[0])
    panels[-1].set_axis_off()
    figure.savefig(path, metadata={"Date": None})


def _panels(rows: int, height: float) -> tuple[Any, Any]:
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    matplotlib.rcdefaults()
    # The same figure in every build.
    matplotlib.rcParams.update({"font.size": 9.0, "svg.hashsalt": "mr_damper_ros"})
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    FigureCanvasSVG(figure)
    return figure, figure.subplots(rows, 2).ravel()


def _finish(panel: Any, title: str, below: str, beside: str) -> None:
    panel.set_title(title, fontsize="medium", pad=18.0)
    panel.set_xlabel(below)
    panel.set_ylabel(beside)
    panel.grid(color="0.9", linewidth=0.6)
    panel.spines[["top", "right"]].set_visible(False)
    panel.legend(
        frameon=False,
        fontsize="small",
        ncols=3,
        handlelength=1.5,
        columnspacing=0.8,
        handletextpad=0.3,
        borderaxespad=0.0,
        loc="lower center",
        bbox_to_anchor=(0.5, 1.0),
    )
