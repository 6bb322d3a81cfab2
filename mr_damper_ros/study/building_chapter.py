"""Chapter of the report on the buildings of the benchmark."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.control.shear_building import BUILDINGS
from mr_damper_ros.report.document import (
    DASHES,
    GREY,
    INK,
    Chapter,
    Picture,
    Table,
    Text,
    legend_above,
    panels,
)
from mr_damper_ros.study.building_runs import (
    BANG_BANG,
    CHOSEN,
    DAMPERS,
    HIGHEST_CURRENT,
    JUDGED,
    OFF,
    ON,
    REVERSAL,
    SCALE,
    STRATEGIES,
    UNCONTROLLED,
    WEIGHTED,
    BuildingResult,
    BuildingRun,
)

Case = tuple[str, str]
"""A building and an earthquake."""


@dataclass(frozen=True)
class Buildings:
    """Results by controller, building, earthquake and lag of the coils."""

    results: Mapping[BuildingRun, BuildingResult]
    longest: float

    def of(self, strategy: str, case: Case, lag: float) -> BuildingResult:
        """The result of a run."""
        return self.results[BuildingRun(strategy, *case, lag, longest=self.longest)]


LAG = 0.01
"""Time constant [s] of the coils."""

CASES = tuple((building, earthquake) for building in BUILDINGS for earthquake in JUDGED)

_RECREATED = {OFF: (66.5, 67.1), ON: (29.2, 51.7), BANG_BANG: (29.9, 47.9)}
"""Percent of displacement and acceleration that others re-created: building I, El Centro, without
a lag of the coil, with the authors' own set of the damper."""

_SHOWN = ("I", "El Centro 1940")


def tasks(longest: float) -> list[BuildingRun]:
    """All that the chapter shows, of so many seconds of each earthquake at most."""
    every = [
        BuildingRun(strategy, building, earthquake, LAG, longest=longest)
        for building, earthquake in CASES
        for strategy in (UNCONTROLLED, *STRATEGIES)
    ]
    return [
        *every,
        *(BuildingRun(strategy, *_SHOWN, 0.0, longest=longest) for strategy in STRATEGIES),
    ]


def parts(found: Buildings, strategy: str, case: Case, lag: float) -> tuple[float, float]:
    """RMS of the roof's displacement and acceleration, in percent of those without dampers."""
    free = found.of(UNCONTROLLED, case, LAG)
    held = found.of(strategy, case, lag)
    return (
        100.0 * held.displacement / free.displacement,
        100.0 * held.acceleration / free.acceleration,
    )


def cases_won(found: Buildings, strategy: str = WEIGHTED) -> int:
    """Cases in which a controller is better than passive-on and bang-bang in both criteria."""
    return sum(
        all(
            own < other
            for against in (ON, BANG_BANG)
            for own, other in zip(
                parts(found, strategy, case, LAG), parts(found, against, case, LAG), strict=True
            )
        )
        for case in CASES
    )


