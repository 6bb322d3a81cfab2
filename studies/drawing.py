"""Shared drawing and tables of the studies: line styles, labels of panels, heads of tables."""

from __future__ import annotations

from typing import Any

from mr_damper_ros.report.document import DASHES, INK, MARKS


def line(number: int, *, marked: bool = False) -> dict[str, Any]:
    """Style of the line with a given number; ``marked`` adds a symbol at each point."""
    style = {"linestyle": DASHES[number], "color": INK[number]}
    return {**style, "marker": MARKS[number]} if marked else style


def name_axes(axes: Any, across: str, up: str) -> None:
    """Label the quantities of panels (r, c) below the last row and left of the first column."""
    for axis in axes[-1]:
        axis.set_xlabel(across)
    for axis in axes[:, 0]:
        axis.set_ylabel(up)


def heads(text: str) -> tuple[str, ...]:
    """Headers of the columns of a table, between bars."""
    return tuple(head.strip() for head in text.split("|"))
