"""Figures of measured and predicted force; they can be read without colour."""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mr_damper_ros.interface.comparison import Comparison
from mr_damper_ros.processes.whole_files import write_bytes
from mr_damper_ros.signals.arrays import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = ("png", "svg", "pdf")

_LEGEND = 0.06
"""Part of the height that the legend takes."""

_WIDTH, _HEIGHT = 7.2, 7.6
_MEASURED = {"color": "0.65", "linestyle": "none", "marker": ".", "markersize": 3.0}
_PREDICTED = {"color": "#8f1023", "linewidth": 1.2}
"""Light dots and a dark line: they differ in grey and in form too."""

_LINE = 92
"""Characters that fit into the width of the figure."""

_BINS = 40


def comparison_figure(comparison: Comparison, title: str = "") -> Figure:
    """Figure of a comparison: both loops, force and residual over time, the residual's histogram.

    ``title``: what the prediction is, where that needs saying; name, NRMSE and provenance of the
    run are told in any case.
    """
    from matplotlib import rc_context, rcdefaults

    with rc_context():
        # The user's settings must not make the figure unreadable.
        rcdefaults()
        return _drawn(comparison, title)


def save_figures(
    comparisons: Iterable[Comparison], folder: Path, formats: Sequence[str], title: str = ""
) -> list[Path]:
    """Draw each comparison into files of its name; returns their paths. Raises OSError."""
    written: list[Path] = []
    for comparison in comparisons:
        figure = comparison_figure(comparison, title)
        stem = _file_name(comparison.name, {path.stem for path in written})
        for kind in formats:
            written.append(folder / f"{stem}.{kind}")
            content = io.BytesIO()
            figure.savefig(content, format=kind, dpi=150)
            write_bytes(written[-1], content.getvalue())
    return written


def _file_name(name: str, taken: set[str]) -> str:
    """A plain file name from the name of a run, which may be a path."""
    stem = re.sub(r"[^\w.+-]+", "_", Path(name).name.removesuffix(".mcap")).strip("._") or "run"
    free, number = stem, 1
    while free in taken:
        number += 1
        free = f"{stem}_{number}"
    return free


def _drawn(comparison: Comparison, title: str) -> Figure:
    # Drawing without a screen must not depend on the user's back end.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    class ShownFigure(Figure):  # type: ignore[misc]
        """A figure that a notebook shows."""

        def _repr_png_(self) -> bytes:
            from io import BytesIO

            content = BytesIO()
            self.savefig(content, format="png", dpi=100)
            return content.getvalue()

    from matplotlib.layout_engine import ConstrainedLayoutEngine

    # Room for the legend: loc="outside …" is not known to the Matplotlib of Ubuntu 24.04.
    layout = ConstrainedLayoutEngine(rect=(0.0, _LEGEND, 1.0, 1.0 - _LEGEND))
    figure = ShownFigure(figsize=(_WIDTH, _HEIGHT), layout=layout)
    FigureCanvasAgg(figure)
    axes: dict[str, Any] = figure.subplot_mosaic(
        [["velocity"] * 2 + ["displacement"] * 2, ["force"] * 4, ["residual"] * 3 + ["histogram"]],
        height_ratios=[1.25, 1.0, 0.7],
    )
    c = comparison
    gaps = np.flatnonzero(np.diff(c.time) > 1.5 * float(np.median(np.diff(c.time)))) + 1
    _pair(axes["velocity"], c.velocity, c, gaps)
    _pair(axes["displacement"], 1e3 * c.displacement, c, gaps)
    _pair(axes["force"], c.time, c, gaps)
    axes["residual"].plot(*_broken(gaps, c.time, c.residual), color="0.25", linewidth=0.6)
    axes["residual"].axhline(0.0, color="0.6", linewidth=0.6)
    axes["histogram"].hist(c.residual, _BINS, orientation="horizontal", color="0.55")
    axes["histogram"].sharey(axes["residual"])
    axes["histogram"].tick_params(labelleft=False)
    labels = {
        "velocity": ("Velocity [m/s]", "Force [N]"),
        "displacement": ("Displacement [mm]", "Force [N]"),
        "force": ("Time [s]", "Force [N]"),
        "residual": ("Time [s]", "Residual [N]"),
        "histogram": ("Samples", ""),
    }
    for name, (below, beside) in labels.items():
        axes[name].set_xlabel(below)
        axes[name].set_ylabel(beside)
        axes[name].grid(color="0.9", linewidth=0.6)
        axes[name].set_axisbelow(True)
        axes[name].spines[["top", "right"]].set_visible(False)
    figure.suptitle(_title(comparison, title), fontsize="medium")
    handles, names = axes["velocity"].get_legend_handles_labels()
    figure.legend(handles, names, loc="lower center", ncols=2, frameon=False, markerscale=2.5)
    return figure


def _pair(axes: Any, x: Array, comparison: Comparison, gaps: NDArray[np.intp]) -> None:
    axes.plot(x, comparison.measured, label="measured", rasterized=True, **_MEASURED)
    axes.plot(*_broken(gaps, x, comparison.predicted), label="predicted", **_PREDICTED)


def _broken(gaps: NDArray[np.intp], *arrays: Array) -> tuple[Array, ...]:
    """The arrays with a break in the line where samples are missing."""
    return tuple(np.insert(array, gaps, np.nan) for array in arrays)


def _title(comparison: Comparison, title: str) -> str:
    error = comparison.error
    lines = [Path(comparison.name).name, f"NRMSE {error.nrmse:.2%}, RMSE {error.rmse:.3g} N"]
    if title:
        lines.insert(1, title)
    lines += textwrap.wrap(comparison.provenance, _LINE)
    return "\n".join(lines)