def building_chapter(found: Buildings) -> Chapter:
    """The nine cases."""
    rows = []
    for case in CASES:
        for strategy in STRATEGIES:
            result = found.of(strategy, case, LAG)
            free = found.of(UNCONTROLLED, case, LAG)
            rows.append(
                (
                    *case,
                    strategy,
                    *parts(found, strategy, case, LAG),
                    100.0 * result.farthest / free.farthest,
                    100.0 * result.highest / free.highest,
                    1e-3 * result.force,
                    result.reversals,
                )
            )
    compared = []
    for strategy in STRATEGIES:
        known = _RECREATED.get(strategy, (None, None))
        compared.append((strategy, *parts(found, strategy, _SHOWN, 0.0), *known))
    return Chapter(
        "buildings",
        "Buildings in earthquakes",
        [
            Text(
                "Three storeys with dampers between ground and first floor: masses, stiffness, "
                "damping, weights and estimator of the hybrid simulations that D. Maurel "
                "(Universidad Técnica Federico Santa María) published "
                "(github.com/DanielMaurelE/vRTHS_AMBC_MRdamper). Building I has 1000 kg a floor "
                "and 5 % damping, II 1100 kg and 4 %, III 1300 kg and 3 %. "
                f"{DAMPERS} dampers act side by side, with 0 to {HIGHEST_CURRENT:g} A. All ground "
                f"motions at {SCALE:.0%} of their size."
            ),
            Text(
                "The damper is the extended sigmoid law, identified by this package from the "
                "twenty sinusoid records of the same repository (MIT licence, © 2022 mequiroz); "
                "the authors simulate with a Bouc–Wen law of their own. Beyond the peak "
                "velocities of the records, 15 to 63 mm/s, it has the coefficients of the nearest."
            ),
            Text(
                "El Centro is the record of 1940. Kobe and Maule, which the benchmark uses too, "
                "are not here: in their place stand two INVENTED motions, noise with a spectrum of "
                "Kanai and Tajimi, by a fixed seed. Only the figures of El Centro compare with "
                "those of others."
            ),
            Text(
                "Bang-bang is the authors' controller: full current where the force of the dampers "
                "should be larger than it is, else none, every millisecond. Both inverses command "
                "the current for the wanted force every 5 ms, as the node does. The weighted one "
                "weighs the roof's acceleration too "
                f"({CHOSEN.displacement:.0e} x², {CHOSEN.acceleration:.0e} a², {CHOSEN.force:g} "
                "F²), by the best of five sets of weights that were tried on another invented "
                "earthquake; where the motion is not known both inverses are stiff. A current has "
                f"turned where it goes back by more than {REVERSAL:g} A."
            ),
            Picture(
                "buildings",
                "RMS of the roof's displacement and absolute acceleration in the nine cases, in "
                f"percent of the building without dampers; coil lag {1e3 * LAG:.0f} ms.",
                _bars(found),
            ),
            Picture(
                "roof",
                f"Building {_SHOWN[0]}, {_SHOWN[1]} at {SCALE:.0%}: the strongest seconds.",
                _histories(found),
            ),
            Table(
                "buildings",
                f"Coil lag {1e3 * LAG:.0f} ms. In percent of the building without dampers.",
                (
                    "building",
                    "earthquake",
                    "controller",
                    "RMS displ.",
                    "RMS accel.",
                    "peak displ.",
                    "peak accel.",
                    "force (kN)",
                    "reversals/s",
                ),
                rows,
            ),
            Table(
                "recreated",
                "Building I, El Centro, no lag of the coil: RMS displacement and acceleration in "
                "percent, here and as others re-created the benchmark with the authors' damper.",
                ("controller", "displ.", "accel.", "displ. of others", "accel. of others"),
                compared,
            ),
        ],
    )


def _bars(found: Buildings) -> object:
    figure, axes = panels(2, 1, 6.6, 4.6, sharex=True)
    width = 0.8 / len(STRATEGIES)
    for place, strategy in enumerate(STRATEGIES):
        values = np.array([parts(found, strategy, case, LAG) for case in CASES])
        offsets = np.arange(len(CASES)) + (place - 0.5 * (len(STRATEGIES) - 1)) * width
        for row in range(2):
            axes[row, 0].bar(offsets, values[:, row], width, color=INK[place], label=strategy)
    axes[0, 0].set(ylabel="displacement (%)")
    axes[1, 0].set(ylabel="acceleration (%)")
    labels = [f"{building}\n{earthquake.split(' (')[0]}" for building, earthquake in CASES]
    axes[1, 0].set_xticks(range(len(CASES)), labels, fontsize=6.5)
    legend_above(figure, axes[0, 0], 3)
    return figure


def _histories(found: Buildings) -> object:
    figure, axes = panels(3, 1, 6.6, 4.6, sharex=True)
    shown = (UNCONTROLLED, ON, BANG_BANG, WEIGHTED)
    for place, strategy in enumerate(shown):
        time, displacement, acceleration, current = found.of(strategy, _SHOWN, LAG).series
        chosen = (time > 1.0) & (time < 6.0)
        free = strategy == UNCONTROLLED
        style = {
            "color": GREY if free else INK[place - 1],
            "linestyle": "-" if free else DASHES[place - 1],
            "linewidth": 0.8,
        }
        axes[0, 0].plot(time[chosen], 1e3 * displacement[chosen], label=strategy, **style)
        axes[1, 0].plot(time[chosen], acceleration[chosen], **style)
        if not free:
            axes[2, 0].plot(time[chosen], current[chosen], **style)
    axes[0, 0].set(ylabel="roof (mm)")
    axes[1, 0].set(ylabel="roof (m/s²)")
    axes[2, 0].set(ylabel="coil (A)", xlabel="time (s)")
    legend_above(figure, axes[0, 0], 4)
    return figure
