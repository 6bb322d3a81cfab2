"""Reports as one self-contained HTML file, with figures and tables also as separate files."""

from __future__ import annotations

import base64
import csv
import html
import io
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mr_damper_ros.processes.files import write_bytes, write_text

INK = ("#000000", "#b2182b", "#3f8fc4", "#8a8a8a", "#6a3d9a", "#1b7837", "#e08214", "#c6a6d9")
"""Line colours of different lightness, used with :data:`DASHES` and :data:`MARKS`."""

DASHES: tuple[Any, ...] = ("-", "--", (0, (1, 1)), "-.", (0, (6, 1, 1, 1, 1, 1)), (0, (3, 1)))
MARKS = ("o", "s", "^", "D", "v", "P", "X", "*")
GREY = "0.62"

WIDTH = 6.8
"""Width of a figure on a page [inch]."""


def styled() -> Any:
    """A context of Matplotlib with this style, independent of the user's settings."""
    from matplotlib import style

    return style.context(Path(__file__).parent / "report.mplstyle", after_reset=True)


def figure_of(width: float, height: float) -> Any:
    """A figure of ``width`` by ``height`` inches, drawn without a display; notebooks show it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    class NotebookFigure(Figure):  # type: ignore[misc]
        def _repr_png_(self) -> bytes:
            content = io.BytesIO()
            self.savefig(content, format="png", dpi=100)
            return content.getvalue()

    figure = NotebookFigure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def panels(rows: int, columns: int, width: float, height: float, **options: Any) -> tuple[Any, Any]:
    """A figure of ``width`` by ``height`` inches and its axes, shape (rows, columns)."""
    figure = figure_of(width, height)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def legend_above(axes: Any, columns: int) -> None:
    """One legend above all panels of the figure, with the entries of ``axes``."""
    figure = axes.figure
    handles, labels = axes.get_legend_handles_labels()
    figure.get_layout_engine().set(rect=(0.0, 0.0, 1.0, 1.0 - 0.25 / figure.get_figheight()))
    figure.legend(handles, labels, loc="upper center", ncols=columns)


Cell = str | int | float | None


@dataclass(frozen=True)
class Table:
    """A table with a file name without extension, a caption, column heads and rows.

    The heads may be given as one text, separated by bars.
    """

    name: str
    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]

    def __post_init__(self) -> None:
        if isinstance(self.columns, str):
            heads = tuple(head.strip() for head in self.columns.split("|"))
            object.__setattr__(self, "columns", heads)


@dataclass(frozen=True)
class Picture:
    """A Matplotlib figure with a file name without extension and a caption."""

    name: str
    caption: str
    figure: Any


def chart(
    name: str,
    caption: str,
    shape: tuple[int, int, float, float],
    across: str = "",
    up: str = "",
    **options: Any,
) -> tuple[Picture, Any]:
    """A figure of a ``shape``, rows, columns, width and height [inch], and its axes (r, c).

    ``across`` labels the axes of the last row, ``up`` those of the first column.
    """
    figure, axes = panels(*shape, **options)
    for axis in axes[-1]:
        axis.set_xlabel(across)
    for axis in axes[:, 0]:
        axis.set_ylabel(up)
    return Picture(name, caption, figure), axes


Block = str | Table | Picture
"""A paragraph of plain text, a table or a figure."""


_SMALL, _LARGE = 1e-3, 1e5
"""Numbers outside this range are written with a power of ten."""


def shown(value: Cell) -> str:
    """A cell as text: four significant digits, and all digits before the decimal point."""
    if value is None:
        return "–"
    if not isinstance(value, float):
        return str(value)
    if not math.isfinite(value):
        return "–"
    if value == 0.0:
        return "0"
    if not _SMALL <= abs(value) < _LARGE:
        mantissa, exponent = f"{value:.2e}".split("e")
        power = str(int(exponent)).translate(_SUPERSCRIPTS)
        return f"{mantissa}·10{power}".replace("-", "−")
    return (f"{value:.0f}" if abs(value) >= 999.95 else f"{value:#.4g}").replace("-", "−")


_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def with_error(value: float, error: float) -> str:
    """A value with its standard error, with a common power of ten if they are small or large."""
    size = max(abs(value), error)
    if _SMALL <= size < _LARGE:
        return f"{to_error(value, error)} ± {to_error(error, error)}"
    exponent = math.floor(math.log10(size))
    value, error = value * 10.0**-exponent, error * 10.0**-exponent
    power = str(exponent).translate(_SUPERSCRIPTS)
    return f"({to_error(value, error)} ± {to_error(error, error)})·10{power}"


def to_error(value: float, error: float) -> str:
    """A value rounded to the second digit of its (positive) standard error."""
    decimals = max(1 - math.floor(math.log10(error)), 0)
    return f"{value:.{decimals}f}".replace("-", "−")


def csv_text(columns: Sequence[str], rows: Iterable[Sequence[Cell]]) -> str:
    """A table as CSV with full precision."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()


