"""``identify_many``: a parameter set of every damper that there are recordings of."""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.lots.many_dampers import ManyDampers, identify_many
from mr_damper_ros.lots.report import (
    require_parquet,
    write_csv,
    write_parquet,
    write_population_report,
)
from mr_damper_ros.models import MODELS
from mr_damper_ros.tools.console import FAILED, INTERRUPTED, StatusLine, program
from mr_damper_ros.tools.identify import add_search_options

LEFT_OUT = 3
"""Exit code where a file was left out or a damper not identified; all others are there."""

_DEFAULTS = EvolutionSettings()

_MOST_NAMED = 10
"""So many of what went wrong are named on the terminal; the report names all."""

_EPILOG = f"""\
Called again with the same folder it does only what is missing or whose files have changed, however
it ended. Below the folder: dampers.csv, population.html, sets/ (a parameter file of each damper),
dampers/ (all that is known of each).

examples:
  identify_many lots/2026-03 --output results/2026-03
  identify_many "bench/**/*.mcap" --damper "(D[0-9]+)_" --output results/bench --workers 8
  identify_many --list runs.csv --columns time:s,displacement:mm,force:N --output results/runs

Exit code: 0; {LEFT_OUT} where a file was left out or a damper not identified, with all results
written; {FAILED} where an option cannot be used; {INTERRUPTED} after Ctrl-C.
"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="identify_many",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Identify every damper of which there are recordings, each from all of its own,"
        "\nand report how far the dampers of the lot differ and which of them stand out.",
        epilog=_EPILOG,
    )
    parser.add_argument(
        "sources",
        nargs="*",
        metavar="SOURCE",
        help="folder that is searched through, bag, or pattern such as 'lot*/**/*.mcap' in quotes",
    )
    parser.add_argument(
        "--list",
        type=Path,
        metavar="FILE",
        help="CSV file with columns path, damper and, where wanted, current [A]",
    )
    parser.add_argument(
        "--output", type=Path, required=True, metavar="FOLDER", help="where the results are kept"
    )
    parser.add_argument(
        "--damper",
        metavar="PATTERN",
        help="regular expression that tells from the path below the source which damper it is of: "
        "its group 'damper', or the first one; a group 'current' tells the current [A] (default: "
        "all recordings in one folder are of one damper)",
    )
    records = parser.add_argument_group("record files (without --columns only bags are taken)")
    records.add_argument("--columns", help="what the columns hold, as for import_record")
    records.add_argument(
        "--current", type=float, metavar="A", help="where neither a column nor the name tells it"
    )
    records.add_argument("--period", type=float, metavar="S", help="time between samples [s]")
    records.add_argument("--variable", metavar="NAME", help="matrix, sheet or group")
    search = parser.add_argument_group("identification")
    add_search_options(search, tuple(MODELS))
    search.add_argument(
        "--accept-doubtful", action="store_true", help="take runs that would be refused"
    )
    parser.add_argument(
        "--workers", type=int, default=1, metavar="N", help="processes (default %(default)s)"
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="give the work to the Dask cluster of this scheduler, such as tcp://host:8786; its "
        "workers need this package and must see the same paths",
    )
    parser.add_argument(
        "--parquet", action="store_true", help="write the table as dampers.parquet too"
    )
    return parser


def _identify_many(options: argparse.Namespace) -> int:
    if not options.sources and options.list is None:
        raise ValueError("there is nothing to identify: give folders, bags, patterns, or --list")
    if options.parquet:
        require_parquet()
    with _Progress() as progress:
        found = identify_many(
            *options.sources,
            folder=options.output,
            listed=options.list,
            pattern=options.damper,
            columns=options.columns,
            current=options.current,
            period=options.period,
            variable=options.variable,
            model=options.model,
            method=options.method,
            start=options.start,
            seed=options.seed,
            generations=options.generations,
            accept_doubtful=options.accept_doubtful,
            workers=options.workers,
            scheduler=options.scheduler,
            report=progress,
        )
    rows = found.table
    write_csv(rows, options.output / "dampers.csv")
    if options.parquet:
        write_parquet(rows, options.output / "dampers.parquet")
    page = write_population_report(found, options.output)
    _tell(found, page)
    return LEFT_OUT if found.failures or found.left_out else 0


def _tell(found: ManyDampers, page: Path) -> None:
    identified = len(found.documents) - len(found.failures)
    before = f", {found.kept} of them before" if found.kept else ""
    print(f"{identified} of {len(found.documents)} dampers identified{before}")
    for outlier in found.population.outliers[:_MOST_NAMED]:
        print(f"stands out: {outlier.sentence}")
    wrong = [f"not identified: {name}: {why}" for name, why in found.failures.items()]
    wrong += [f"left out: {entry.path}: {entry.reason}" for entry in found.left_out]
    for line in wrong[:_MOST_NAMED]:
        print(line)
    if len(wrong) > _MOST_NAMED:
        print(f"and {len(wrong) - _MOST_NAMED} more, which the report names")
    print(f"report: {page}")


class _Progress(StatusLine):
    """How many dampers are done, and how long the rest may take."""

    def __init__(self) -> None:
        self._began = time.monotonic()
        self._before: int | None = None

    def __call__(self, done: int, count: int, document: Mapping[str, Any]) -> None:
        if self._before is None:
            self._before = done - 1
        passed = time.monotonic() - self._began
        left = passed / (done - self._before) * (count - done)
        self.show(f"{done} of {count} dampers, about {left:.0f} s left")


main = program(_parser, _identify_many)
