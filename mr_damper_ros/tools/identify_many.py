"""Identify every damper from all of its recordings.

The report shows the variation of the lot and its outliers.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mr_damper_ros.api.identification import identify
from mr_damper_ros.lots.many_dampers import ManyDampers, identify_many
from mr_damper_ros.lots.report import require_parquet, write_population_report, write_rows
from mr_damper_ros.processes.exits import FAILED, INTERRUPTED
from mr_damper_ros.tools import console
from mr_damper_ros.tools.identify import SEARCH_CHOICES, SEARCH_OPTIONS

LEFT_OUT = 3
"""Exit code if a file was not used or a damper not identified; all other results are complete."""

_MOST_NAMED = 10
"""Largest number of faults shown on the terminal; the report lists all."""

_OPTIONS = ("listed", "folder", "pattern", "workers", "scheduler", "accept_doubtful")
_FLAGS = {"listed": "--list", "folder": "--output", "pattern": "--damper"}
_RECORD_OPTIONS = ("columns", "current", "period", "variable")

_EPILOG = f"""\
A second call with the same folder processes only dampers that are missing or whose files have
changed. The folder contains dampers.csv, population.html, sets/ (the parameter file of each damper)
and dampers/ (the complete result of each damper).

examples:
  identify_many lots/2026-03 --output results/2026-03
  identify_many "bench/**/*.mcap" --damper "(D[0-9]+)_" --output results/bench --workers 8
  identify_many --list runs.csv --columns time:s,displacement:mm,force:N --output results/runs

Exit code: 0: success; {LEFT_OUT}: a file was not used or a damper not identified, all other results
are written; {FAILED}: an option cannot be used; {INTERRUPTED}: Ctrl-C.
"""


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "sources",
        nargs="*",
        metavar="SOURCE",
        help="folder to search, bag, or quoted pattern such as 'lot*/**/*.mcap'",
    )
    console.add_arguments(parser, identify_many, _OPTIONS, flags=_FLAGS)
    records = parser.add_argument_group("record files (only with --columns)")
    console.add_arguments(records, identify_many, _RECORD_OPTIONS)
    search = parser.add_argument_group("identification")
    console.add_arguments(search, identify, SEARCH_OPTIONS, SEARCH_CHOICES)
    parser.add_argument(
        "--parquet", action="store_true", help="also write the table as dampers.parquet"
    )


def _identify_many(options: argparse.Namespace) -> int:
    if not options.sources and options.listed is None:
        raise ValueError("there is nothing to identify: give folders, bags, patterns, or --list")
    if options.parquet:
        require_parquet()
    with _Progress() as progress:
        given = console.arguments_of(options, identify_many, "sources")
        found = identify_many(*options.sources, report=progress, **given)
    rows, folder = found.table, Path(options.folder)
    write_rows(rows, folder, parquet=options.parquet)
    page = write_population_report(found, folder)
    _tell(found, page)
    return LEFT_OUT if found.failures or found.left_out else 0


def _tell(found: ManyDampers, page: Path) -> None:
    identified = len(found.documents) - len(found.failures)
    before = f", {found.kept} of them in an earlier call" if found.kept else ""
    print(f"{identified} of {len(found.documents)} dampers identified{before}")
    for outlier in found.population.outliers[:_MOST_NAMED]:
        print(f"outlier: {outlier.sentence}")
    wrong = [f"not identified: {name}: {why}" for name, why in found.failures.items()]
    wrong += [f"not used: {entry.path}: {entry.reason}" for entry in found.left_out]
    for line in wrong[:_MOST_NAMED]:
        print(line)
    if len(wrong) > _MOST_NAMED:
        print(f"and {len(wrong) - _MOST_NAMED} more, see the report")
    print(f"report: {page}")


class _Progress(console.StatusLine):
    """The number of finished dampers, and the estimated time left."""

    def __init__(self) -> None:
        self._began = time.monotonic()
        self._before: int | None = None

    def __call__(self, done: int, count: int, document: Mapping[str, Any]) -> None:
        if self._before is None:
            self._before = done - 1
        passed = time.monotonic() - self._began
        left = passed / (done - self._before) * (count - done)
        self.show(f"{done} of {count} dampers, about {left:.0f} s left")


main = console.program(__name__, __doc__, _options, _identify_many, _EPILOG)
