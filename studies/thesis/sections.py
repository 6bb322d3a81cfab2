"""The sections of the report on the thesis, in order."""

from __future__ import annotations

import os
from collections.abc import Callable
from types import ModuleType

from mr_damper_ros.report.document import Chapter
from studies import recordings
from studies.program import QUICK_RUNS, RUNS, Campaign, Part, Study
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
from studies.thesis.runs import PROVENANCE


def _part(name: str, title: str, section: ModuleType) -> Callable[[Campaign], Part]:
    """A section: ``compute`` calculates its numbers, ``show`` creates the blocks of the report.

    ``headline`` summarises the result in a sentence.
    """

    def part(campaign: Campaign) -> Part:
        data = section.compute(campaign)
        return Part([Chapter(name, title, section.show(data))], [section.headline(data)])

    return part


_SECTIONS = (
    ("force-error", "Sine and force identified, and their errors", force_error),
    (
        "dependency",
        "Dependency on current, frequency, displacement and temperature",
        dependency,
    ),
    ("conditions", "All conditions", conditions),
    ("sensitivity", "Sensitivity of the force", sensitivity),
    ("repeated", "Repeated differential evolution", repeated),
    ("methods", "Both methods, and the literature", methods),
    ("optimisers", "Comparison of optimisers", optimisers),
    (
        "observability",
        "Beyond the thesis: the reason for the scatter of the parameters",
        identifiability,
    ),
    ("models", "Comparison of the reviewed models", model_table),
    ("one-set", "Beyond the thesis: one set for all conditions", one_set),
    ("errata", "Errata", errata),
)


def _notice(campaign: Campaign) -> str:
    if os.environ.get("MR_DAMPER_DATA") and recordings.folder() is None:
        place = os.environ["MR_DAMPER_DATA"]
        raise ValueError(f"MR_DAMPER_DATA is {place}, which holds no utfsm: correct or unset it")
    return (
        "The recordings behind the thesis (D. M. D. da Silva, University of Brasília, 2023) were "
        f"not published. All runs here are {PROVENANCE}: the force of the Nelder–Mead set of a "
        "condition for the fitted sine, with noise of the reported size. Agreement therefore shows "
        "that methods and numbers are reproducible; it does not validate the law for the damper. "
        f"Random searches: {campaign.runs} repetitions, seed {campaign.seed}"
        f"{', quick variant' if campaign.quick else ''}."
    )


main = Study(
    "thesis",
    "Reproduce the results of the thesis on runs re-synthesised from its published parameter sets, "
    "and write one report. Results are stored, so a stopped study continues from them. If the "
    "variable MR_DAMPER_DATA names a folder that contains utfsm/processed, the models are also "
    "compared on these recordings.",
    "Parameter identification of the sigmoid model of an MR damper: the thesis reproduced",
    _notice,
    {section[0]: _part(*section) for section in _SECTIONS},
    f"{QUICK_RUNS} runs instead of {RUNS}, fewer evaluations and cases",
    random=True,
).main
