"""Report on the accuracy of the laws: recordings, and a benchmark with a known truth."""

from __future__ import annotations

from studies import recordings
from studies.program import Campaign, Study
from studies.truth.oscillator import oscillator_part
from studies.truth.records import recordings_part

_NO_RECORDINGS = (
    "This report contains only the simulated benchmark, because the variable MR_DAMPER_DATA is not "
    "set to a folder that contains the recordings (utfsm). "
)
_QUICK = " Quick variant: few laws and few, short records; the figures are not representative."


def _notice(campaign: Campaign) -> str:
    return (
        _NO_RECORDINGS
        * (recordings.folder() is None)
        + "Nothing is tuned to the evaluation data, and all random numbers have fixed seeds. "
        "Times are processor times." + _QUICK * campaign.quick
    )


main = Study(
    "truth",
    "Evaluate every force law on the recordings in the folder MR_DAMPER_DATA, if this variable is "
    "set, and on the simulated hysteretic benchmark of Noël and Schoukens. Write the report "
    "(report.html) and its figures (truth.json).",
    "Accuracy of the force laws",
    _notice,
    {"recordings": recordings_part, "oscillator": oscillator_part},
    "few laws and few, short records",
).main
