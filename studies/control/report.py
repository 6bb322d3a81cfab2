"""Report of the control study: all tasks, run in processes, and the resulting page."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, replace
from pathlib import Path

from mr_damper_ros.processes.process_pool import ProcessPool
from studies.control import buildings, car_chapters
from studies.control.buildings import WEIGHTED, simulate
from studies.control.car_chapters import Drives
from studies.control.car_drives import (
    BUMP_ROAD,
    CONSTANTS,
    CONTROLLERS,
    LAG,
    OFF,
    ON,
    ROADS,
    SPEEDS,
    STRATEGIES,
    Drive,
    drive,
)
from studies.control.heated import HeatedDrive, drive_heated, growth, heated_chapter
from studies.control.hybrid import (
    COMPENSATED,
    LATE,
    REFERENCE,
    TASKS,
    hybrid,
    hybrid_chapter,
    missed,
)
from studies.program import Make, Part, Say, Study, each_result, write_parts

_TITLE = "Controllers of an MR damper side by side"

_NOTICE = (
    "Everything here is simulated: car, buildings and dampers are emulated, and nothing was tried "
    "on hardware. The damper is commanded through the inverse of its identified law, by the code "
    "that the controller node runs. All random numbers have fixed seeds."
)


@dataclass(frozen=True)
class Extent:
    """Durations [s]: a drive, the heated drive, the longest earthquake and the hybrid run."""

    drive: float = 12.0
    heated: float = 90.0
    earthquake: float = math.inf
    hybrid: float = 12.0


FULL = Extent()
QUICK = Extent(drive=4.0, heated=40.0, earthquake=6.0, hybrid=6.0)
"""Short variant that checks whether everything works; its figures are not representative."""


def _roads(pool: ProcessPool, quick: bool, say: Say) -> Part:
    seconds = (QUICK if quick else FULL).drive
    tasks = [(strategy, road, LAG) for road in ROADS for strategy in STRATEGIES]
    tasks += [(strategy, road, 0.0) for road in ("A", "C", "E") for strategy in CONTROLLERS]
    tasks += [(name, "C", 0.0) for name in (*STRATEGIES[:2], *CONSTANTS)]
    drives = Drives(
        each_result(pool, drive, [Drive(*task, duration=seconds) for task in tasks], "drives", say),
        seconds,
    )
    best = car_chapters.best_on(drives, "C")
    here, off, on = (drives.of(name, "C", LAG) for name in (best, *STRATEGIES[:2]))
    worst = max(
        drives.of(name, "C", LAG).comfort / drives.of(name, "C", 0.0).comfort
        for name in CONTROLLERS
    )
    bump, without = (drives.of(name, BUMP_ROAD, LAG) for name in (best, OFF))
    chapters = [
        car_chapters.damper_chapter(),
        car_chapters.roads_chapter(drives),
        car_chapters.bump_chapter(drives),
        car_chapters.lag_chapter(drives),
    ]
    told = [
        "an invented damper whose truth is known, in a quarter car.",
        f"on road C {best}, the best by comfort and holding together, gives {here.comfort:.2f} "
        f"m/s² and {here.holding:.0%} of the tyre's load; passive-off {off.comfort:.2f} and "
        f"{off.holding:.0%}, passive-on {on.comfort:.2f} and {on.holding:.0%}.",
        f"over the bump the body's acceleration is {bump.comfort:.2f} m/s² (RMS; "
        f"{bump.highest:.1f} at most) with {best}, {without.comfort:.2f} ({without.highest:.1f}) "
        "with passive-off.",
        f"a coil that lags by 10 ms costs at most {worst - 1.0:.0%} of comfort on road C.",
    ]
    return Part(chapters, told, _against_passive(drives))


def _against_passive(drives: Drives) -> dict[str, object]:
    """The best controller of each road, and its worst road relative to the passive dampers."""
    best = {road: car_chapters.best_on(drives, road) for road in SPEEDS}
    worst = {
        f"car_{quantity}_over_{against.replace('-', '_')}": max(
            getattr(drives.of(best[road], road, LAG), quantity)
            / getattr(drives.of(against, road, LAG), quantity)
            for road in SPEEDS
        )
        for quantity in ("comfort", "holding")
        for against in (OFF, ON)
    }
    return {"best": best, "worst": worst}


def _heated(pool: ProcessPool, quick: bool, say: Say) -> Part:
    seconds = (QUICK if quick else FULL).heated
    tasks = [HeatedDrive(learns, duration=seconds) for learns in (False, True)]
    results = each_result(pool, drive_heated, tasks, "heated drives", say)
    found = {task.learns: result for task, result in results.items()}
    chapter = heated_chapter(found, tasks[0])
    told = [
        f"the force is missed by {growth(found[False]):.2f} times as much at the end as at the "
        f"beginning with the set of 28 °C, {growth(found[True]):.2f} times with the set identified "
        "on line."
    ]
    return Part([chapter], told, {"fixed": growth(found[False]), "identified": growth(found[True])})


def _buildings(pool: ProcessPool, quick: bool, say: Say) -> Part:
    longest = (QUICK if quick else FULL).earthquake
    results = each_result(pool, simulate, buildings.tasks(longest), "earthquakes", say)
    found = buildings.Buildings(results, longest)
    won = buildings.cases_won(found)
    fastest = max(found.of(WEIGHTED, case, buildings.LAG).reversals for case in buildings.CASES)
    chapter = buildings.building_chapter(found)
    return Part(
        [chapter],
        [
            f"the weighted inverse is better than passive-on and bang-bang in both RMS criteria in "
            f"{won} of {len(buildings.CASES)} cases, with at most {fastest:.0f} reversals of "
            "the current a second."
        ],
        {"cases": len(buildings.CASES), "won": won, "reversals_per_second": fastest},
    )


def _hybrid(pool: ProcessPool, quick: bool, say: Say) -> Part:
    seconds = (QUICK if quick else FULL).hybrid
    tasks = [replace(task, duration=seconds) for task in TASKS]
    results = each_result(pool, hybrid, tasks, "hybrid simulations", say)
    found = dict(zip(TASKS, results.values(), strict=True))
    reference = found[REFERENCE]
    late, ahead = (missed(found[task].roof, reference.roof) for task in (LATE, COMPENSATED))
    chapter = hybrid_chapter(found)
    told = [
        f"with the damper in an emulated machine that is late the roof is off by {late:.0%}, with "
        f"a command that runs ahead by {ahead:.0%}."
    ]
    return Part([chapter], told, {"late": late, "compensated": ahead})


_PARTS: dict[str, Make] = {
    "roads": _roads,
    "heated": _heated,
    "buildings": _buildings,
    "hybrid": _hybrid,
}


def _build(options: argparse.Namespace, say: Say) -> Path:
    short = " Quick variant: drives and earthquakes are cut short." if options.quick else ""
    return write_parts(options, say, "control", _TITLE, _NOTICE + short, _PARTS)


main = Study(
    "control",
    "Simulate a quarter car on roads of ISO 8608 and buildings in earthquakes, with an emulated MR "
    "damper under several controllers, and write one report.",
    tuple(_PARTS),
    "drives and earthquakes cut short",
    _build,
).main
