"""``python -m studies NAME ...`` runs the study of this name; ``--help`` lists its options."""

from __future__ import annotations

import os
import sys

from studies import recordings
from studies.program import QUICK_RUNS, RUNS, Campaign, study


def _of_thesis(campaign: Campaign) -> str:
    from studies.thesis.runs import PROVENANCE

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


def _of_control(campaign: Campaign) -> str:
    return (
        "Everything here is simulated: car and damper are emulated, and nothing was tried on "
        "hardware. The damper is commanded through the inverse of its identified law, by the code "
        "that the controller node runs. All random numbers have fixed seeds."
    ) + " Quick variant: drives are shortened." * campaign.quick


def _of_truth(campaign: Campaign) -> str:
    missing = (
        "This report contains only the simulated benchmark, because the variable MR_DAMPER_DATA is "
        "not set to a folder that contains the recordings (utfsm). "
    ) * (recordings.folder() is None)
    quick = " Quick variant: few laws and few, short records; the figures are not representative."
    return (
        f"{missing}Nothing is tuned to the evaluation data, and all random numbers have fixed "
        f"seeds. Times are processor times.{quick * campaign.quick}"
    )


STUDIES = {
    "thesis": study(
        "thesis",
        "Reproduce the results of the thesis on runs re-synthesised from its published parameter "
        "sets, and write one report. If the variable MR_DAMPER_DATA names a folder that contains "
        "utfsm/processed, the models are also compared on these recordings.",
        "Parameter identification of the sigmoid model of an MR damper: the thesis reproduced",
        _of_thesis,
        {
            "force-error": "thesis.force_error.force_error_part",
            "dependency": "thesis.conditions.dependency_part",
            "conditions": "thesis.conditions.conditions_part",
            "sensitivity": "thesis.sensitivity.sensitivity_part",
            "repeated": "thesis.searches.repeated_part",
            "methods": "thesis.searches.methods_part",
            "optimisers": "thesis.optimisers.optimisers_part",
            "observability": "thesis.sensitivity.identifiability_part",
            "models": "thesis.laws.models_part",
            "one-set": "thesis.laws.one_set_part",
            "errata": "thesis.errata.errata_part",
        },
        f"{QUICK_RUNS} runs instead of {RUNS}, fewer evaluations and cases",
        random=True,
    ),
    "control": study(
        "control",
        "Simulate a quarter car on roads of ISO 8608, with an emulated MR damper under several "
        "controllers, and write one report.",
        "Controllers of an MR damper side by side",
        _of_control,
        {
            "roads": "control.car.roads_part",
            "heated": "control.car.heated_part",
        },
        "shortened drives",
    ),
    "truth": study(
        "truth",
        "Evaluate every force law on the recordings in the folder MR_DAMPER_DATA, if this variable "
        "is set, and on the simulated hysteretic benchmark of Noël and Schoukens. Write the report "
        "(report.html) and its figures (truth.json).",
        "Accuracy of the force laws",
        _of_truth,
        {
            "recordings": "truth.records.recordings_part",
            "oscillator": "truth.oscillator.oscillator_part",
        },
        "few laws and few, short records",
    ),
}
"""The program of each report."""


def main(arguments: list[str]) -> int:
    """Run the study named by the first argument; returns its exit code."""
    name = arguments[0] if arguments else ""
    if name == "bags":
        from studies.thesis import bags

        return bags.main(arguments[1:])
    if name not in STUDIES:
        print(f"studies: the studies are {', '.join(STUDIES)}, bags", file=sys.stderr)
        return 2
    return STUDIES[name](arguments[1:])


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:  # while modules are loaded; the studies catch their own
        sys.exit(130)
