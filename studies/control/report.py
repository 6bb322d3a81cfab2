"""Report of the control study: cars, buildings and a hybrid simulation with an MR damper."""

from __future__ import annotations

from studies.control.buildings import buildings_part
from studies.control.car import roads_part
from studies.control.heated import heated_part
from studies.control.hybrid import hybrid_part
from studies.program import Campaign, Study


def _notice(campaign: Campaign) -> str:
    return (
        "Everything here is simulated: car, buildings and dampers are emulated, and nothing was "
        "tried on hardware. The damper is commanded through the inverse of its identified law, by "
        "the code that the controller node runs. All random numbers have fixed seeds."
        + " Quick variant: drives and earthquakes are shortened."
        * campaign.quick
    )


main = Study(
    "control",
    "Simulate a quarter car on roads of ISO 8608 and buildings in earthquakes, with an emulated MR "
    "damper under several controllers, and write one report.",
    "Controllers of an MR damper side by side",
    _notice,
    {
        "roads": roads_part,
        "heated": heated_part,
        "buildings": buildings_part,
        "hybrid": hybrid_part,
    },
    "shortened drives and earthquakes",
).main
