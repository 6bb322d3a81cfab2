"""A quarter car on roads A to E: the best controller here against passive-off and passive-on."""

from __future__ import annotations

from benchmarks.figure import Figure
from mr_damper_ros.processes.process_pool import ProcessPool, Tell
from studies.control.car_chapters import Drives, best_on
from studies.control.car_drives import (
    LAG,
    OFF,
    ON,
    SPEEDS,
    STRATEGIES,
    Drive,
    DriveResult,
    drive,
)


def figures(duration: float = 12.0, workers: int = 2) -> list[Figure]:
    """Comfort and road holding of the best controller, as parts of those of passive dampers."""
    tasks = [
        Drive(strategy, road, LAG, duration=duration) for road in SPEEDS for strategy in STRATEGIES
    ]
    with ProcessPool(workers) as pool:
        results = pool.map(_driven, tasks)
    found = Drives(
        {task: result for task, result in zip(tasks, results, strict=True) if result is not None},
        duration,
    )
    best = {road: best_on(found, road) for road in SPEEDS}
    named = ", ".join(f"{road} {name}" for road, name in best.items())
    made = []
    for quantity, said in (
        ("comfort", "RMS acceleration of the body"),
        ("holding", "RMS load of the tyre"),
    ):
        for against in (OFF, ON):
            worst = max(
                getattr(found.of(best[road], road, LAG), quantity)
                / getattr(found.of(against, road, LAG), quantity)
                for road in SPEEDS
            )
            made.append(
                Figure(
                    f"car_{quantity}_over_{against.replace('-', '_')}",
                    worst,
                    f"Quarter car, invented damper, coil lag 10 ms, roads A to E: largest {said} "
                    f"with the best controller of each road over that with {against}.",
                    note=f"The best: {named}.",
                )
            )
    return made


def _driven(task: Drive, tell: Tell) -> DriveResult:
    return drive(task)
