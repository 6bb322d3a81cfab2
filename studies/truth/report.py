"""Report on the accuracy of the laws: recordings, and a benchmark with a known truth."""

from __future__ import annotations

from studies import recordings
from studies.program import Campaign, Study
from studies.truth.oscillator import oscillator_part
from studies.truth.records import recordings_part

_NO_RECORDINGS = (
    "The recordings were not at hand (the variable MR_DAMPER_DATA is not set to a folder that "
    "holds utfsm): here is only the benchmark, which is re-created. "
)
_QUICK = " Quick variant: few laws, few and short records; not the real figures."


def _notice(campaign: Campaign) -> str:
    return (
        _NO_RECORDINGS
        * (recordings.folder() is None)
        + "Nothing was tuned to what it is judged by, and all random numbers have fixed seeds. "
        "Times are processor times." + _QUICK * campaign.quick
    )


main = Study(
    "truth",
    "Judge every force law on the recordings in the folder that the variable MR_DAMPER_DATA names, "
    "where it is set, and on the re-created hysteretic benchmark of Noël and Schoukens; write one "
    "report, report.html, and its figures, truth.json.",
    "What the force laws are worth",
    _notice,
    {"recordings": recordings_part, "oscillator": oscillator_part},
    "few laws, few and short records",
).main
