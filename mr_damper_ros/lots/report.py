"""Table and report of many dampers: CSV, Parquet, and one HTML page with its figures inside."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from mr_damper_ros.lots.many_dampers import ManyDampers
from mr_damper_ros.lots.population import LEAST_DAMPERS, Population
from mr_damper_ros.processes.files import write_text
from mr_damper_ros.report.document import (
    GREY,
    INK,
    WIDTH,
    Block,
    Chapter,
    Picture,
    Table,
    Text,
    panels,
    styled,
    with_error,
    write_report,
)

Row = Mapping[str, Any]

_MOST_SHOWN = 100
"""Largest number of rows of a table on the page; the files contain all rows."""


def write_csv(rows: Sequence[Row], path: Path) -> None:
    """Write the table as CSV with full precision; unknown values are empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]) if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def require_parquet() -> None:
    """Raise ValueError if no Parquet file can be written."""
    if find_spec("pyarrow") is None:
        raise ValueError("a Parquet file needs pyarrow: install it, or use the CSV file")


def write_parquet(rows: Sequence[Row], path: Path) -> None:
    """Write the table as Parquet. Raises ValueError if pyarrow is not installed."""
    require_parquet()
    from pyarrow import Table as ArrowTable
    from pyarrow import parquet

    fresh = path.with_name(f".{path.name}.new")
    try:
        parquet.write_table(ArrowTable.from_pylist(list(rows)), fresh)
        fresh.replace(path)
    finally:
        fresh.unlink(missing_ok=True)


def write_population_report(found: ManyDampers, folder: Path) -> Path:
    """Write ``population.html`` with its figures and tables; returns the path of the page."""
    population = found.population
    with styled():
        chapters = [
            Chapter("forces", "The force over the lot", _forces(population)),
            Chapter("outliers", "Dampers that stand out", _outliers(population)),
            Chapter("fits", "How well the law fits", _fits(population)),
            Chapter("parameters", "The parameters that were determined", _parameters(population)),
            Chapter("missing", "Unusable files and dampers", _missing(found)),
        ]
        headlines = [
            _force_headline(population),
            _outlier_headline(population),
            _fit_headline(population),
            "undetermined parameters are not shown, because they say nothing about a damper",
            _missing_headline(found),
        ]
        count = len(found.documents)
        notice = (
            f"{len(population.dampers)} of {count} dampers were identified, each from all "
            "recordings of its own. Forces are compared, not parameters. Spreads are those of most "
            "dampers: standard deviations from the median absolute deviation."
        )
        return write_report(
            folder, "A lot of dampers", notice, headlines, chapters, page="population.html"
        )


def _forces(population: Population) -> list[Block]:
    rows = []
    for spread in population.forces:
        if not spread.known.size:
            continue
        names = [damper.name for damper in population.dampers]
        least, most = np.nanargmin(spread.values), np.nanargmax(spread.values)
        typical = float(np.nanmedian(spread.errors))
        rows.append(
            (
                spread.label.removeprefix("force at "),
                spread.known.size,
                spread.median,
                spread.deviation,
                f"{spread.deviation / spread.median:.1%}" if spread.median else "–",
                typical,
                f"{spread.values[least]:.4g} ({names[least]})",
                f"{spread.values[most]:.4g} ({names[most]})",
            )
        )
    if not rows:
        return [Text("There is no damper whose force is known.")]
    table = Table(
        "forces",
        "Largest force of a cycle in extension [N], of the dampers that were identified at this "
        "peak velocity and current. Own error: the median standard error of a single damper.",
        ("at", "dampers", "median", "spread", "relative", "own error", "least", "most"),
        rows,
    )
    return [_spread_figure(population), table]


def _spread_figure(population: Population) -> Picture:
    spreads = [spread for spread in population.forces if spread.known.size]
    figure, axes = panels(1, 1, WIDTH, 0.9 + 0.42 * len(spreads))
    axis = axes[0, 0]
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
    axis.set_xlabel("force against the median of the lot [%]")
    return Picture(
        "forces",
        "Every damper at every operating point: dots, those that stand out as crosses. The height "
        "within a row has no meaning.",
        figure,
    )


