"""The sections of the report in order, and the assembly of the report."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from mr_damper_ros.report.document import Chapter, styled, write_report
from studies.program import Say, Study
from studies.thesis import (
    conditions,
    dependency,
    errata,
    force_error,
    identifiability,
    methods,
    model_table,
    one_set,
    optimisers,
    repeated,
    sensitivity,
)
from studies.thesis.campaign import Campaign, Settings
from studies.thesis.published_runs import PROVENANCE

SECTIONS = {
    "force-error": ("Sine and force identified, and their errors", force_error),
    "dependency": ("Dependency on current, frequency, displacement and temperature", dependency),
    "conditions": ("All conditions", conditions),
    "sensitivity": ("Sensitivity of the force", sensitivity),
    "repeated": ("Repeated differential evolution", repeated),
    "methods": ("Both methods, and the literature", methods),
    "optimisers": ("Optimisers side by side", optimisers),
    "observability": (
        "What the thesis could not show: why the parameters scatter",
        identifiability,
    ),
    "models": ("The reviewed models compared", model_table),
    "one-set": ("What the thesis could not show: one set for all conditions", one_set),
    "errata": ("Errata", errata),
}
"""Title and module of each section by its name.

In a module, ``compute`` calculates the numbers of a campaign, ``show`` creates the blocks of the
report from them, and ``headline`` summarises the result in a sentence.
"""

_TITLE = "Parameter identification of the sigmoid model of an MR damper: the thesis reproduced"


_RUNS, _QUICK_RUNS = 100, 10


def build(campaign: Campaign, only: Sequence[str]) -> Path:
    """Compute missing results and write the report; returns its page."""
    settings = campaign.settings
    chapters, headlines = [], []
    for name, (title, section) in SECTIONS.items():
        if name not in only:
            continue
        campaign.say(title)
        data = section.compute(campaign)
        with styled():
            chapters.append(Chapter(name, title, section.show(data)))
        headlines.append(section.headline(data))
    notice = (
        "The recordings behind the thesis (D. M. D. da Silva, University of Brasília, 2023) were "
        f"not published. All runs here are {PROVENANCE}: the force of the Nelder–Mead set of a "
        "condition on the fitted sine, with noise of the reported size. Agreement therefore shows "
        "that methods and numbers are reproducible, not that the damper behaves so. "
        f"Random searches: {settings.runs} repetitions, seed {settings.seed}"
        f"{', quick variant' if settings.quick else ''}."
    )
    with styled():
        return write_report(settings.folder, _TITLE, notice, headlines, chapters)


def _reproduce(options: argparse.Namespace, say: Say) -> Path:
    place = os.environ.get("MR_DAMPER_DATA")
    recordings = Path(place) / "utfsm" / "processed" if place else None
    if recordings is not None and not recordings.is_dir():
        raise ValueError(
            f"MR_DAMPER_DATA is {place}, which holds no utfsm/processed: mend or unset it"
        )
    default = _QUICK_RUNS if options.quick else _RUNS
    settings = Settings(
        folder=options.output,
        runs=default if options.runs is None else options.runs,
        workers=options.workers,
        seed=options.seed,
        quick=options.quick,
        recordings=recordings,
    )
    try:
        return build(Campaign(settings, say), options.only)
    except KeyboardInterrupt:
        sys.stderr.write("\nwhat is done is kept: call again to go on")
        raise


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--runs",
        type=int,
        help=f"repetitions of random searches (default {_RUNS}, quick {_QUICK_RUNS})",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers (default 0)")


main = Study(
    "thesis",
    "Make the results of the thesis again, on runs re-synthesised from its published parameter "
    "sets, and write one report. What was computed earlier is not computed again, so a stopped "
    "campaign goes on where it was. With the variable MR_DAMPER_DATA set to a folder that holds "
    "utfsm/processed, the models are compared on those recordings too.",
    tuple(SECTIONS),
    f"{_QUICK_RUNS} runs instead of {_RUNS}, fewer evaluations and cases",
    _reproduce,
    _add_options,
).main