def save_figure(figure: Any, path: Path, **options: Any) -> bytes:
    """Save a figure in the format of the path's ending; returns the content of the file."""
    content = io.BytesIO()
    figure.savefig(content, format=path.suffix.removeprefix("."), **{"dpi": 150} | options)
    write_bytes(path, content.getvalue())
    return content.getvalue()


def write_picture(folder: Path, picture: Picture) -> bytes:
    """Write a figure as PNG and SVG; returns the SVG."""
    save_figure(picture.figure, folder / f"{picture.name}.png")
    # No date and fixed ids: identical data give an identical file.
    date = {"Date": None}
    return save_figure(picture.figure, folder / f"{picture.name}.svg", dpi="figure", metadata=date)


@dataclass(frozen=True)
class Chapter:
    """A section: a name for links, a title, a sentence for the summary at the top, and blocks."""

    name: str
    title: str
    headline: str
    blocks: Sequence[Block]


def write_report(
    folder: Path, title: str, notice: str, chapters: Sequence[Chapter], page: str = "report.html"
) -> Path:
    """Write the page, the figures and the tables to ``folder``; returns the path of the page."""
    parts = [f"<h1>{html.escape(title)}</h1>", f'<p class="notice">{html.escape(notice)}</p>']
    links = "".join(
        f'<li><a href="#{c.name}">{html.escape(c.title)}</a>: {html.escape(c.headline)}</li>'
        for c in chapters
    )
    parts.append(f"<nav><ol>{links}</ol></nav>")
    for number, chapter in enumerate(chapters, start=1):
        parts.append(f'<section id="{chapter.name}"><h2>{number} {html.escape(chapter.title)}</h2>')
        parts += [_block(folder, block) for block in chapter.blocks]
        parts.append("</section>")
    body = "\n".join(parts)
    style = (Path(__file__).parent / "report.css").read_text(encoding="utf-8")
    place = folder / page
    write_text(
        place,
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>\n{style}</style></head>\n"
        f"<body>{body}</body></html>\n",
    )
    return place


def _block(folder: Path, block: Block) -> str:
    if isinstance(block, str):
        return f"<p>{html.escape(block)}</p>"
    if isinstance(block, Table):
        text = csv_text(block.columns, block.rows)
        write_text(folder / "tables" / f"{block.name}.csv", text)
        # In print, wide tables use a smaller font, and long tables may span pages.
        kind = _classes(table=True, wide=len(block.columns) > 12, long=len(block.rows) > 40)
        return (
            f'<div{kind}><p class="caption">{html.escape(block.caption)}</p>'
            f"{html_table(block.columns, block.rows)}</div>"
        )
    svg = base64.b64encode(write_picture(folder / "figures", block)).decode("ascii")
    caption = html.escape(block.caption)
    return (
        f'<figure><div class="picture"><img alt="{caption}" '
        f'src="data:image/svg+xml;base64,{svg}"></div>'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def html_table(columns: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    """A table in HTML; a column whose first cell is a number is aligned to the right."""
    numbers = [bool(rows) and _numeric(rows[0][place]) for place in range(len(columns))]
    head = "".join(
        f"<th{_classes(number=number)}>{html.escape(column)}</th>"
        for column, number in zip(columns, numbers, strict=True)
    )
    body = []
    for row in rows:
        cells = "".join(
            f"<td{_classes(number=number, short=len(text) < 27)}>{html.escape(text)}</td>"
            for text, number in zip(map(shown, row), numbers, strict=True)
        )
        body.append(f"<tr>{cells}</tr>")
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table>"


def text_table(columns: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    """A table for a terminal, aligned like :func:`html_table`; the last column is not padded."""
    numbers = [bool(rows) and _numeric(rows[0][place]) for place in range(len(columns))]
    lines = [list(columns), *([shown(cell) for cell in row] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(
            text.rjust(width) if number else text.ljust(width)
            for text, width, number in zip(line, widths, numbers, strict=True)
        ).rstrip()
        for line in lines
    )


Grid = tuple[Sequence[str], Sequence[Sequence[Cell]]]
"""A table of a :class:`Shown` result: its columns and rows."""


class Shown:
    """Base class of results, which are shown as text, and in a notebook as HTML."""

    def _blocks(self) -> Sequence[str | Grid]:
        """The lines and tables to show."""
        raise NotImplementedError

    def __str__(self) -> str:
        return "\n".join(
            block if isinstance(block, str) else text_table(*block) for block in self._blocks()
        )

    def _repr_html_(self) -> str:
        return "".join(
            f"<p>{html.escape(block)}</p>" if isinstance(block, str) else html_table(*block)
            for block in self._blocks()
        )


def _numeric(value: Cell) -> bool:
    if isinstance(value, str):
        return _NUMBER.match(value) is not None
    return isinstance(value, (int, float)) and not isinstance(value, bool)


_NUMBER = re.compile(r"[<>+−-]? ?\d[\d.]*(e[-+]\d+)?( ± [\d.]+)?( ?%| \*)?$")


def _classes(**chosen: bool) -> str:
    names = " ".join(name for name, on in chosen.items() if on)
    return f' class="{names}"' if names else ""
