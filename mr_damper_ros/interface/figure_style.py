"""One style for all figures: readable in greyscale, no decoration."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

INK = ("#000000", "#b2182b", "#3f8fc4", "#8a8a8a", "#6a3d9a", "#1b7837", "#e08214", "#c6a6d9")
"""Line colours; they differ in lightness too, and go with :data:`DASHES` and :data:`MARKS`."""

DASHES: tuple[Any, ...] = ("-", "--", (0, (1, 1)), "-.", (0, (6, 1, 1, 1, 1, 1)), (0, (3, 1)))
MARKS = ("o", "s", "^", "D", "v", "P", "X", "*")
GREY = "0.62"

_SETTINGS = {
    "font.size": 8.5,
    "axes.titlesize": 8.5,
    "axes.labelsize": 8.5,
    "legend.fontsize": 7.5,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.1,
    "lines.markersize": 3.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.frameon": False,
    "svg.hashsalt": "mr_damper_ros",
    "axes.unicode_minus": True,
    "savefig.facecolor": "white",
}


@contextmanager
def styled() -> Iterator[None]:
    """Matplotlib with this style, whatever the user's settings are."""
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_SETTINGS)
        yield


def panels(rows: int, columns: int, width: float, height: float, **options: Any) -> tuple[Any, Any]:
    """A figure of ``width`` by ``height`` inches and its axes, shape (rows, columns)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def legend_above(figure: Any, axes: Any, columns: int) -> None:
    """One legend for all panels, above them; the entries are those of ``axes``."""
    handles, labels = axes.get_legend_handles_labels()
    figure.get_layout_engine().set(rect=(0.0, 0.0, 1.0, 1.0 - 0.25 / figure.get_figheight()))
    figure.legend(handles, labels, loc="upper center", ncols=columns)
