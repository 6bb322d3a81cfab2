"""Table and report of many dampers: CSV, Parquet, and one HTML page that contains its figures."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from mr_damper_ros.lots.many_dampers import ManyDampers
from mr_damper_ros.lots.population import LEAST_DAMPERS, Population, Spread
from mr_damper_ros.processes.files import write_bytes, write_text
from mr_damper_ros.report.document import (
    GREY,
    INK,
    WIDTH,
    Block,
    Chapter,
    Picture,
    Table,
    chart,
    csv_text,
    styled,
    with_error,
    write_report,
)

_MOST_SHOWN = 100
"""Largest number of rows of a table on the page; the files contain all rows."""


def require_parquet() -> None:
    """Raise ValueError if no Parquet file can be written."""
    if find_spec("pyarrow") is None:
        raise ValueError(
            "a Parquet file needs pyarrow: install it (pip install pyarrow==26.0.1), or use the "
            "CSV file"
        )


def write_rows(rows: Sequence[Mapping[str, Any]], folder: Path, *, parquet: bool = False) -> None:
    """Write ``dampers.csv`` with full precision; unknown values are empty.

    With ``parquet``, also write ``dampers.parquet``, which needs pyarrow.
    """
    columns = tuple(rows[0]) if rows else ()
    text = csv_text(columns, (list(row.values()) for row in rows))
    write_text(folder / "dampers.csv", text)
    if parquet:
        from pyarrow import Table as ArrowTable
        from pyarrow.parquet import write_table

        content = io.BytesIO()
        write_table(ArrowTable.from_pylist(list(rows)), content)
        write_bytes(folder / "dampers.parquet", content.getvalue())


def write_population_report(found: ManyDampers, folder: Path) -> Path:
    """Write ``population.html`` with its figures and tables; returns the path of the page."""
    population = found.population
    with styled():
        chapters = [
            Chapter("forces", "The force over the lot", *_forces(population)),
            Chapter("outliers", "Outliers", *_outliers(population)),
            Chapter("fits", "How well the law fits", *_fits(population)),
            Chapter("parameters", "The parameters that were determined", *_parameters(population)),
            Chapter("missing", "Unusable files and dampers", *_missing(found)),
        ]
        notice = (
            f"{len(population.dampers)} of {len(found.documents)} dampers were identified, each "
            "from all its recordings. Forces are compared, not parameters. Standard deviations "
            "are computed from the median absolute deviation, so outliers do not affect them."
        )
        return write_report(folder, "A lot of dampers", notice, chapters, page="population.html")


_Part = tuple[str, list[Block]]
"""Headline and content of a chapter."""

_NO_DAMPER = "no damper was identified"


def _forces(population: Population) -> _Part:
    spreads = [spread for spread in population.forces if spread.known.size]
    if not spreads:
        return "there are too few dampers to estimate the variation", [
            "There is no damper whose force is known."
        ]
    names, rows = [damper.name for damper in population.dampers], []
    for spread in spreads:
        least, most = np.nanargmin(spread.values), np.nanargmax(spread.values)
        rows.append(
            (
                spread.label.removeprefix("force at "),
                spread.known.size,
                spread.median,
                spread.deviation,
                f"{spread.deviation / spread.median:.1%}" if spread.median else "–",
                float(np.nanmedian(spread.errors)),
                f"{spread.values[least]:.4g} ({names[least]})",
                f"{spread.values[most]:.4g} ({names[most]})",
            )
        )
    table = Table(
        "forces",
        "Largest force [N] in extension within a cycle, for the dampers that were identified at "
        "this peak velocity and current. Own error: the median standard error of a single damper.",
        "at | dampers | median | spread | relative | own error | least | most",
        rows,
    )
    shares = [s.deviation / s.median for s in spreads if s.known.size > 1 and s.median]
    headline = "there are too few dampers to estimate the variation"
    if shares:
        headline = f"it differs from damper to damper by {min(shares):.1%} to {max(shares):.1%}"
    return headline, [_spread_figure(population, spreads), table]


def _spread_figure(population: Population, spreads: Sequence[Spread]) -> Picture:
    picture, ((axis,),) = chart(
        "forces",
        "Every damper at every operating point, outliers as crosses. The height within a row has "
        "no meaning.",
        (1, 1, WIDTH, 0.9 + 0.42 * len(spreads)),
        "force against the median of the lot [%]",
    )
    rng = np.random.default_rng(0)
    named = {outlier.damper for outlier in population.outliers}
    stands_out = np.array([damper.name in named for damper in population.dampers])
    for place, spread in enumerate(reversed(spreads)):
        relative = 100.0 * (spread.values / spread.median - 1.0)
        height = place + 0.25 * rng.uniform(-1.0, 1.0, relative.size)
        axis.plot(relative[~stands_out], height[~stands_out], ".", color=GREY, markersize=3)
        axis.plot(relative[stands_out], height[stands_out], "x", color=INK[1], markersize=4)
        axis.plot([0.0, 0.0], [place - 0.3, place + 0.3], "-", color=INK[0])
    axis.set_yticks(
        range(len(spreads)), [s.label.removeprefix("force at ") for s in reversed(spreads)]
    )
    return picture


def _outliers(population: Population) -> _Part:
    found = population.outliers
    shown = ", ".join(outlier.damper for outlier in found[:5])
    headline = shown + (f" and {len(found) - 5} more" if len(found) > 5 else "") or "none"
    if len(population.dampers) < LEAST_DAMPERS:
        few = f"A lot of fewer than {LEAST_DAMPERS} dampers is too small to find outliers."
        return headline, [few]
    rule = (
        f"An outlier is more than {population.limit:.1f} standard deviations of the lot, and more "
        "than three of its own standard errors, from the median. Chance alone gives one outlier in "
        "two lots."
    )
    if not found:
        return headline, [rule, "None does."]
    rows = [(o.damper, o.quantity, o.value, o.median, f"{o.score:+.1f}") for o in found]
    columns = "damper | in | its value | median of the lot | standard deviations off"
    caption = "Each with its largest deviation."
    return headline, [rule, Table("outliers", caption, columns, rows[:_MOST_SHOWN])]


def _fits(population: Population) -> _Part:
    if not population.dampers:
        return _NO_DAMPER, [f"{_NO_DAMPER.capitalize()}."]
    nrmse = 100.0 * np.array([damper.nrmse for damper in population.dampers])
    shape = (1, 1, WIDTH, 2.4)
    picture, ((axis,),) = chart("nrmse", "NRMSE of the sets.", shape, "NRMSE [%]", "dampers")
    axis.hist(nrmse, bins=min(40, max(5, nrmse.size // 5)), color=GREY)
    order = np.argsort(-nrmse)[:10]
    rows = [(population.dampers[k].name, float(nrmse[k])) for k in order]
    return f"median NRMSE {np.median(nrmse):.1f}%, the poorest {nrmse.max():.1f}%", [
        picture,
        Table("worst-fits", "The ten poorest fits.", "damper | NRMSE [%]", rows),
    ]


def _parameters(population: Population) -> _Part:
    headline = "undetermined values are omitted, because they contain no information on a damper"
    if not population.dampers:
        return headline, [f"{_NO_DAMPER.capitalize()}."]
    rows = []
    sets = [damper.parameter_set for damper in population.dampers]
    for place, parameter in enumerate(sets[0].law.parameters):
        seen = [s for s in sets if s.observable[place]]
        if not seen:
            continue
        values = np.array([s.values[place] for s in seen])
        middle = float(np.median(values))
        # A value that is determined only jointly with others has no standard error.
        errors = [s.standard_errors[place] for s in seen if s.standard_errors[place] > 0.0]
        low, high = np.quantile(values, (0.05, 0.95)).tolist()
        told = with_error(middle, float(np.median(errors))) if errors else middle
        rows.append((parameter.name, parameter.unit, len(seen), told, low, high))
    columns = "parameter | unit | dampers | median ± own error | 5 % | 95 %"
    caption = "For each parameter, only the dampers whose data determine it."
    return headline, [Table("parameters", caption, columns, rows)]


def _missing(found: ManyDampers) -> _Part:
    failures = list(found.failures.items())
    files = [(str(entry.path), entry.reason) for entry in found.left_out]
    if not files and not failures:
        return "everything was used", ["Everything was used."]
    tables = (
        ("failures", "Dampers that were not identified.", "damper | why", failures),
        ("left-out", "Unused files.", "file | why", files),
    )
    return f"{len(files)} files were not used, and {len(failures)} dampers were not identified", [
        Table(name, caption, columns, rows[:_MOST_SHOWN])
        for name, caption, columns, rows in tables
        if rows
    ]
