"""The sections of the report in their order, and the report from them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mr_damper_ros.report.document import Block, Chapter, styled, write_report
from mr_damper_ros.thesis import (
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
from mr_damper_ros.thesis.campaign import Campaign
from mr_damper_ros.thesis.published_runs import PROVENANCE


@dataclass(frozen=True)
class Section:
    """``compute`` makes the numbers, ``show`` the blocks of the report from them.

    ``headline`` says the result in a sentence.
    """

    name: str
    title: str
    compute: Callable[[Campaign], dict[str, Any]]
    show: Callable[[dict[str, Any]], list[Block]]
    headline: Callable[[dict[str, Any]], str]


SECTIONS = (
    Section(
        "force-error",
        "Sine and force identified, and their errors",
        force_error.compute,
        force_error.show,
        force_error.headline,
    ),
    Section(
        "dependency",
        "Dependency on current, frequency, displacement and temperature",
        dependency.compute,
        dependency.show,
        dependency.headline,
    ),
    Section(
        "conditions", "All conditions", conditions.compute, conditions.show, conditions.headline
    ),
    Section(
        "sensitivity",
        "Sensitivity of the force",
        sensitivity.compute,
        sensitivity.show,
        sensitivity.headline,
    ),
    Section(
        "repeated",
        "Repeated differential evolution",
        repeated.compute,
        repeated.show,
        repeated.headline,
    ),
    Section(
        "methods",
        "Both methods, and the literature",
        methods.compute,
        methods.show,
        methods.headline,
    ),
    Section(
        "optimisers",
        "Optimisers side by side",
        optimisers.compute,
        optimisers.show,
        optimisers.headline,
    ),
    Section(
        "observability",
        "What the thesis could not show: why the parameters scatter",
        identifiability.compute,
        identifiability.show,
        identifiability.headline,
    ),
    Section(
        "models",
        "The reviewed models compared",
        model_table.compute,
        model_table.show,
        model_table.headline,
    ),
    Section(
        "one-set",
        "What the thesis could not show: one set for all conditions",
        one_set.compute,
        one_set.show,
        one_set.headline,
    ),
    Section("errata", "Errata", errata.compute, errata.show, errata.headline),
)

_TITLE = "Parameter identification of the sigmoid model of an MR damper: the thesis reproduced"


def build(campaign: Campaign, only: Sequence[str] | None = None) -> Path:
    """Compute what is missing and write the report; returns its page."""
    settings = campaign.settings
    chapters, headlines = [], []
    for section in SECTIONS:
        if only is not None and section.name not in only:
            continue
        campaign.say(section.title)
        data = section.compute(campaign)
        with styled():
            chapters.append(Chapter(section.name, section.title, section.show(data)))
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
