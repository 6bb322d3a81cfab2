"""The sections of the report on the thesis, in order."""

from __future__ import annotations

import os

from studies import recordings
from studies.program import QUICK_RUNS, RUNS, Campaign, Study
from studies.thesis.conditions import conditions_part, dependency_part
from studies.thesis.errata import errata_part
from studies.thesis.force_error import force_error_part
from studies.thesis.laws import models_part, one_set_part
from studies.thesis.optimisers import optimisers_part
from studies.thesis.runs import PROVENANCE
from studies.thesis.searches import methods_part, repeated_part
from studies.thesis.sensitivity import identifiability_part, sensitivity_part


def _notice(campaign: Campaign) -> str:
    if os.environ.get("MR_DAMPER_DATA") and recordings.folder() is None:
        place = os.environ["MR_DAMPER_DATA"]
        raise ValueError(f"MR_DAMPER_DATA is {place}, which holds no utfsm: correct or unset it")
    return (
        "The recordings behind the thesis (D. M. D. da Silva, University of Brasília, 2023) were "
        f"not published. All runs here are {PROVENANCE}: the force of the Nelder–Mead set of a "
        "condition for the fitted sine, with noise of the reported size. Agreement therefore shows "
        "that methods and numbers are reproducible; it does not validate the law for the damper. "
        f"Random searches: {campaign.runs} repetitions, seed "
        f"{campaign.seed}{', quick variant' if campaign.quick else ''}."
    )


main = Study(
    "thesis",
    "Reproduce the results of the thesis on runs re-synthesised from its published parameter sets, "
    "and write one report. Results are stored, so a stopped study continues from them. If the "
    "variable MR_DAMPER_DATA names a folder that contains utfsm/processed, the models are also "
    "compared on these recordings.",
    "Parameter identification of the sigmoid model of an MR damper: the thesis reproduced",
    _notice,
    {
        "force-error": force_error_part,
        "dependency": dependency_part,
        "conditions": conditions_part,
        "sensitivity": sensitivity_part,
        "repeated": repeated_part,
        "methods": methods_part,
        "optimisers": optimisers_part,
        "observability": identifiability_part,
        "models": models_part,
        "one-set": one_set_part,
        "errata": errata_part,
    },
    f"{QUICK_RUNS} runs instead of {RUNS}, fewer evaluations and cases",
    random=True,
).main