def _force_headline(population: Population) -> str:
    parts = [s.deviation / s.median for s in population.forces if s.known.size > 1 and s.median]
    if not parts:
        return "there are not enough dampers to tell a spread"
    return f"it differs from damper to damper by {min(parts):.1%} to {max(parts):.1%}"


def _outliers(population: Population) -> list[Block]:
    if len(population.dampers) < LEAST_DAMPERS:
        return [Text(f"In lots of fewer than {LEAST_DAMPERS} dampers, no outliers are flagged.")]
    rule = Text(
        f"A damper stands out that is more than {population.limit:.1f} standard deviations of the "
        "lot from its median, and more than three of its own standard errors. In a lot without "
        "outliers, chance alone would name one in two lots."
    )
    rows = [
        (o.damper, o.quantity, o.value, o.median, f"{o.score:+.1f}")
        for o in population.outliers[:_MOST_SHOWN]
    ]
    if not rows:
        return [rule, Text("None does.")]
    columns = ("damper", "in", "its value", "median of the lot", "standard deviations off")
    return [rule, Table("outliers", "Each with its largest deviation.", columns, rows)]


def _outlier_headline(population: Population) -> str:
    names = [outlier.damper for outlier in population.outliers]
    if not names:
        return "none"
    shown = ", ".join(names[:5])
    return shown if len(names) <= 5 else f"{shown} and {len(names) - 5} more"


def _fits(population: Population) -> list[Block]:
    if not population.dampers:
        return [Text("No damper was identified.")]
    nrmse = 100.0 * np.array([damper.nrmse for damper in population.dampers])
    figure, axes = panels(1, 1, WIDTH, 2.4)
    axes[0, 0].hist(nrmse, bins=min(40, max(5, nrmse.size // 5)), color=GREY)
    axes[0, 0].set_xlabel("NRMSE [%]")
    axes[0, 0].set_ylabel("dampers")
    order = np.argsort(-nrmse)[:10]
    rows = [(population.dampers[k].name, float(nrmse[k])) for k in order]
    return [
        Picture("nrmse", "NRMSE of the sets.", figure),
        Table("worst-fits", "The ten poorest fits.", ("damper", "NRMSE [%]"), rows),
    ]


def _fit_headline(population: Population) -> str:
    if not population.dampers:
        return "no damper was identified"
    nrmse = [damper.nrmse for damper in population.dampers]
    return f"median NRMSE {np.median(nrmse):.1%}, the poorest {max(nrmse):.1%}"


def _parameters(population: Population) -> list[Block]:
    if not population.dampers:
        return [Text("No damper was identified.")]
    law = population.dampers[0].parameter_set.law
    rows = []
    for place, parameter in enumerate(law.parameters):
        sets = [damper.parameter_set for damper in population.dampers]
        seen = [s for s in sets if s.observable[place]]
        if not seen:
            continue
        values = np.array([s.values[place] for s in seen])
        errors = np.array([s.standard_errors[place] for s in seen])
        middle, error = float(np.median(values)), float(np.nanmedian(errors))
        low, high = np.quantile(values, (0.05, 0.95))
        rows.append(
            (
                parameter.name,
                parameter.unit,
                len(seen),
                with_error(middle, error) if error > 0.0 else middle,
                float(low),
                float(high),
            )
        )
    columns = ("parameter", "unit", "dampers", "median ± own error", "5 %", "95 %")
    return [Table("parameters", "Over the dampers whose data determined it.", columns, rows)]


def _missing(found: ManyDampers) -> list[Block]:
    blocks: list[Block] = []
    failures = list(found.failures.items())[:_MOST_SHOWN]
    files = [(str(entry.path), entry.reason) for entry in found.left_out][:_MOST_SHOWN]
    if failures:
        blocks.append(
            Table("failures", "Dampers that were not identified.", ("damper", "why"), failures)
        )
    if files:
        blocks.append(Table("left-out", "Files that were left out.", ("file", "why"), files))
    return blocks or [Text("Everything was used.")]


def _missing_headline(found: ManyDampers) -> str:
    files, failures = len(found.left_out), len(found.failures)
    if not files and not failures:
        return "everything was used"
    return f"{files} files were left out, and {failures} dampers were not identified"
