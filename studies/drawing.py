"""Tables and figures of the studies."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from mr_damper_ros.report.document import DASHES, INK, MARKS, Block, Chapter


def chapter(name: str, title: str, headline: str, *blocks: Block) -> Chapter:
    """A chapter of a report."""
    return Chapter(name, title, headline, blocks)


def line(number: int, *, marked: bool = False) -> dict[str, Any]:
    """Style of the line with a given number; ``marked`` adds a symbol at each point."""
    style = {"linestyle": DASHES[number], "color": INK[number]}
    return {**style, "marker": MARKS[number]} if marked else style


def draw_rows(axes: Any, time: Any, rows: Iterable[Any], label: str, **style: Any) -> None:
    """Draw each of the ``rows`` over the time in a separate panel, one below the other."""
    for axis, row in zip(axes[:, 0], rows, strict=False):
        axis.plot(time, row, label=label, **style)


def name_rows(axes: Any, *labels: str, time: str = "time (s)") -> None:
    """Label panels that lie one below the other."""
    for axis, label in zip(axes[:, 0], labels, strict=True):
        axis.set(ylabel=label)
    axes[-1, 0].set(xlabel=time)


def bars(axis: Any, series: Mapping[str, Any], colours: Sequence[str] = INK) -> None:
    """Bars of several series side by side, in groups at 0, 1, 2 ..."""
    width = 0.8 / len(series)
    for place, (label, values) in enumerate(series.items()):
        offsets = np.arange(len(values)) + (place - 0.5 * (len(series) - 1)) * width
        axis.bar(offsets, values, width, color=colours[place], label=label)
